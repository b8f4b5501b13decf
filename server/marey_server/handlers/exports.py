"""Items as files, with the right name and type."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from marey_schemas.base import Request
from marey_schemas.formats import EXPORT_MEDIA_TYPES, ExportFormat, WrittenUnit
from marey_server.handlers.items import kind_of
from marey_server.http.declarations import Access, Bytes, reads
from marey_server.http.queries import MAX_INTEGER
from marey_server.http.reply import Rendered, Reply
from marey_server.http.resource import Resource
from marey_server.http.streaming import BlobSender, attachment
from marey_server.motions import exporting
from marey_server.motions.exporting import ExportTime
from marey_server.motions.predecessor_exports import PredecessorOptions


class ExportQuery(Request):
    """Format and options of the exported file."""

    format: ExportFormat = Field("original", description="original: the file exactly as it was imported.")
    unit: WrittenUnit = Field("cm", description="Unit of length of a BVH.")
    end_index: Literal["inclusive", "exclusive"] = Field(
        "inclusive", description="Of an annotation of the predecessor: whether a section holds its frame `end_idx`."
    )
    form: Literal["labels", "list", "frames"] = Field(
        "labels", description="Of an annotation of the predecessor: sections by label, a list, or frames by label."
    )
    part: Literal["model", "tree", "alignment"] | None = Field(
        None,
        description="For the predecessor: the tree of a model, or what is kept beside an aligned clip: its time "
        "function and sections. The original of a tree is its file, too. Absent: the model, or the clip. Other items "
        "have none.",
    )
    layout: Literal["2", "3"] | None = Field(
        None, description="Of a model of the predecessor; absent: as it was imported, else 3."
    )
    time: ExportTime = Field(
        "canonical",
        description="Of an aligned clip: its canonical frames, or those of the clip it was made of, where that stood.",
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
        answer_types=EXPORT_MEDIA_TYPES,
        also=((206, None), (416, None)),
        headers=("Range", "If-Range"),
    )
    async def get(self, project: str, kind: str, item: str, query: ExportQuery) -> Rendered | Reply | None:
        """An item as a file, or the original where it was imported from one.

        Clips and aligned clips are bvh, npz, predecessor or json; annotations, models with their trees, and graphs are
        predecessor or json; others json. What was imported from a file of the predecessor and has not changed since is
        given back as it came.
        """
        place = (project, kind_of(kind), item, query.revision)
        options = PredecessorOptions(query.end_index, query.form, query.part, query.layout)
        options.require_part_of(place[1])
        if query.format == "original":
            original = await self.look_up(exporting.find_original, *place, options)
            return await self.send_blob(original.digest, disposition=attachment(original.name))
        if query.format == "predecessor":
            unchanged = await self.look_up(exporting.find_unchanged_original, *place, options)
            if unchanged is not None:
                return await self.send_blob(unchanged.digest, disposition=attachment(unchanged.name))
        source = await self.look_up(exporting.read_source, *place)
        file = await self.compute(exporting.write_file, source, query.format, query.unit, query.time, options)
        headers = {"Content-Disposition": attachment(file.name), "Cache-Control": "private, no-cache"}
        return Reply(file.data, media_type=file.media_type, headers=headers)


RESOURCES: tuple[type[Resource], ...] = (Export,)
