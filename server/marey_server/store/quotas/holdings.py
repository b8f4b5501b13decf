"""Quotas of items and their bytes, for projects and for the users who created the items.

Their counters are in the table `holding`. The transaction that adds or deletes items changes the counters, so they are
always exact.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

from sqlalchemy import Column, Row, bindparam, exists, func, select, text, update

from marey_schemas.access import QuotaChange, QuotasInUse, QuotaUse
from marey_server.store.database.prepared import Prepared
from marey_server.store.quotas.counting import exceeded
from marey_server.store.tables import document, holding, item, revision_part
from marey_server.store.transaction import Transaction


@dataclass(frozen=True, slots=True)
class ItemTotals:
    """Numbers that the quotas count: of items, and of the bytes of their revisions."""

    items: int = 0
    stored_bytes: int = 0

    def __str__(self) -> str:
        return f"{self.items:,} items of {self.stored_bytes:,} bytes"

    def __add__(self, more: ItemTotals) -> ItemTotals:
        return ItemTotals(self.items + more.items, self.stored_bytes + more.stored_bytes)


COUNTED = ("items", "stored_bytes")
"""Quotas whose counters are in the table `holding`."""

_NOUNS = {"items": "items", "stored_bytes": "bytes of items"}
_REMEDY = "Delete items that nobody needs, or ask an administrator for a higher limit (`marey {of} quota`)."

_ADD = Prepared(
    update(holding)
    .where(holding.c.owner_id == bindparam("owner"))
    .values({name: holding.c[name] + bindparam(f"more_{name}") for name in COUNTED})
    .returning(*holding.c)
)


def by_creator(rows: Iterable[Row[Any]]) -> dict[str | None, ItemTotals]:
    """Return the number of items and bytes of each creator, from rows of items with `creator_id` and `stored_bytes`."""
    held: dict[str | None, ItemTotals] = {}
    for row in rows:
        held[row.creator_id] = held.get(row.creator_id, ItemTotals()) + ItemTotals(1, row.stored_bytes)
    return held


def count_added(tx: Transaction, project_id: str, more: Mapping[str | None, ItemTotals]) -> None:
    """Add items and bytes to the counters of a project and of the creators of these items.

    The counters are locked until the transaction ends, so that no concurrent writes exceed a quota together. Raises
    `QuotaExceededProblem`; the caller must then roll back.
    """
    total = sum(more.values(), ItemTotals())
    if total == ItemTotals():
        return
    _count_added(tx, "project", project_id, total)
    for creator_id in sorted(filter(None, more)):
        _count_added(tx, "user", creator_id, more[creator_id])


def _count_added(tx: Transaction, of: str, owner_id: str, more: ItemTotals) -> None:
    row = _add(tx, owner_id, more)
    for name in COUNTED:
        used, added, limit = getattr(row, name), getattr(more, name), limit_of(tx, of, name, row.limits)
        if added and used > limit:
            subject = "The project has" if of == "project" else "The user who created the items has"
            remedy = _REMEDY.format(of=of)
            raise exceeded(subject, f"{of}_{name}", _NOUNS[name], used - added, limit, added, remedy)


def limit_of(tx: Transaction, of: str, name: str, limits: Mapping[str, int]) -> int:
    """Return the value of a quota for one project or user.

    `of` is "project" or "user", and `name` is "items" or "stored_bytes". `limits` are the values that an administrator
    has set for this project or user; a quota that is not among them has its value from the server's settings.
    """
    return limits.get(name, getattr(tx.quotas, f"{of}_{name}"))


def count_removed(tx: Transaction, project_id: str, less: Mapping[str | None, ItemTotals]) -> None:
    """Subtract items and bytes from the counters of a project and of the creators of these items."""
    total = sum(less.values(), ItemTotals())
    for owner_id, held in ((project_id, total), *sorted((one, less[one]) for one in less if one is not None)):
        if held != ItemTotals():
            _add(tx, owner_id, ItemTotals(-held.items, -held.stored_bytes))


def _add(tx: Transaction, owner_id: str, more: ItemTotals) -> Any:
    given = {"owner": owner_id, "more_items": more.items, "more_stored_bytes": more.stored_bytes}
    row = tx.first(_ADD, given)
    if row is None:
        tx.execute(tx.insert_or_ignore(holding, {"owner_id": owner_id, "limits": {}}))
        row = tx.first(_ADD, given)
    return row


# -- limits -----------------------------------------------------------------------------------------------------------


def show_quotas(tx: Transaction, of: Literal["project", "user"], owner_id: str) -> QuotasInUse:
    """Return the use and the limits of the quotas of a project or a user."""
    row = tx.execute(select(holding).where(holding.c.owner_id == owner_id)).first()
    limits = {} if row is None else row.limits
    return QuotasInUse(
        **{
            name: QuotaUse(used=0 if row is None else getattr(row, name), allowed=limit_of(tx, of, name, limits))
            for name in COUNTED
        }
    )


def change_limits(tx: Transaction, owner_id: str, change: QuotaChange) -> dict[str, int]:
    """Change the limits of items and bytes of a project or user; return all limits that an administrator has set."""
    changed = _add(tx, owner_id, ItemTotals()).limits | change.model_dump(exclude_unset=True, include=set(COUNTED))
    limits = {name: limit for name, limit in changed.items() if limit is not None}
    tx.execute(update(holding).where(holding.c.owner_id == owner_id).values(limits=limits))
    return limits


# -- checks -----------------------------------------------------------------------------------------------------------

_BEFORE = revision_part.alias("before")
_UNCHANGED = exists().where(
    _BEFORE.c.item_id == revision_part.c.item_id,
    _BEFORE.c.number == revision_part.c.number - 1,
    _BEFORE.c.part == revision_part.c.part,
    _BEFORE.c.document_digest == revision_part.c.document_digest,
)
BYTES_OF_ITEM = (
    select(func.coalesce(func.sum(document.c.size_bytes + document.c.file_bytes), 0))
    .join(revision_part, revision_part.c.document_digest == document.c.digest)
    .where(revision_part.c.item_id == item.c.id, ~_UNCHANGED)
    .correlate(item)
    .scalar_subquery()
)
"""SQL expression for the bytes of all revisions of an item; a part counts in each revision that changed it."""


_SUMS = (func.count().label("items"), func.coalesce(func.sum(item.c.stored_bytes), 0).label("stored_bytes"))


def count_held(tx: Transaction, owner: Column[str], owner_id: str) -> ItemTotals:
    """Return the numbers of items and bytes of a project or a user, counted item by item.

    `owner` is the column of `item` that names the project or user.
    """
    row = tx.execute(select(*_SUMS).where(owner == owner_id, item.c.deleted_us.is_(None))).one()
    return ItemTotals(row.items, int(row.stored_bytes))


def read_held(tx: Transaction, owner_id: str) -> ItemTotals:
    """Return the number of items and bytes of a project or a user from the counters."""
    row = tx.execute(select(holding.c["items"], holding.c.stored_bytes).where(holding.c.owner_id == owner_id)).first()
    return ItemTotals() if row is None else ItemTotals(row.items, row.stored_bytes)


def recount(tx: Transaction) -> None:
    """Count all items and bytes, and set the counters. Other writes of items wait until the transaction ends."""
    if tx.is_postgres:
        tx.execute(text("LOCK TABLE item IN SHARE ROW EXCLUSIVE MODE"))
    tx.execute(update(item).where(item.c.stored_bytes != BYTES_OF_ITEM).values(stored_bytes=BYTES_OF_ITEM))
    tx.execute(update(holding).values(items=0, stored_bytes=0))
    for owner in (item.c.project_id, item.c.creator_id):
        sums = select(owner.label("owner_id"), *_SUMS).where(item.c.deleted_us.is_(None), owner.is_not(None))
        for row in tx.execute(sums.group_by(owner)).all():
            _add(tx, row.owner_id, ItemTotals(row.items, int(row.stored_bytes)))
