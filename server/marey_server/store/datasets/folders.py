"""Folders of datasets: their present content as entries, and the changes since a version."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from operator import attrgetter
from typing import Any

from sqlalchemy import Row, Select, select

from marey_server.errors import InvalidProblem
from marey_server.store import collections
from marey_server.store.datasets.contents import Contents, find_contents_of
from marey_server.store.projects import ProjectRow
from marey_server.store.tables import collection, item, item_tag
from marey_server.store.transaction import Transaction, in_lists
from marey_versions.records import DatasetEntry, RevisionKey
from marey_versions.tree.chunks import Value
from marey_versions.tree.reading import Tree


@dataclass(frozen=True)
class FolderState:
    """Current content of a folder: its entries, and the items from which they were made, both by entry key."""

    entries: Mapping[str, Value]
    items: Mapping[str, Row[Any]]
    contents: Contents

    def changes_since(self, before: Tree) -> dict[str, Value | None]:
        """Return, by entry key, the changes that turn a tree into the entries of the folder; None removes an entry."""
        changes: dict[str, Value | None] = dict(self.entries)
        for key, value in before.entries():
            if key not in self.entries:
                changes[key] = None
            elif self.entries[key] == value:
                del changes[key]
        return changes


def read_folder(tx: Transaction, project_row: ProjectRow, found: Row[Any]) -> FolderState:
    """Return the current content of a dataset's folder.

    Raises `InvalidProblem` if the dataset has no folder, or if the folder was deleted.
    """
    if found.path is None:
        raise InvalidProblem(
            f"The dataset {found.name!r} has no folder: nothing can be checked out, and a commit must list its changes "
            "in the request.",
            code="no-folder",
        )
    if found.folder_deleted_us is not None:
        raise InvalidProblem(
            f"The folder {found.path!r} of the dataset is deleted; restore it first.",
            code="folder-deleted",
            unnamed="The folder of the dataset is deleted; restore it first.",
        )
    rows = tx.execute(_items_in(project_row, found.path)).all()
    contents = find_contents_of(tx, project_row.id, [RevisionKey(row.id, row.head) for row in rows])
    tags = tags_of(tx, [row.id for row in rows])
    entries, items = {}, {}
    for row in rows:
        parts = contents.parts[RevisionKey(row.id, row.head)]
        entry = DatasetEntry(_below(found.path, row.path, row.name), row.kind, parts, tags.get(row.id, ()))
        entries[entry.key] = entry.value
        items[entry.key] = row
    return FolderState(entries, items, contents)


def _items_in(project_row: ProjectRow, path: str) -> Select[*tuple[Any, ...]]:
    return (
        select(item.c.id, item.c.kind, item.c.name, item.c.head, collection.c.path)
        .join(collection, collection.c.id == item.c.collection_id)
        .where(item.c.project_id == project_row.id, item.c.deleted_us.is_(None), collections.at_or_below(path))
    )


def _below(folder: str, path: str, name: str) -> str:
    """Return the path of an item relative to the folder of a dataset."""
    inside = path[len(folder) :].lstrip("/")
    return f"{inside}/{name}" if inside else name


def tags_of(tx: Transaction, item_ids: Sequence[str]) -> dict[str, tuple[str, ...]]:
    """Return the tags of items, sorted, by item id; items without tags are left out."""
    rows: list[Row[Any]] = []
    for some in in_lists(item_ids):
        of_items = item_tag.c.item_id.in_(some)
        rows += tx.execute(select(item_tag).where(of_items).order_by(item_tag.c.item_id, item_tag.c.tag)).all()
    return {of: tuple(row.tag for row in group) for of, group in groupby(rows, attrgetter("item_id"))}
