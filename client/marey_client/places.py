"""Inputs of jobs in the forms that callers can use: paths, handles or ids of items, paths of folders, or several."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TypeAlias, TypeVar

from marey_client.errors import NotFound
from marey_client.handles.datasets import Datasets
from marey_client.items import ItemHandle, Items
from marey_client.listing.paths import is_folder
from marey_schemas.datasets.commits import Entry
from marey_schemas.items import Item
from marey_schemas.queue.jobs import CollectionInput, DatasetInput, ExistingInput, ItemInput

Handle = TypeVar("Handle", bound=ItemHandle)

Place: TypeAlias = str | ExistingInput | Handle
"""Path of a folder or an item, id or handle of an item, or an input of jobs."""

Places: TypeAlias = Place[Handle] | Sequence[Place[Handle]]


def resolved(items: Items[Handle], places: Places[Handle]) -> list[ExistingInput | Handle]:
    """Look up the texts among `places`: folders and items by their paths, and items by their ids.

    If a folder and an item have the same path, the result is the folder. Raises `NoSuchPath`, which names the nearest
    path, if there is neither.
    """
    return [_looked_up(items, place) if isinstance(place, str) else place for place in _as_list(places)]


def _looked_up(items: Items[Handle], text: str) -> ExistingInput:
    path = text.strip("/")
    if not path or is_folder(items.transport, items.project, path):
        return CollectionInput(collection=path)
    return ItemInput(item=items[path].id)


def as_inputs(places: Places[Handle]) -> tuple[ExistingInput, ...]:
    """Return one or several folders or items as inputs of jobs; a handle stands for the revision that it has read."""
    return tuple(map(_as_input, _as_list(places)))


def items_at(items: Items[Handle], places: Places[Handle], *, sort: str | None = None) -> Iterator[Item]:
    """Yield the items in one or several inputs, at the revisions that the inputs name, or at the newest revisions.

    Items from a version of a dataset get the tags that this version contains.
    """
    for place in _as_list(places):
        if isinstance(place, ItemHandle):
            yield place.item
        elif isinstance(place, ItemInput):
            item = items.get(place.item).item
            yield item if place.revision is None else item.model_copy(update={"revision": place.revision})
        elif isinstance(place, DatasetInput):
            for entry, item in entries_at(items, place):
                yield item.model_copy(update={"revision": entry.revision, "tags": entry.tags})
        else:
            folder = place.strip("/") if isinstance(place, str) else place.collection
            yield from (one.item for one in items.list(collection=folder, sort=sort))


def _as_list(places: Places[Handle]) -> list[Place[Handle]]:
    return [places] if isinstance(places, str | ExistingInput | ItemHandle) else list(places)


def entries_at(items: Items[Handle], place: DatasetInput) -> Iterator[tuple[Entry, Item]]:
    """Yield the entries of a version of a dataset that have the kind of `items`, each with its item of the project.

    The item may have been deleted since the commit. Entries without an item are left out.
    """
    dataset = Datasets(items.transport, items.project).at(place.dataset)
    folder = dataset.read().collection
    present = {} if folder is None else {one.id: one.item for one in items.list(collection=folder)}
    deleted: dict[str, Item] = {}
    for entry in dataset.entries(place.version, path=place.path):
        if entry.kind is not items.kind or entry.item is None:
            continue
        if entry.item not in present:
            try:
                present[entry.item] = items.get(entry.item).item
            except NotFound:
                deleted = deleted or {one.id: one.item for one in items.list(deleted=True)}
                if entry.item not in deleted:
                    raise
                present[entry.item] = deleted[entry.item]
        yield entry, present[entry.item]


def _as_input(place: Place[Handle]) -> ExistingInput:
    if isinstance(place, str):
        return CollectionInput(collection=place.strip("/"))
    return place.as_input() if isinstance(place, ItemHandle) else place
