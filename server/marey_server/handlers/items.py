"""Resources of items, the same for skeletons, clips, models and all other kinds."""

from __future__ import annotations

from pydantic import Field

from marey_schemas.base import Request
from marey_schemas.documents.skeleton_merges import SkeletonMergeAnswer, SkeletonMergeRequest
from marey_schemas.items import Item, ItemChange, ItemCreate, ItemRevert, Lineage, QueryExplanation, Revision, Staleness
from marey_schemas.kinds import Kind
from marey_schemas.lineage import LineageGraph, LineageRequest
from marey_schemas.queries.grammar import MOST_CHARACTERS
from marey_schemas.sizes import MIB, MOST_INTEGER
from marey_server.errors import NotFoundProblem
from marey_server.handlers.searching.similar import IndexSearcher
from marey_server.http.declarations import Access, RequestBody, reads, writes
from marey_server.http.queries import CommaSeparated, CountedPageQuery, PageQuery
from marey_server.http.reply import Rendered, Reply
from marey_server.http.resource import Resource
from marey_server.store import items
from marey_server.store.items import ItemFilters

MAX_DOCUMENT_BYTES = 128 * MIB


class ItemsQuery(CountedPageQuery):
    """Query parameters of a list of items: filters, order, and which members of each item to return."""

    collection: str | None = Field(None, max_length=1024, description="Return items in this folder or below it.")
    directly_in: str | None = Field(
        None, max_length=1024, description="Return items in this folder but not below it; the empty path is the root."
    )
    path: str | None = Field(
        None, max_length=1300, description="Return the item with this path, made of folder and name."
    )
    name: str | None = Field(
        None, max_length=255, description="Return items with this name; a final * matches any ending."
    )
    tag_in: CommaSeparated = Field((), alias="tag.in", description="Return items that have any of these tags.")
    skeleton: str | None = Field(None, max_length=64, description="Return clips that use this skeleton.")
    clip: str | None = Field(None, max_length=64, description="Return annotations of this clip.")
    frames_gte: int | None = Field(
        None, alias="frames.gte", ge=0, le=MOST_INTEGER, description="Return items with at least this number of frames."
    )
    frames_lte: int | None = Field(
        None, alias="frames.lte", ge=0, le=MOST_INTEGER, description="Return items with at most this number of frames."
    )
    q: str | None = Field(
        None, max_length=255, description="Return items whose name contains this text, in upper or lower case."
    )
    query: str | None = Field(
        None,
        max_length=MOST_CHARACTERS,
        description="Query, such as `subject = 02 and frames > 120 and not warning = foot-slide`.",
    )
    deleted: bool = Field(False, description="Return deleted items instead of existing ones.")
    sort: str = Field(
        "-created_at",
        max_length=100,
        description="Sort keys: id, name, created_at, updated_at, frames; a leading - sorts in descending order.",
    )
    fields: CommaSeparated | None = Field(None, description="Members of each item to return; absent: all.")

    def filters(self) -> ItemFilters:
        """Convert the query parameters to the `ItemFilters` by which the store selects items."""
        return ItemFilters(
            collection=self.collection,
            directly_in=self.directly_in,
            path=self.path,
            name=self.name,
            tags=self.tag_in,
            skeleton=self.skeleton,
            clip=self.clip,
            frames_gte=self.frames_gte,
            frames_lte=self.frames_lte,
            q=self.q,
            query=self.query,
            deleted=self.deleted,
        )


def kind_of(plural: str) -> Kind:
    """Return the kind whose plural is a segment of the address, such as `clips`.

    Raises `NotFoundProblem` if there is none.
    """
    try:
        return Kind.from_plural(plural)
    except KeyError:
        raise NotFoundProblem(
            f"There is no kind of item called {plural!r}; use a plural such as clips.", code="no-kind"
        ) from None


