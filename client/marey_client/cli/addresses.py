"""Addresses such as `lab/raw/walk`, and lookup of the folders and items at these addresses."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

from marey_client.cli.terminal.failures import WrongUsage
from marey_schemas.wording import suggestion

if TYPE_CHECKING:
    from marey_client.items import ItemHandle
    from marey_client.marey import Marey
    from marey_client.project import ProjectHandle
    from marey_schemas.items import Collection, Item
    from marey_schemas.kinds import Kind

FOLDER = "collection"
REQUESTS_AT_ONCE = 4

_ID = re.compile(r"([a-z]+)_[0-9a-hjkmnp-tv-z]{26}")


@dataclass(frozen=True)
class Address:
    """Address of a folder or an item: a project, and a path in it. With a `/` at the end, it means a folder."""

    project: str
    path: str
    is_folder: bool = False

    @classmethod
    def parse(cls, text: str) -> Address:
        """Parse the text `project` or `project/path`. Raises `WrongUsage` if it contains no project."""
        project, _, path = text.strip("/").partition("/")
        if not project:
            raise WrongUsage(f"{text!r} contains no project; write project/folder/name")
        if project in (".", "..") or "\\" in project:
            place = "/".join(one for one in text.replace("\\", "/").split("/") if one not in ("", ".", ".."))
            remedy = f"did you mean {place!r}?" if place else "write project/folder/name"
            raise WrongUsage(f"{text!r} is not the address of a folder or an item; {remedy}")
        return cls(project, path, path != "" and text.endswith("/"))

    @classmethod
    def within(cls, project: str, path: str) -> Address:
        """Return the address of a path in a project."""
        return cls.parse(f"{project}/{path}")

    def __str__(self) -> str:
        return f"{self.project}/{self.path}" if self.path else self.project

    @property
    def name(self) -> str:
        """The last part of the path: a name, or the id of an item."""
        return self.path.rpartition("/")[2]

    @property
    def has_id(self) -> bool:
        """Whether the last part of the path is the id of an item."""
        return _ID.fullmatch(self.name) is not None


def find_item(marey: Marey, address: Address, kinds: Sequence[Kind]) -> ItemHandle | None:
    """Return the item at an address; None if there is no item of the given kinds, which are tried in order."""
    project = marey.project(address.project)
    if not address.path or address.is_folder:
        return None
    for kind in kinds:
        items = project.items(kind)
        if address.has_id:
            if address.name.startswith(f"{kind.value}_"):
                return _existing(items, address.name)
            continue
        named: ItemHandle | None = next(items.list(path=address.path, page_size=1), None)
        if named is not None:
            return named
    return None


def require_item(marey: Marey, address: Address, kinds: Sequence[Kind]) -> Any:
    """Return the item at an address. Raises `WrongUsage` if there is none."""
    found = find_item(marey, address, kinds)
    if found is None:
        wanted = " or ".join(kind.value for kind in kinds) if len(kinds) <= 2 else "item"
        raise missing_place(marey, address, f"no {wanted}", kinds)
    return found


def missing_place(marey: Marey, address: Address, what: str, kinds: Iterable[Kind]) -> WrongUsage:
    """Return the error for an address without an item of these kinds, with the nearest address or other advice."""
    from marey_schemas.kinds import Kind

    place = shlex.quote(str(address))
    if not address.path:
        marey.project(address.project).read()  # raises the error that names the nearest project
        return WrongUsage(
            f"{address} is a project, but the command needs the path of an item; `marey ls {place}` lists it"
        )
    if marey.project(address.project).collections.at(address.path) is not None:
        return WrongUsage(f"{address} is a folder; `marey ls {place}` lists it")
    if address.is_folder:
        what, kinds = "no folder", ()
    elif (other := find_item(marey, address, [one for one in Kind if one not in kinds])) is not None:
        kind = other.item.kind.noun
        return WrongUsage(f"there is {what} at {address}, but a {kind}; `marey show {place}` shows it")
    return WrongUsage(f"there is {what} at {address}; {advice(marey.project(address.project), address.path, kinds)}")


def advice(project: ProjectHandle, path: str, kinds: Iterable[Kind]) -> str:
    """Return advice for an error about a path without a folder or an item of these kinds, such as the nearest path."""
    from marey_client.listing.paths import nearest_path

    near = nearest_path(project.transport, project.name, path, kinds) if path and not Address("", path).has_id else None
    if near is None:
        return f"`marey ls {project.name}` lists the project"
    place = shlex.quote(f"{project.name}/{near}")
    return f"`marey ls {place}` lists the folder" if f"{path}/".startswith(f"{near}/") else f"did you mean {place}?"


def addresses_in_one_project(places: Sequence[str]) -> list[Address]:
    """Parse texts such as `project` or `project/path`. Raises `WrongUsage` if they are not all in one project."""
    addresses = [Address.parse(place) for place in places]
    if len({address.project for address in addresses}) > 1:
        raise WrongUsage(
            f"these places are in different projects, but the command works in one project only: {', '.join(places)}"
        )
    return addresses


def kind_named(name: str) -> Kind:
    """Return the kind of item with the given name. Raises `WrongUsage` if there is no such kind."""
    from marey_schemas.kinds import Kind

    try:
        return Kind(name)
    except ValueError:
        raise WrongUsage(f"{name!r} is not a kind of item; {suggestion(name, [*Kind], 'kinds')}") from None


def _existing(items: Any, item_id: str) -> ItemHandle | None:
    from marey_client.errors import NotFound

    try:
        found: ItemHandle = items.get(item_id)
    except NotFound:
        return None
    return found


# -- folders and items alike --


class FolderOrItem(Protocol):
    """Interface of folders and items for commands that organise a project."""

    @property
    def id(self) -> str: ...
    @property
    def kind(self) -> str: ...
    @property
    def place(self) -> str: ...

    def count(self) -> int:
        """Return the number of items that `delete` removes."""

    def move(self, folder: str, name: str) -> Collection | Item:
        """Move the folder or item to another folder, under a new name; return the moved folder or item."""

    def delete(self) -> None:
        """Delete the item, or the folder with its contents; `restore` restores what was deleted."""

    def restore(self) -> Collection | Item:
        """Restore the item or the folder after its deletion, and return it."""


@dataclass(frozen=True)
class Folder:
    """A folder with its contents, as the target of a command that moves, deletes or restores items or folders."""

    project: ProjectHandle
    collection: Collection
    kind = FOLDER

    @property
    def id(self) -> str:
        """The folder's id."""
        return self.collection.id

    @property
    def place(self) -> str:
        """The project and the path of the folder, as in `project/folder`."""
        return f"{self.project.name}/{self.collection.path}"

    def count(self) -> int:
        """Return the number of items in the folder and below it."""
        from marey_schemas.kinds import Kind

        with ThreadPoolExecutor(REQUESTS_AT_ONCE) as pool:
            return sum(pool.map(lambda kind: self.project.items(kind).count(collection=self.collection.path), Kind))

    def move(self, folder: str, name: str) -> Collection:
        """Move and rename the folder."""
        return self.project.collections.move(self.collection, f"{folder}/{name}".lstrip("/"))

    def delete(self) -> None:
        """Delete the folder with its contents; it can be restored."""
        self.project.collections.delete(self.collection)

    def restore(self) -> Collection:
        """Restore the folder with the contents that were deleted along with it."""
        return self.project.collections.restore(self.collection)


