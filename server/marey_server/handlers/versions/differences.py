"""Differences between revisions of items."""

from __future__ import annotations

from functools import partial

from marey_schemas.documents.differences import DifferenceRequest
from marey_server.handlers.items import kind_of
from marey_server.http.declarations import Access, Document, reads
from marey_server.http.reply import Reply
from marey_server.http.resource import Resource
from marey_server.motions import comparing


class DifferenceResource(Resource):
    """Difference between two revisions of an item."""

    path = "/projects/{project}/{kind}/{item}/difference"
    tag = "Items"

    @reads(access=Access.READER, query=DifferenceRequest, answer=Document)
    async def get(self, project: str, kind: str, item: str, query: DifferenceRequest) -> Reply:
        """Return how a revision differs from an earlier one, or from a revision of another item of the same kind.

        Frames are matched by content. The answer has the schema `marey/difference@1`. It lists removed and inserted
        frames, and changes of timing, of rotations and of the root's path. It also lists changed segments, changed
        joints, changed examples of models, and other changed fields.
        """
        source = await self.look_up(comparing.read_difference, project, kind_of(kind), item, query)
        order = partial(comparing.difference_order, source, query, self.media.encoding)
        return Reply(await self.compute_apart(comparing.MAKE_DIFFERENCE, order, bytes), media_type=str(self.media))


RESOURCES: tuple[type[Resource], ...] = (DifferenceResource,)
