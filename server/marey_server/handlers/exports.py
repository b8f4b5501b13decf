"""Items as files, with the right name and type."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from marey_schemas.base import Request
from marey_server import exporting
from marey_server.exporting import ExportFormat, ExportOptions
from marey_server.handlers.declarations import Access, Bytes, reads
from marey_server.handlers.items import kind_of
from marey_server.handlers.queries import MAX_INTEGER
from marey_server.handlers.reply import Rendered, Reply
from marey_server.handlers.resource import Resource
from marey_server.handlers.streaming import BlobSender, attachment


class ExportQuery(Request):
    """Which file."""

    format: ExportFormat = Field("original", description="original: the file exactly as it was imported.")
    unit: Literal["m", "cm"] = Field("cm", description="Unit of length of a BVH.")
    end_index: Literal["inclusive", "exclusive"] = Field(
        "inclusive", description="Of an annotation of the predecessor: whether a section holds its frame `end_idx`."
    )
    form: Literal["labels", "list", "frames"] = Field(
        "labels", description="Of an annotation of the predecessor: sections by label, a list, or frames by label."
    )
    revision: int | None = Field(None, ge=1, le=MAX_INTEGER, description="Absent: the newest.")


class Export(BlobSender):
    """An item as a file."""

    path = "/projects/{project}/{kind}/{item}/export"
    tag = "Items"

    @reads(
        access=Access.READER,
        query=ExportQuery,
        answer=Bytes,
        answer_types=(
            "application/octet-stream",
            "text/plain",
            "application/json",
            "application/x-npz",
            "application/x-bzip2",
        ),
        also=((206, None), (416, None)),
        headers=("Range", "If-Range"),
    )
    async def get(self, project: str, kind: str, item: str, query: ExportQuery) -> Rendered | Reply | None:
        """An item as a file: clips and aligned clips as bvh, npz, predecessor, json or the original; others as json."""
        place = (project, kind_of(kind), item, query.revision)
        if query.format == "original":
            original = await self.look_up(exporting.find_original, *place)
            return await self.send_blob(original.digest, disposition=attachment(original.name))
        source = await self.look_up(exporting.read_source, *place)
        options = ExportOptions(query.end_index, query.form)
        file = await self.compute(exporting.write_file, source, query.format, query.unit, options)
        headers = {"Content-Disposition": attachment(file.name), "Cache-Control": "private, no-cache"}
        return Reply(file.data, media_type=file.media_type, headers=headers)


RESOURCES: tuple[type[Resource], ...] = (Export,)