@dataclass(frozen=True)
class SingleItem:
    """One item, as the target of a command that moves, deletes or restores items or folders."""

    handle: ItemHandle

    @property
    def id(self) -> str:
        """The item's id."""
        return self.handle.id

    @property
    def kind(self) -> str:
        """The kind of the item."""
        return self.handle.item.kind.value

    @property
    def place(self) -> str:
        """The project and the path of the item, as in `project/folder/name`."""
        return f"{self.handle.project}/{self.handle.path}"

    def count(self) -> int:
        """Return 1: `delete` removes one item."""
        return 1

    def move(self, folder: str, name: str) -> Item:
        """Move and rename the item."""
        from marey_schemas.items import ItemChange

        return self.handle.change(ItemChange(collection=folder, name=name))

    def delete(self) -> None:
        """Delete the item; it can be restored."""
        self.handle.delete()

    def restore(self) -> Item:
        """Restore the item."""
        return self.handle.restore()


def folder_or_item(marey: Marey, text: str, kind: str | None, *, deleted: bool = False) -> FolderOrItem:
    """Return the folder or item at an address; a final `/` means a folder.

    With `deleted`, look for deleted folders and items; if several are found, return the one that was deleted last.
    Raises `WrongUsage` if nothing is found, or if items of several kinds have this address.
    """
    address = Address.parse(text)
    if not address.path:
        raise WrongUsage(f"{text!r} is a project; give a folder or an item in it, or see `marey project --help`")
    wanted = FOLDER if address.is_folder else kind
    found = list(_folders_and_items(marey.project(address.project), address, wanted, deleted=deleted))
    kinds = list(dict.fromkeys(one.kind for one in found))
    if len(kinds) > 1:
        raise WrongUsage(f"several items are called {address}: a {' and a '.join(kinds)}; choose one with --kind")
    if not found:
        if not deleted:
            raise missing_place(marey, address, "no item or folder", _kinds_of(kind))
        raise WrongUsage(
            f"there is no deleted item or folder at {address}; `marey ls --deleted {address.project}` lists all that "
            "are deleted"
        )
    return found[0]


