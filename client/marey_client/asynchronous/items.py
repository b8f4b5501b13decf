"""Counterparts of `marey_client.items` for async programs.

Written by `make docs` from that module; change it there.
"""

from __future__ import annotations

from collections.abc import AsyncIterator, Awaitable, Mapping, Sequence
from pathlib import Path
from typing import Any, Generic, TypeVar, Unpack

from marey_client.asynchronous.counterparts import Counterpart, counterpart_of
from marey_client.downloads import TakenPaths
from marey_client.items import ItemHandle, Items, Selection
from marey_client.keywords.asking import DifferenceKeywords, LineageKeywords
from marey_client.transport import Params
from marey_schemas.documents.differences import Difference
from marey_schemas.items import Item, ItemChange, Lineage, QueryExplanation, Revision, Staleness
from marey_schemas.kinds import Kind
from marey_schemas.lineage import LineageGraph
from marey_schemas.queue.jobs import ItemInput


@counterpart_of(ItemHandle)
class AsyncItemHandle(Counterpart):
    """Handle of an item, in the state in which the item was read; its methods send requests to the server."""

    _sync: ItemHandle

    @property
    def project(self) -> str:
        """Name of the project."""
        return self._sync.project

    @property
    def item(self) -> Item:
        """State of the item when the handle read it, or changed it last."""
        return self._sync.item

    @property
    def id(self) -> str:
        """The id, which never changes."""
        return self._sync.id

    @property
    def name(self) -> str:
        """The name, which is unique among the items of this kind in the folder."""
        return self._sync.name

    @property
    def path(self) -> str:
        """The collection and the name, joined by `/`."""
        return self._sync.path

    @property
    def url(self) -> str:
        """The path of the item, relative to the API's root."""
        return self._sync.url

    def as_input(self) -> ItemInput:
        """Return the revision that was read, as an input of jobs."""
        return self._sync.as_input()

    async def part(self, part: str, *, revision: int | None = None, **query: str | None) -> dict[str, Any]:
        """Return the document of a part, with numpy arrays: of the given revision, or of the newest one."""
        return await self._run(self._sync.part, part, revision=revision, **query)

    async def put_part(self, part: str, document: Mapping[str, Any], *, message: str | None = None) -> Item:
        """Replace the document of a part by `document`; the item gets a new revision.

        Raises `PreconditionFailed` if the item was changed since it was read.
        """
        return await self._run(self._sync.put_part, part, document, message=message)

    async def change(self, change: ItemChange) -> Item:
        """Rename, move or tag the item. Raises `PreconditionFailed` if the item was changed since it was read."""
        return await self._run(self._sync.change, change)

    async def revert(self, revision: int, *, message: str = "") -> Item:
        """Create a revision with the content of an earlier one; name, folder and tags stay.

        Raises `PreconditionFailed` if the item was changed since it was read.
        """
        return await self._run(self._sync.revert, revision, message=message)

    async def delete(self) -> None:
        """Delete the item; `restore` restores it.

        Raises `PreconditionFailed` if the item was changed since it was read.
        """
        await self._run(self._sync.delete)

    async def restore(self) -> Item:
        """Restore a deleted item."""
        return await self._run(self._sync.restore)

    def revisions(self) -> AsyncIterator[Revision]:
        """List the revisions of the item, newest first."""
        return self._each(self._sync.revisions)

    async def revision(self, number: int) -> Revision:
        """Return the revision of the item with this number. Raises `NotFound` if there is none."""
        return await self._run(self._sync.revision, number)

    async def lineage(self) -> Lineage:
        """Return the inputs of the newest revision, and the results computed from it."""
        return await self._run(self._sync.lineage)

    async def lineage_graph(self, revision: int | None = None, **options: Unpack[LineageKeywords]) -> LineageGraph:
        """Return the inputs and results of a revision, by default the newest, traced through all jobs.

        `options` are those of `LineageOptions`, such as `direction="inputs"` and `depth=1`. Raises `NotFound` if there
        is no such revision.
        """
        return await self._run(self._sync.lineage_graph, revision, **options)

    async def staleness(self) -> Staleness:
        """Return whether inputs from which the item was made have newer revisions now, and list these inputs."""
        return await self._run(self._sync.staleness)

    async def difference(
        self,
        before: int | None = None,
        after: int | None = None,
        *,
        other: AsyncItemHandle | None = None,
        plot: bool = False,
        **options: Unpack[DifferenceKeywords],
    ) -> Difference:
        """Return how the revision `after` differs from the revision `before`; by default, the two newest revisions.

        With `other`, `after` is a revision of the item `other`; by default, the newest revisions of both items are
        compared. `options` are those of `DifferenceOptions`, such as `threshold_deg=5`; `plot` requests values to draw.
        Raises `NotFound` if there is no such revision.
        """
        exchanged: Difference = await self._exchange(
            self._sync.difference, before, after, other=other, plot=plot, **options
        )
        return exchanged

    async def export(
        self,
        folder: str | Path,
        *,
        format: str = "original",
        revision: int | None = None,
        beside: TakenPaths | None = None,
        allow_expired_consent: str | None = None,
        fold_positions: bool = False,
        **options: str | None,
    ) -> Path:
        """Write a revision of the item, by default the newest, to `folder` as a file of `format`; return its path.

        If several items are exported with the same `beside`, files of the same name get numbers. If the consent for a
        clip has ended, raises `Conflict`, unless `allow_expired_consent` gives a reason to export the clip
        nevertheless. The server records the reason; the caller must be a maintainer or owner. With `fold_positions`, a
        BVH file has positions only for its root joint, for programs that ignore positions of other joints.
        """
        return await self._run(
            self._sync.export,
            folder,
            format=format,
            revision=revision,
            beside=beside,
            allow_expired_consent=allow_expired_consent,
            fold_positions=fold_positions,
            **options,
        )


