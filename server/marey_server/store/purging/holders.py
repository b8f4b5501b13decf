"""Search for holders, which prevent the purge of items: versions of datasets, other items, and unfinished jobs."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

from sqlalchemy import Row, Select, func, select

from marey_schemas.kinds import Kind
from marey_schemas.purges import MOST_HOLDERS, Holder, ItemHolder, JobHolder
from marey_schemas.queue.jobs import JobState
from marey_server.store.purging.naming_jobs import jobs_naming
from marey_server.store.tables import collection, document_item, item, revision_part
from marey_server.store.transaction import Transaction


@dataclass
class FoundHolders:
    """Holders of one item, which prevent its purge; the first `MOST_HOLDERS` are named, the others only counted."""

    holders: list[Holder] = field(default_factory=list)
    others: int = 0

    def add(self, holder: Holder, more: int = 0) -> None:
        """Add a holder, and a number of further holders that are not known by name."""
        if len(self.holders) < MOST_HOLDERS:
            self.holders.append(holder)
        else:
            self.others += 1
        self.others += more


def find_holders(
    tx: Transaction,
    project_id: str,
    rows: Mapping[str, Row[Any]],
    versions: Mapping[str, Iterable[Holder]],
    copies: Mapping[str, Collection[str]],
) -> dict[str, FoundHolders]:
    """Return, by the id of an item, the holders that prevent its purge; items without holders are left out.

    `rows` are the items that are to be purged together. An item in `rows` that refers to another item in `rows` is a
    holder of the other item only if it has a holder itself. `versions` are the holders that a `VersionSearch` has
    found. `copies` maps the ids of indexes of motions to the ids of the clips whose poses they contain; an index in
    `rows` counts as referring to these clips.
    """
    held: dict[str, FoundHolders] = {}
    for item_id, found in versions.items():
        for holder in found:
            held.setdefault(item_id, FoundHolders()).add(holder)
    for item_id, jobs in _unfinished_jobs(tx, project_id, rows.keys()).items():
        for job in jobs.values():
            held.setdefault(item_id, FoundHolders()).add(job)
    _add_referring(tx, project_id, rows.keys(), held)
    refers = _references_among(tx, rows.keys())
    for index, clips in copies.items():
        refers.setdefault(index, []).extend(sorted(rows.keys() & set(clips)))
    _spread(refers, rows, held)
    return held


def _unfinished_jobs(tx: Transaction, project_id: str, items: Collection[str]) -> dict[str, dict[str, JobHolder]]:
    """Return the unfinished jobs that name items, by the id of the item, then by the id of the job.

    The parent job takes the place of its tasks.
    """
    found: dict[str, dict[str, JobHolder]] = {}
    for one in jobs_naming(tx, project_id, items, unfinished=True):
        whole = one.parent or one.id
        for item_id in one.named:
            found.setdefault(item_id, {})[whole] = JobHolder(job=whole, kind=one.kind, state=JobState(one.state))
    return found


def _references(items: Collection[str]) -> Select[*tuple[Any, ...]]:
    """Return a query for the references to `items` from other items.

    The column `held` is the id of an item in `items`, and the column `by` the id of an item that refers to it.
    """
    return (
        select(document_item.c.item_id.label("held"), revision_part.c.item_id.label("by"))
        .join(revision_part, revision_part.c.document_digest == document_item.c.document_digest)
        .where(document_item.c.item_id.in_(items), revision_part.c.item_id != document_item.c.item_id)
        .distinct()
    )


def _add_referring(tx: Transaction, project_id: str, items: Collection[str], held: dict[str, FoundHolders]) -> None:
    """Add holders to `held`: the items of the project that are not in `items` and whose documents refer to `items`."""
    referring = (
        _references(items)
        .join(item, item.c.id == revision_part.c.item_id)
        .where(item.c.project_id == project_id, item.c.id.not_in(items))
        .subquery()
    )
    placed = select(
        referring.c.held,
        referring.c.by,
        func.row_number().over(partition_by=referring.c.held, order_by=referring.c.by).label("place"),
        func.count().over(partition_by=referring.c.held).label("total"),
    ).subquery()
    shown = (
        select(placed.c.held, placed.c.place, placed.c.total, item, collection.c.path)
        .join(item, item.c.id == placed.c.by)
        .join(collection, collection.c.id == item.c.collection_id)
        .where(placed.c.place <= MOST_HOLDERS)
        .order_by(placed.c.held, placed.c.place)
    )
    for row in tx.execute(shown):
        unnamed = row.total - MOST_HOLDERS if row.place == MOST_HOLDERS else 0
        held.setdefault(row.held, FoundHolders()).add(_holder(row), max(0, unnamed))


def _references_among(tx: Transaction, items: Collection[str]) -> dict[str, list[str]]:
    """Return the references among `items`: by the id of an item, the ids of the items to which its documents refer."""
    found: dict[str, list[str]] = {}
    for row in tx.execute(_references(items).where(revision_part.c.item_id.in_(items))):
        found.setdefault(row.by, []).append(row.held)
    return found


def _spread(refers: Mapping[str, Iterable[str]], rows: Mapping[str, Row[Any]], held: dict[str, FoundHolders]) -> None:
    """Make each item in `held` a holder of the items to which it refers (`refers`), and so on.

    An item that has a holder is not purged, so the items to which it refers cannot be purged either.
    """
    waiting = sorted(held)
    spread = set(waiting)
    while waiting:
        by = waiting.pop()
        for item_id in sorted(refers.get(by, ())):
            held.setdefault(item_id, FoundHolders()).add(_holder(rows[by]))
            if item_id not in spread:
                spread.add(item_id)
                waiting.append(item_id)


def _holder(row: Row[Any]) -> ItemHolder:
    path = f"{row.path}/{row.name}".lstrip("/")
    return ItemHolder(item=row.id, kind=Kind(row.kind), path=path, deleted=row.deleted_us is not None)
