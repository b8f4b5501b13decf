"""Resources that read the documents of items, whole or in part, and replace them in new revisions."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Annotated, Any

from pydantic import Field, StringConstraints

from marey_schemas.base import Request
from marey_schemas.items import Item, PartsRequest
from marey_schemas.kinds import Kind
from marey_schemas.names import Message, form
from marey_schemas.sizes import MOST_INTEGER
from marey_server.handlers.items import MAX_DOCUMENT_BYTES, kind_of
from marey_server.http.caching import IMMUTABLE
from marey_server.http.declarations import Access, Document, RequestBody, reads, writes
from marey_server.http.queries import CommaSeparated
from marey_server.http.reply import LoadedDocument, Rendered, Reply, UnchangingDocument
from marey_server.http.resource import Resource
from marey_server.store import items
from marey_server.store.transaction import Transaction

FrameRange = Annotated[
    str, StringConstraints(pattern=form(r"^\d{0,9}:\d{0,9}$", "be a range of frames first:end, such as 100:200"))
]


class PartQuery(Request):
    """Query parameters for reading a part: its revision, frames and joints."""

    revision: int | None = Field(None, ge=1, le=MOST_INTEGER, description="Revision to return; absent: the newest.")
    frames: FrameRange | None = Field(None, description="Half-open range of frames, such as 100:200, :200 or 100:.")
    joints: CommaSeparated | None = Field(None, description="Names of the joints to return, in the desired order.")

    def frame_slice(self) -> slice | None:
        """Return the query's range of frames as a slice, or None if the query has no range."""
        if self.frames is None:
            return None
        start, _, stop = self.frames.partition(":")
        return slice(int(start) if start else None, int(stop) if stop else None)


class PartChange(Request):
    """Query parameter for replacing a part: the message of the new revision."""

    message: Message = Field("", description="Message shown in the history.")


def read_part(
    tx: Transaction, project: str, kind: Kind, item: str, part: str, query: PartQuery, *, encoded: bool
) -> Reply:
    """Return a part of an item, or only some of its frames and joints.

    If `encoded` is true and the query selects frames or joints, the arrays of the answer are compressed as in the
    store. If the query gives a revision, clients may cache the answer, because a part of a revision never changes.
    """
    found = items.find_part(tx, project, kind, item, part, revision=query.revision)
    load = partial(items.load_part, tx, found)
    if query.frames is None and query.joints is None:
        content: UnchangingDocument | LoadedDocument = UnchangingDocument(found.digest, load, found.size_bytes)
    else:
        cut = partial(items.cut_part, load(), query.frame_slice(), query.joints, encoded=encoded)
        content = LoadedDocument(cut, found.size_bytes)
    if query.revision is None:
        return Reply(content, rev=found.rev)
    return Reply(content, rev=f"r{found.revision}", headers={"Cache-Control": IMMUTABLE})


class PartResource(Resource):
    """A document of an item, such as a clip's motion or a skeleton's mapping."""

    path = "/projects/{project}/{kind}/{item}/parts/{part}"
    tag = "Items"

    @reads(access=Access.READER, query=PartQuery, answer=Document, etag=True)
    async def get(self, project: str, kind: str, item: str, part: str, query: PartQuery) -> Rendered:
        """Return a document, or only some frames and joints of it.

        If the header `Accept` asks for MessagePack or BSON with the parameter `arrays=blocks`, arrays are sent
        compressed, as they are stored.
        """
        encoded = self.media.arrays == "blocks"
        return await self.answer_with(
            lambda reply: reply, read_part, project, kind_of(kind), item, part, query, encoded=encoded
        )

    @writes(
        access=Access.CONTRIBUTOR,
        query=PartChange,
        body=RequestBody(Document, max_bytes=MAX_DOCUMENT_BYTES),
        answer=Item,
        precondition="required",
        etag=True,
        in_folders=True,
    )
    async def put(
        self, project: str, kind: str, item: str, part: str, query: PartChange, body: Mapping[str, Any]
    ) -> Rendered:
        """Replace a document; the item gets a new revision, in which its other documents are unchanged."""
        prepared = await self.compute(items.prepare_part, kind_of(kind), part, body)
        expected_rev = self.precondition.expected_rev
        return await self.answer(
            items.put_part,
            project,
            kind_of(kind),
            item,
            part,
            prepared,
            expected_rev=expected_rev,
            message=query.message,
        )


class Parts(Resource):
    """Documents of several items."""

    path = "/projects/{project}/parts"
    tag = "Items"

    @reads(access=Access.READER, body=PartsRequest, answer=Document, attempts=True)
    async def post(self, project: str, body: PartsRequest) -> Rendered:
        """Return documents of several items.

        The answer is `{"documents": [...]}` in the order of the request, with null for a document that does not exist.
        If the documents together are too large, the last ones are missing from the list: request them again.
        """
        loaded = await self.look_up(items.load_parts, project, body.parts)
        content = LoadedDocument(lambda: {"documents": loaded.documents}, loaded.size_bytes)
        return await self.render_document(Reply(content))


RESOURCES: tuple[type[Resource], ...] = (PartResource, Parts)
