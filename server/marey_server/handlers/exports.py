"""Resource that returns items as files, with their names and media types."""

from __future__ import annotations

from functools import partial

from pydantic import Field

from marey_schemas.consents import ConsentOverride
from marey_schemas.formats import (
    DEFAULT_END_INDEX,
    DEFAULT_FORM,
    EXPORT_MEDIA_TYPES,
    AnnotationForm,
    EndIndex,
    ExportFormat,
)
from marey_schemas.options.exporting import MotionFileOptions
from marey_schemas.sizes import MOST_INTEGER
from marey_server.handlers.items import kind_of
from marey_server.http.caching import REVALIDATED
from marey_server.http.declarations import Access, Bytes, reads
from marey_server.http.reply import Rendered, Reply
from marey_server.http.resource import Resource
from marey_server.http.streaming import BlobSender, attachment
from marey_server.motions import exporting
from marey_server.motions.child import ComputedFile
from marey_server.motions.exporting import ExportTime
from marey_server.motions.predecessor_exports import ExportLayout, ExportPart, PredecessorOptions
from marey_server.store import items


class ExportQuery(MotionFileOptions, ConsentOverride):
    """Query parameters of an export: the format and the options of the file."""

    format: ExportFormat = Field("original", description="File format; original: the file exactly as it was imported.")
    end_index: EndIndex | None = Field(
        None,
        description="For annotations in the predecessor's format: whether a segment includes its frame `end_idx`. "
        f"Absent: the imported file, if the annotation is unchanged since the import; otherwise {DEFAULT_END_INDEX}.",
    )
    form: AnnotationForm | None = Field(
        None,
        description="For annotations in the predecessor's format: layout of the file. `labels`: the segments of each "
        "label. `list`: one list of all segments, without labels. `frames`: the frames of each label. Absent: the "
        f"imported file, if the annotation is unchanged since the import; otherwise {DEFAULT_FORM}.",
    )
    part: ExportPart | None = Field(
        None,
        description="Part to export: `tree` of a model. In the predecessor's format, also `alignment` of an aligned "
        "clip (the source frame at each canonical frame, and the sections), and `skeleton_model` of a skeleton (the "
        "joint mapping and the axes). Absent: the model, clip or skeleton itself.",
    )
    layout: ExportLayout | None = Field(
        None,
        description="Layout of a file in the predecessor's format: 2 or 3 for models, `database` or `file` for "
        "skeletons. Absent: the imported file, if the item is unchanged since the import; otherwise, for skeletons "
        "`database`, and for models the layout that contains the time function exactly, or else 3.",
    )
    time: ExportTime = Field(
        "canonical",
        description="For aligned clips: `canonical` time, or the time and position of the `source` clip.",
    )
    revision: int | None = Field(None, ge=1, le=MOST_INTEGER, description="Revision to export; absent: the newest.")


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
        """Return an item as a file; if it was imported from a file, the original can be returned.

        Clips and aligned clips can be returned as bvh, npz, predecessor and json. Skeletons, annotations, models with
        their trees, and graphs can be returned as predecessor and json; items of other kinds only as json. The format
        `predecessor` stands for the file formats of Marey's predecessor. If an item was imported from such a file and
        is unchanged since the import, the answer is this file, unless `layout`, `form` or `end_index` is given.

        If the consent for a clip has ended, the export is refused (409, `consent-expired`). The last day of the consent
        is in the take record of the clip's newest revision; an aligned clip has the consent of its source clip.
        Maintainers can allow the export with `allow_expired_consent` and a reason.
        """
        place = (project, kind_of(kind), item, query.revision)
        options = PredecessorOptions(query.end_index, query.form, query.part, query.layout)
        options.require_fit(place[1])
        permitted = query.allow_expired_consent and await self.change(items.permit_export, *place[:3], query)
        if query.format == "original":
            original = await self.look_up(exporting.find_original, *place, options, permitted=permitted)
            return await self.send_blob(
                original.digest, disposition=attachment(original.name), cache_control=REVALIDATED
            )
        if query.format == "predecessor" and query.time == "canonical":
            unchanged = await self.look_up(exporting.find_unchanged_original, *place, options, permitted=permitted)
            if unchanged is not None:
                return await self.send_blob(
                    unchanged.digest, disposition=attachment(unchanged.name), cache_control=REVALIDATED
                )
        source = await self.look_up(exporting.read_source, *place, permitted=permitted)
        self.holding.grow(source.size_bytes)
        order = partial(exporting.export_order, source.item, MotionFileOptions.of(query), query.time, options)
        file = await self.compute_apart(exporting.EXPORT_ITEM, order, ComputedFile.unpack)
        headers = {"Content-Disposition": attachment(file.name), "Cache-Control": REVALIDATED}
        return Reply(file.data, media_type=file.media_type, headers=headers)


RESOURCES: tuple[type[Resource], ...] = (Export,)
