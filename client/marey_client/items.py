"""Handles of items of every kind: lookup, creation, changes, parts and history."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar, Unpack

from marey_client.arguments import checked, checks_arguments, several
from marey_client.downloads import TakenPaths, download
from marey_client.errors import NoSuchPath, NotFound
from marey_client.keywords.asking import DifferenceKeywords, LineageKeywords
from marey_client.listing.paths import missing_path, require_folder
from marey_client.listing.tables import summary_table
from marey_client.paging import pages
from marey_client.transport import Params, Transport, as_json, named_path, read_model, sends_nothing
from marey_schemas.documents.differences import Difference, DifferenceRequest
from marey_schemas.items import (
    Item,
    ItemChange,
    ItemCreate,
    ItemRevert,
    Lineage,
    Page,
    QueryExplanation,
    Revision,
    Staleness,
)
from marey_schemas.kinds import Kind
from marey_schemas.lineage import LineageGraph, LineageRequest
from marey_schemas.queue.jobs import ItemInput


@checks_arguments
class ItemHandle:
    """Handle of an item, in the state in which the item was read; its methods send requests to the server."""

    transport: Transport
    project: str
    """Name of the project."""
    item: Item
    """State of the item when the handle read it, or changed it last."""

    def __init__(self, transport: Transport, project: str, item: Item) -> None:
        self.transport = transport
        self.project = project
        self.item = item

    def __repr__(self) -> str:
        return f"<{self.item.kind} {self.path!r} {self.item.id} revision {self.item.revision}>"

    @property
    def id(self) -> str:
        """The id, which never changes."""
        return self.item.id

    @property
    def name(self) -> str:
        """The name, which is unique among the items of this kind in the folder."""
        return self.item.name

    @property
    def path(self) -> str:
        """The collection and the name, joined by `/`."""
        return self.item.path

    @property
    def url(self) -> str:
        """The path of the item, relative to the API's root."""
        return f"/projects/{self.project}/{self.item.kind.plural}/{self.item.id}"

    @sends_nothing
    def as_input(self) -> ItemInput:
        """Return the revision that was read, as an input of jobs."""
        return ItemInput(item=self.id, revision=self.item.revision)

    def part(self, part: str, *, revision: int | None = None, **query: str | None) -> dict[str, Any]:
        """Return the document of a part, with numpy arrays: of the given revision, or of the newest one."""
        tree, _ = self.transport.get_tree(named_path(f"{self.url}/parts", part), {"revision": revision, **query})
        return dict(tree)

    def put_part(self, part: str, document: Mapping[str, Any], *, message: str | None = None) -> Item:
        """Replace the document of a part by `document`; the item gets a new revision.

        Raises `PreconditionFailed` if the item was changed since it was read.
        """
        response = self.transport.send_tree(
            "PUT",
            named_path(f"{self.url}/parts", part),
            document,
            params={"message": message},
            headers=self._if_match(),
        )
        return self._renewed(read_model(Item, response))

    def change(self, change: ItemChange) -> Item:
        """Rename, move or tag the item. Raises `PreconditionFailed` if the item was changed since it was read."""
        response = self.transport.send("PATCH", self.url, content=as_json(change), headers=self._if_match())
        return self._renewed(read_model(Item, response))

    def revert(self, revision: int, *, message: str = "") -> Item:
        """Create a revision with the content of an earlier one; name, folder and tags stay.

        Raises `PreconditionFailed` if the item was changed since it was read.
        """
        body = as_json(checked(ItemRevert, revision=revision, message=message))
        response = self.transport.send("POST", f"{self.url}/revert", content=body, headers=self._if_match())
        return self._renewed(read_model(Item, response))

    def delete(self) -> None:
        """Delete the item; `restore` restores it.

        Raises `PreconditionFailed` if the item was changed since it was read.
        """
        self.transport.send("DELETE", self.url, headers=self._if_match())

    def restore(self) -> Item:
        """Restore a deleted item."""
        return self._renewed(self.transport.post(Item, f"{self.url}/restore"))

    def revisions(self) -> Iterator[Revision]:
        """List the revisions of the item, newest first."""
        return pages(self.transport, Revision, f"{self.url}/revisions")

    def revision(self, number: int) -> Revision:
        """Return the revision of the item with this number. Raises `NotFound` if there is none."""
        return self.transport.get(Revision, f"{self.url}/revisions/{number}")

    def lineage(self) -> Lineage:
        """Return the inputs of the newest revision, and the results computed from it."""
        return self.transport.get(Lineage, f"{self.url}/lineage")

    def lineage_graph(self, revision: int | None = None, **options: Unpack[LineageKeywords]) -> LineageGraph:
        """Return the inputs and results of a revision, by default the newest, traced through all jobs.

        `options` are those of `LineageOptions`, such as `direction="inputs"` and `depth=1`. Raises `NotFound` if there
        is no such revision.
        """
        request = checked(LineageRequest, {"revision": revision, **options})
        params = request.model_dump(mode="json", exclude_defaults=True)
        return self.transport.get(LineageGraph, f"{self.url}/lineage-graph", params)

    def staleness(self) -> Staleness:
        """Return whether inputs from which the item was made have newer revisions now, and list these inputs."""
        return self.transport.get(Staleness, f"{self.url}/stale")

    def difference(
        self,
        before: int | None = None,
        after: int | None = None,
        *,
        other: ItemHandle | None = None,
        plot: bool = False,
        **options: Unpack[DifferenceKeywords],
    ) -> Difference:
        """Return how the revision `after` differs from the revision `before`; by default, the two newest revisions.

        With `other`, `after` is a revision of the item `other`; by default, the newest revisions of both items are
        compared. `options` are those of `DifferenceOptions`, such as `threshold_deg=5`; `plot` requests values to draw.
        Raises `NotFound` if there is no such revision.
        """
        request = checked(
            DifferenceRequest,
            {"from": before, "to": after, "to_item": None if other is None else other.id, "plot": plot, **options},
        )
        params = request.model_dump(mode="json", by_alias=True, exclude_defaults=True)
        tree, _ = self.transport.get_tree(f"{self.url}/difference", params)
        return Difference.model_validate(tree)

    def export(
        self,
        folder: str | Path,
        *,
        format: str = "original",  # noqa: A002
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
        if fold_positions:
            options |= {"fold_positions": "true"}
        if allow_expired_consent is not None:
            options |= {"allow_expired_consent": "true", "consent_reason": allow_expired_consent}
        return download(
            self.transport,
            f"{self.url}/export",
            folder,
            params={"format": format, "revision": revision, **options},
            name=f"{self.name}.{format}",
            beside=beside,
        )

    def _if_match(self) -> dict[str, str]:
        return {"If-Match": f'"{self.item.rev}.json"'}

    def _renewed(self, item: Item) -> Item:
        self.item = item
        return item


Handle = TypeVar("Handle", bound=ItemHandle)


@checks_arguments
@dataclass(frozen=True)
class Items(Generic[Handle]):
    """Items of one kind in a project: iterable, counted by `len`, and looked up by `items[path]`."""

    transport: Transport
    project: str
    kind: Kind
    handle: type[Handle]

    def __iter__(self) -> Iterator[Handle]:
        return self.list(sort="name")

    def __len__(self) -> int:
        return self.count()

    def __getitem__(self, name: str) -> Handle:
        """Return the item with a path, such as `raw/walk`, or with an id.

        Raises `NoSuchPath`, which names the nearest path, if there is none.
        """
        found = self.find(name)
        if found is None:
            raise NoSuchPath(missing_path(self.transport, self.project, self.kind, name))
        return found

    def __contains__(self, name: object) -> bool:
        return isinstance(name, str) and self.find(name) is not None

    def find(self, name: str) -> Handle | None:
        """Return the item with a path or an id, or None. A path may begin with the name of the project."""
        name = name.strip("/")
        for path in dict.fromkeys((name, name.removeprefix(f"{self.project}/"))):
            for found in self.list(path=path, page_size=1):
                return found
        if name in ("", ".", "..") or "/" in name:
            return None
        try:
            return self.get(name)
        except NotFound:
            return None

    def where(self, folder: str = "", *, query: str | None = None) -> Selection[Handle]:
        """Return the items in a folder and below it that meet a query, such as `subject = 02 and frames > 120`.

        Raises `NoSuchPath`, which names the nearest folder, if there is no such folder.
        """
        folder = folder.strip("/")
        if folder:
            require_folder(self.transport, self.project, folder)
        return Selection(self, folder, query)

    def to_dataframe(self) -> Any:
        """Return a pandas table with one row for each item: path, revision, summary and facets; the index is the id.

        Raises `MissingPackage` if pandas is not installed.
        """
        return summary_table(self)

    @property
    def url(self) -> str:
        """The path of the items, relative to the API's root."""
        return f"/projects/{self.project}/{self.kind.plural}"

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
    ) -> Iterator[Handle]:
        """Yield items in order, requested page by page.

        `collection` selects the items in a folder and below it, `directly_in` only the items directly in a folder (""
        is the root), and `path` one item. `query` selects items that meet conditions, such as `subject = 02 and frames
        > 120`. `deleted` selects deleted items, which `restore` can restore. `filters` are query parameters of the REST
        API, such as `{"frames.gte": 120}`.
        """
        params = {
            "collection": collection or None, "directly_in": directly_in, "path": path, "sort": sort, "query": query,
            "deleted": "true" if deleted else None, "limit": page_size, **(filters or {}),
        }  # fmt: skip
        return (self._handle(item) for item in pages(self.transport, Item, self.url, params))

    def outdated(self, *, collection: str | None = None, page_size: int = 500) -> Iterator[Staleness]:
        """Yield the ids of items of which an input has a newer revision, with these inputs, requested page by page.

        `collection` is a folder; without it, all items of the kind in the project are examined.
        """
        params = {"collection": collection or None, "limit": page_size}
        return pages(self.transport, Staleness, f"/projects/{self.project}/stale/{self.kind.plural}", params)

    def explain(self, query: str, *, collection: str | None = None) -> QueryExplanation:
        """Count the items that a query selects, and the items that each condition of the query excludes.

        `collection` is a folder; without it, all items of the kind in the project are counted.
        """
        path = f"/projects/{self.project}/explanations/{self.kind.plural}"
        return self.transport.get(QueryExplanation, path, {"query": query, "collection": collection})

    def get(self, item_id: str) -> Handle:
        """Return the item with this id. Raises `NotFound` if there is none."""
        return self._handle(self.transport.get(Item, named_path(self.url, item_id)))

    def count(self, *, collection: str | None = None, filters: Params | None = None) -> int:
        """Count the items in the folder `collection` and below it; without `collection`, in the whole project."""
        params = {"collection": collection or None, "count": "exact", "limit": 1, **(filters or {})}
        return self.transport.get(Page, self.url, params).count or 0

    def restore(self, item_id: str) -> Handle:
        """Restore the deleted item with this id, and return it."""
        return self._handle(self.transport.post(Item, f"{named_path(self.url, item_id)}/restore"))

    def create(
        self,
        name: str,
        parts: Mapping[str, Mapping[str, Any]],
        *,
        collection: str = "",
        tags: str | Sequence[str] = (),
        message: str = "",
    ) -> Handle:
        """Create an item from its parts, which may contain numpy arrays. Raises `Conflict` if the name is taken."""
        wanted = checked(
            ItemCreate, name=name, collection=collection, tags=several(tags), parts=dict(parts), message=message
        )
        response = self.transport.send_tree("POST", self.url, wanted.model_dump(by_alias=True))
        return self._handle(read_model(Item, response))

    def _handle(self, item: Item) -> Handle:
        return self.handle(self.transport, self.project, item)


@dataclass(frozen=True)
class Selection(Generic[Handle]):
    """Items of one kind in a folder and below it that meet a query, in the order of their names."""

    items: Items[Handle]
    folder: str = ""
    query: str | None = None

    def __iter__(self) -> Iterator[Handle]:
        return self.items.list(collection=self.folder, query=self.query, sort="name")

    def __len__(self) -> int:
        return self.count()

    def count(self) -> int:
        """Count the items."""
        return self.items.count(collection=self.folder, filters={"query": self.query})

    def to_dataframe(self) -> Any:
        """Return a pandas table with one row for each item; see `Items.to_dataframe`."""
        return summary_table(self)