def items_selected(
    marey: Marey, places: Sequence[str], query: str, kind: str | None, *, deleted: bool = False
) -> list[SingleItem]:
    """Return the items of one kind, by default clips, that a query selects in projects, folders and their subfolders.

    The items of each place are sorted by path; an item in several places is returned once. With `deleted`, only deleted
    items are selected, including those in deleted folders. If several deleted items have the same path, the one that
    was deleted last comes first.

    Raises `WrongUsage` if a place is not a project or folder, or if the query selects nothing.
    """
    if kind == FOLDER:
        raise WrongUsage("--query selects items, not folders; give another --kind, or leave out --kind to select clips")
    wanted = kind_named(kind or "clip")
    found: dict[str, ItemHandle] = {}
    for place in places:
        address = Address.parse(place)
        project = marey.project(address.project)
        if address.path and not _is_folder(project, address.path, deleted=deleted):
            raise WrongUsage(f"there is no folder at {address}; --query selects items in projects and folders")
        items = _last_deleted_first(project.items(wanted).list(query=query, collection=address.path, deleted=deleted))
        found.update((one.id, one) for one in sorted(items, key=lambda one: one.path))
    if not found:
        hint = "`marey ls PLACE --query … --explain` counts the items that each condition hides"
        if deleted:
            hint = "`marey ls --deleted PLACE` lists the items that can be restored"
        what = f"deleted item of the kind {wanted}" if deleted else f"item of the kind {wanted}"
        raise WrongUsage(f"the query selects no {what} in {', '.join(places)}; {hint}")
    return list(map(SingleItem, found.values()))


def _is_folder(project: ProjectHandle, path: str, *, deleted: bool) -> bool:
    """Return whether there is a folder at a path; with `deleted`, whether there is a deleted folder."""
    folders = project.collections
    return folders.at(path) is not None or (deleted and folders.at(path, deleted=True) is not None)


def _last_deleted_first(items: Iterable[ItemHandle]) -> list[ItemHandle]:
    return sorted(items, key=lambda one: one.item.deleted_at or one.item.created_at, reverse=True)


def require_apart(targets: Sequence[FolderOrItem]) -> None:
    """Raise `WrongUsage` if an address is given twice, or is inside a folder that is also given."""
    for place, one in enumerate(targets):
        for other in (*targets[:place], *targets[place + 1 :]):
            if other.id == one.id:
                raise WrongUsage(f"{one.place} is named twice in the command; name it once")
            if other.kind == FOLDER and one.place.startswith(f"{other.place}/"):
                raise WrongUsage(
                    f"{one.place} is inside {other.place}, and the command names both; name only one of them"
                )


def _kinds_of(kind: str | None) -> Sequence[Kind]:
    """Return the kinds of items that an option selects: all kinds if `kind` is None, and none for folders."""
    from marey_schemas.kinds import Kind

    return () if kind == FOLDER else tuple(Kind) if kind is None else (kind_named(kind),)


def _folders_and_items(
    project: ProjectHandle, address: Address, kind: str | None, *, deleted: bool
) -> Iterator[FolderOrItem]:
    """Yield the folders at an address, then the items at this address.

    With `deleted`, yield deleted folders and items; for each kind, the most recently deleted one comes first.
    """
    if kind in (None, FOLDER) and (folder := _folder(project, address, deleted=deleted)) is not None:
        yield Folder(project, folder)
    if kind == FOLDER:
        return

    def of_kind(one: Kind) -> list[ItemHandle]:
        return _items(project, address, one, deleted=deleted)

    with ThreadPoolExecutor(REQUESTS_AT_ONCE) as pool:
        for items in pool.map(of_kind, _kinds_of(kind)):
            yield from map(SingleItem, items)


def _folder(project: ProjectHandle, address: Address, *, deleted: bool) -> Collection | None:
    if address.name.startswith(f"{FOLDER}_") and address.has_id:
        return next((one for one in project.collections.list(deleted=deleted) if one.id == address.name), None)
    return project.collections.at(address.path, deleted=deleted)


def _items(project: ProjectHandle, address: Address, kind: Kind, *, deleted: bool) -> list[ItemHandle]:
    items = project.items(kind)
    found: list[ItemHandle] = []
    if not address.has_id:
        found += items.list(path=address.path, deleted=deleted)
    elif address.name.startswith(f"{kind.value}_"):
        found += (one for one in items.list(deleted=deleted) if one.id == address.name)
    return _last_deleted_first(found)