class ItemsOfKind(IndexSearcher):
    """Items of a kind in a project."""

    path = "/projects/{project}/{kind}"
    tag = "Items"

    @reads(access=Access.READER, query=ItemsQuery, answer=Item, paged=True, attempts=True)
    async def get(self, project: str, kind: str, query: ItemsQuery) -> Rendered:
        """List items of a kind, filtered and sorted."""
        filters = await self.searched(project, kind_of(kind), query.filters())
        return await self.answer(
            items.list_items,
            project,
            kind_of(kind),
            filters,
            sort=query.sort,
            cursor=query.cursor,
            limit=query.limit,
            fields=query.fields,
            count=query.count is not None,
        )

    @writes(
        access=Access.CONTRIBUTOR,
        body=RequestBody(ItemCreate, max_bytes=MAX_DOCUMENT_BYTES),
        answer=Item,
        status=201,
        etag=True,
        idempotency="key",
        in_folders=True,
    )
    async def post(self, project: str, kind: str, body: ItemCreate) -> Rendered:
        """Create an item from its documents."""
        prepared = body.model_copy(update={"parts": await self.compute(items.prepare_parts, kind_of(kind), body.parts)})
        return await self.answer_with(
            lambda made: Reply(made, rev=made.rev, location=f"/projects/{project}/{kind}/{made.id}"),
            items.create_item,
            project,
            kind_of(kind),
            prepared,
        )


class SkeletonMerges(Resource):
    """Merges of the skeletons of a project."""

    path = "/projects/{project}/skeleton-merges"
    tag = "Items"

    @writes(
        access=Access.MAINTAINER, body=SkeletonMergeRequest, answer=SkeletonMergeAnswer, idempotency="key", names=True
    )
    async def post(self, project: str, body: SkeletonMergeRequest) -> Rendered:
        """Merge duplicate skeletons of each rig into one skeleton, or preview the merge.

        Each clip, aligned clip or model with a merged skeleton gets a revision with the remaining skeleton and the same
        motion. The merged skeletons are deleted. Results computed from the clips do not become stale.
        """
        if body.dry_run:
            return await self.render_document(Reply(await self.look_up(items.merge_skeletons, project, body)))
        return await self.answer(items.merge_skeletons, project, body)


class ItemResource(Resource):
    """An item."""

    path = "/projects/{project}/{kind}/{item}"
    tag = "Items"

    @reads(access=Access.READER, answer=Item, etag=True, attempts=True)
    async def get(self, project: str, kind: str, item: str) -> Rendered:
        """Return an item at its newest revision: name, folder, tags, summary, documents."""
        return await self.answer(items.read_item, project, kind_of(kind), item)

    @writes(
        access=Access.CONTRIBUTOR, body=ItemChange, answer=Item, precondition="required", etag=True, in_folders=True
    )
    async def patch(self, project: str, kind: str, item: str, body: ItemChange) -> Rendered:
        """Rename, move or tag an item."""
        expected_rev = self.precondition.expected_rev
        return await self.answer(items.change_item, project, kind_of(kind), item, body, expected_rev=expected_rev)

    @writes(access=Access.MAINTAINER, precondition="required", in_folders=True)
    async def delete(self, project: str, kind: str, item: str) -> Rendered:
        """Delete an item; it can be restored."""
        expected_rev = self.precondition.expected_rev
        return await self.answer(items.delete_item, project, kind_of(kind), item, expected_rev=expected_rev)


class ItemRestoration(Resource):
    """Restoration of a deleted item."""

    path = "/projects/{project}/{kind}/{item}/restore"
    tag = "Items"

    @writes(access=Access.MAINTAINER, answer=Item, etag=True, idempotency="key", in_folders=True)
    async def post(self, project: str, kind: str, item: str) -> Rendered:
        """Restore a deleted item."""
        return await self.answer(items.restore_item, project, kind_of(kind), item)


class ItemReversion(Resource):
    """Reversion of an item to an earlier revision."""

    path = "/projects/{project}/{kind}/{item}/revert"
    tag = "Items"

    @writes(
        access=Access.CONTRIBUTOR,
        body=ItemRevert,
        answer=Item,
        precondition="required",
        etag=True,
        idempotency="key",
        in_folders=True,
    )
    async def post(self, project: str, kind: str, item: str, body: ItemRevert) -> Rendered:
        """Create a revision with the content of an earlier revision; name, folder and tags do not change."""
        expected_rev = self.precondition.expected_rev
        return await self.answer(items.revert_item, project, kind_of(kind), item, body, expected_rev=expected_rev)


class Revisions(Resource):
    """The history of an item."""

    path = "/projects/{project}/{kind}/{item}/revisions"
    tag = "Items"

    @reads(access=Access.READER, query=PageQuery, answer=Revision, paged=True)
    async def get(self, project: str, kind: str, item: str, query: PageQuery) -> Rendered:
        """List the revisions of an item, newest first."""
        return await self.answer(
            items.list_revisions, project, kind_of(kind), item, cursor=query.cursor, limit=query.limit
        )