AsyncHandle = TypeVar("AsyncHandle", bound=AsyncItemHandle)


@counterpart_of(Items)
class AsyncItems(Counterpart, Generic[AsyncHandle]):
    """Items of one kind in a project: iterable, counted by `len`, and looked up by `items[path]`."""

    _sync: Items[Any]

    @property
    def project(self) -> str:
        return self._sync.project

    @property
    def kind(self) -> Kind:
        return self._sync.kind

    def __aiter__(self) -> AsyncIterator[AsyncHandle]:
        return self._each(self._sync.__iter__)

    def __getitem__(self, name: str) -> Awaitable[AsyncHandle]:
        """Return the item with a path, such as `raw/walk`, or with an id.

        Raises `NoSuchPath`, which names the nearest path, if there is none.
        """
        return self._exchange(self._sync.__getitem__, name)

    async def find(self, name: str) -> AsyncHandle | None:
        """Return the item with a path or an id, or None. A path may begin with the name of the project."""
        exchanged: AsyncHandle | None = await self._exchange(self._sync.find, name)
        return exchanged

    async def where(self, folder: str = "", *, query: str | None = None) -> AsyncSelection[AsyncHandle]:
        """Return the items in a folder and below it that meet a query, such as `subject = 02 and frames > 120`.

        Raises `NoSuchPath`, which names the nearest folder, if there is no such folder.
        """
        exchanged: AsyncSelection[AsyncHandle] = await self._exchange(self._sync.where, folder, query=query)
        return exchanged

    async def to_dataframe(self) -> Any:
        """Return a pandas table with one row for each item: path, revision, summary and facets; the index is the id.

        Raises `MissingPackage` if pandas is not installed.
        """
        exchanged: Any = await self._exchange(self._sync.to_dataframe)
        return exchanged

    @property
    def url(self) -> str:
        """The path of the items, relative to the API's root."""
        return self._sync.url

    def list(
        self,
        *,
        collection: str | None = None,
        directly_in: str | None = None,
        path: str | None = None,
        sort: str | None = None,
        query: str | None = None,
        deleted: bool = False,
        filters: Params | None = None,
        page_size: int = 500,
    ) -> AsyncIterator[AsyncHandle]:
        """Yield items in order, requested page by page.

        `collection` selects the items in a folder and below it, `directly_in` only the items directly in a folder (""
        is the root), and `path` one item. `query` selects items that meet conditions, such as `subject = 02 and frames
        > 120`. `deleted` selects deleted items, which `restore` can restore. `filters` are query parameters of the REST
        API, such as `{"frames.gte": 120}`.
        """
        return self._each(
            self._sync.list,
            collection=collection,
            directly_in=directly_in,
            path=path,
            sort=sort,
            query=query,
            deleted=deleted,
            filters=filters,
            page_size=page_size,
        )

    def outdated(self, *, collection: str | None = None, page_size: int = 500) -> AsyncIterator[Staleness]:
        """Yield the ids of items of which an input has a newer revision, with these inputs, requested page by page.

        `collection` is a folder; without it, all items of the kind in the project are examined.
        """
        return self._each(self._sync.outdated, collection=collection, page_size=page_size)

    async def explain(self, query: str, *, collection: str | None = None) -> QueryExplanation:
        """Count the items that a query selects, and the items that each condition of the query excludes.

        `collection` is a folder; without it, all items of the kind in the project are counted.
        """
        return await self._run(self._sync.explain, query, collection=collection)

    async def get(self, item_id: str) -> AsyncHandle:
        """Return the item with this id. Raises `NotFound` if there is none."""
        exchanged: AsyncHandle = await self._exchange(self._sync.get, item_id)
        return exchanged

    async def count(self, *, collection: str | None = None, filters: Params | None = None) -> int:
        """Count the items in the folder `collection` and below it; without `collection`, in the whole project."""
        return await self._run(self._sync.count, collection=collection, filters=filters)

    async def restore(self, item_id: str) -> AsyncHandle:
        """Restore the deleted item with this id, and return it."""
        exchanged: AsyncHandle = await self._exchange(self._sync.restore, item_id)
        return exchanged

    async def create(
        self,
        name: str,
        parts: Mapping[str, Mapping[str, Any]],
        *,
        collection: str = "",
        tags: str | Sequence[str] = (),
        message: str = "",
    ) -> AsyncHandle:
        """Create an item from its parts, which may contain numpy arrays. Raises `Conflict` if the name is taken."""
        exchanged: AsyncHandle = await self._exchange(
            self._sync.create, name, parts, collection=collection, tags=tags, message=message
        )
        return exchanged


@counterpart_of(Selection)
class AsyncSelection(Counterpart, Generic[AsyncHandle]):
    """Items of one kind in a folder and below it that meet a query, in the order of their names."""

    _sync: Selection[Any]

    @property
    def items(self) -> AsyncItems[AsyncHandle]:
        exchanged: AsyncItems[AsyncHandle] = self._as_async(self._sync.items)
        return exchanged

    @property
    def folder(self) -> str:
        return self._sync.folder

    @property
    def query(self) -> str | None:
        return self._sync.query

    def __aiter__(self) -> AsyncIterator[AsyncHandle]:
        return self._each(self._sync.__iter__)

    async def count(self) -> int:
        """Count the items."""
        return await self._run(self._sync.count)

    async def to_dataframe(self) -> Any:
        """Return a pandas table with one row for each item; see `Items.to_dataframe`."""
        exchanged: Any = await self._exchange(self._sync.to_dataframe)
        return exchanged
