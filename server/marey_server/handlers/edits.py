"""Previews of edits: the result of commands on a clip."""

from __future__ import annotations

from functools import partial

from marey_schemas.editing.previews import EditPreviewRequest
from marey_server.handlers.items import kind_of
from marey_server.http.declarations import Access, Document, reads
from marey_server.http.reply import Reply
from marey_server.http.resource import Resource
from marey_server.motions import previewing


class EditPreviewResource(Resource):
    """Preview of an edit of a clip."""

    path = "/projects/{project}/{kind}/{item}/edit-preview"
    tag = "Items"

    @reads(access=Access.READER, body=EditPreviewRequest, answer=Document)
    async def post(self, project: str, kind: str, item: str, body: EditPreviewRequest) -> Reply:
        """Apply commands to a clip, and return some frames of the result; nothing is stored.

        The path parameter `kind` must be `clips`. The whole edit is computed, so the frames equal those that a job of
        the kind `edit` would store. Edits that would take more than a few seconds are refused with 413.
        """
        source = await self.look_up(previewing.read_preview, project, kind_of(kind), item, body)
        order = partial(previewing.preview_order, source, body, self.media.encoding)
        preview = await self.compute_apart(previewing.MAKE_PREVIEW, order, bytes)
        return Reply(preview, media_type=str(self.media))


RESOURCES: tuple[type[Resource], ...] = (EditPreviewResource,)