class RevisionResource(Resource):
    """A revision."""

    path = "/projects/{project}/{kind}/{item}/revisions/{revision:int}"
    tag = "Items"

    @reads(access=Access.READER, answer=Revision)
    async def get(self, project: str, kind: str, item: str, revision: int) -> Rendered:
        """Return a revision: author, message, job, documents."""
        return await self.answer(items.read_revision, project, kind_of(kind), item, revision)


class LineageQuery(Request):
    """Query parameters of a lineage: the revision from which it starts."""

    revision: int | None = Field(
        None, ge=1, le=MOST_INTEGER, description="Revision whose lineage is returned; absent: the newest."
    )


class LineageResource(Resource):
    """Lineage of a revision."""

    path = "/projects/{project}/{kind}/{item}/lineage"
    tag = "Items"

    @reads(access=Access.READER, query=LineageQuery, answer=Lineage)
    async def get(self, project: str, kind: str, item: str, query: LineageQuery) -> Rendered:
        """Return the inputs of a revision, the job that created it, and the revisions that use it."""
        return await self.answer(items.read_lineage, project, kind_of(kind), item, revision_number=query.revision)


class LineageGraphResource(Resource):
    """Lineage of a revision through any number of jobs."""

    path = "/projects/{project}/{kind}/{item}/lineage-graph"
    tag = "Items"

    @reads(access=Access.READER, query=LineageRequest, answer=LineageGraph)
    async def get(self, project: str, kind: str, item: str, query: LineageRequest) -> Rendered:
        """Return the revisions from which a revision was made, the revisions made from it, and the jobs in between."""
        return await self.answer(items.read_lineage_graph, project, kind_of(kind), item, query)


class StalenessResource(Resource):
    """Staleness of an item."""

    path = "/projects/{project}/{kind}/{item}/stale"
    tag = "Items"

    @reads(access=Access.READER, answer=Staleness)
    async def get(self, project: str, kind: str, item: str) -> Rendered:
        """Return whether an input of the item has a newer revision."""
        return await self.answer(items.read_staleness, project, kind_of(kind), item)


class StalenessQuery(PageQuery):
    """Query parameters of a list of outdated items."""

    collection: str | None = Field(
        None, max_length=1024, description="Examine only items in this folder or below it; absent: the whole project."
    )


class StaleItems(Resource):
    """Outdated items of a kind."""

    path = "/projects/{project}/stale/{kind}"
    tag = "Items"

    @reads(access=Access.READER, query=StalenessQuery, answer=Staleness, paged=True)
    async def get(self, project: str, kind: str, query: StalenessQuery) -> Rendered:
        """List the items that have an input with a newer revision, and these inputs.

        For each page, `limit` items are examined. So a page may list fewer items, or none, although `next_cursor`
        leads to another page.
        """
        filters = ItemFilters(collection=query.collection)
        return await self.answer(
            items.list_staleness, project, kind_of(kind), filters, cursor=query.cursor, limit=query.limit
        )


class ExplanationQuery(Request):
    """Query parameters of an explanation: the query to explain, and the folder whose items are counted."""

    query: str = Field(max_length=MOST_CHARACTERS, description="Query, as for the list of items.")
    collection: str | None = Field(
        None, max_length=1024, description="Count only items in this folder or below it; absent: in the whole project."
    )


class ExplanationResource(IndexSearcher):
    """Effect of a query on the items of a kind."""

    path = "/projects/{project}/explanations/{kind}"
    tag = "Items"

    @reads(access=Access.READER, query=ExplanationQuery, answer=QueryExplanation)
    async def get(self, project: str, kind: str, query: ExplanationQuery) -> Rendered:
        """Return the number of items that a query selects, and how many items each of its conditions excludes."""
        found = await self.searched(project, kind_of(kind), ItemFilters(query=query.query))
        filters = ItemFilters(collection=query.collection, alike=found.alike)
        return await self.answer(items.explain_query, project, kind_of(kind), filters, query.query)


RESOURCES: tuple[type[Resource], ...] = (
    ExplanationResource,
    ItemsOfKind,
    SkeletonMerges,
    ItemResource,
    ItemRestoration,
    ItemReversion,
    Revisions,
    RevisionResource,
    LineageResource,
    LineageGraphResource,
    StaleItems,
    StalenessResource,
)
