"""Purges and their previews: prepared items are erased unless they have holders, which the answer names.

A holder of an item is a version of a dataset, another item, or an unfinished job that needs the item. An index of
motions contains copies of the poses of its clips, and can be built again. So it is no holder of a clip, but is erased
together with the clip.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from sqlalchemy import Row, select

from marey_schemas.kinds import Kind
from marey_schemas.purges import HeldItem, PurgeAnswer, PurgedItem, PurgeRequest, words_of
from marey_server import faults
from marey_server.errors import ApiProblem, ConflictProblem, NotFoundProblem
from marey_server.store import items, projects
from marey_server.store.items.reading import item_rows, was_purged
from marey_server.store.projects import ProjectRow
from marey_server.store.purge_lock import begin_purge
from marey_server.store.purging.candidates import PreparedPurge, contents_of, prepare_purge
from marey_server.store.purging.erasing import erase, freed_by
from marey_server.store.purging.holders import FoundHolders, find_holders
from marey_server.store.purging.naming_jobs import jobs_naming
from marey_server.store.purging.versions import VersionSearch
from marey_server.store.tables import item
from marey_server.store.transaction import Transaction

STILL_HELD = "still-held"
"""Code of the error for an item that is still needed; `context.holders` lists the objects that need the item."""


def preview_purge(tx: Transaction, project: str, request: PurgeRequest) -> PurgeAnswer:
    """Return what a purge would delete and what it would refuse to delete; change nothing.

    Raises the errors of `prepare_purge`. For a single item, also raises the errors of `record_purge`, except the error
    for an item that is still needed.
    """
    prepared = prepare_purge(tx, project, request)
    project_row = projects.require(tx, project)
    found = _examine(tx, project_row, request, prepared)
    return _answer(tx, project_row, request, prepared, found)


def record_purge(tx: Transaction, project: str, request: PurgeRequest, prepared: PreparedPurge) -> PurgeAnswer:
    """Purge the prepared items that have no holders, all in this transaction.

    Items that were restored since they were chosen are left out. If the request names a single item, raises
    `NotFoundProblem` if the item does not exist, and `GoneProblem` if it was purged already. Raises `ConflictProblem`
    if this item is not deleted, or if it has holders.
    """
    assert not request.preview, "a preview is a read"
    project_row = projects.require(tx, project)
    at_us = begin_purge(tx, project_row.id)
    found = _examine(tx, project_row, request, prepared)
    if request.item is not None and found.refused:
        raise _still_held(found.refused[0])
    answer = _answer(tx, project_row, request, prepared, found)
    for row in found.free:
        if row.deleted_us is None:  # an index of motions
            items.delete_item(tx, project, Kind(row.kind), row.id, expected_rev=None)
    if found.free:
        erase(tx, project_row, found.free, found.jobs, at_us)
        faults.point("purge.before_commit")
        tx.after_commit(lambda: faults.point("purge.after_commit"))
    return answer


@dataclass(frozen=True)
class _Examined:
    """Those of the prepared items that are still deleted: `free` can be purged, and `refused` have holders.

    `free` also contains the indexes of motions with poses of items in `free`, even if the indexes are not deleted.
    """

    free: Sequence[Row[Any]]
    refused: tuple[HeldItem, ...]
    jobs: Sequence[str]
    """Ids of all jobs that name an item that can be purged, and of their parent jobs. All these jobs have ended."""


def _examine(tx: Transaction, project_row: ProjectRow, request: PurgeRequest, prepared: PreparedPurge) -> _Examined:
    rows = _lock(tx, project_row, prepared, preview=request.preview)
    if request.item is not None and not rows:
        raise _not_deleted(tx, project_row, request.item)
    copies = prepared.copies.update(tx)
    indexes = _lock_rows(tx, project_row, sorted(copies.keys() - rows.keys()), preview=request.preview)
    both = {**rows, **indexes}
    held = find_holders(tx, project_row.id, both, _versions(tx, project_row, prepared, both), copies)
    freed = rows.keys() - held.keys()
    free = [row for item_id, row in rows.items() if item_id in freed]
    free += [row for item_id, row in indexes.items() if not freed.isdisjoint(copies[item_id])]
    naming = jobs_naming(tx, project_row.id, [row.id for row in free])
    jobs = {one.id for one in naming} | {one.parent for one in naming if one.parent is not None}
    refused = tuple(_refused(rows[item_id], held[item_id]) for item_id in prepared.ids if item_id in held)
    return _Examined(free, refused, sorted(jobs))


def _answer(
    tx: Transaction, project_row: ProjectRow, request: PurgeRequest, prepared: PreparedPurge, found: _Examined
) -> PurgeAnswer:
    """Return the answer to a purge: the purged and the refused items, and the freed bytes.

    Must be called before the items are erased.
    """
    return PurgeAnswer(
        preview=request.preview,
        purged=tuple(_purged(row, named=request.preview) for row in found.free),
        refused=found.refused,
        freed_bytes=freed_by(tx, project_row.id, [row.id for row in found.free], frozenset(found.jobs)),
        next=prepared.next,
    )


def _lock(tx: Transaction, project_row: ProjectRow, prepared: PreparedPurge, *, preview: bool) -> dict[str, Row[Any]]:
    """Return the rows of the prepared items that are still deleted, in their order; lock them, except for a preview."""
    found = _lock_rows(tx, project_row, prepared.ids, preview=preview)
    return {item_id: found[item_id] for item_id in prepared.ids if item_id in found and found[item_id].deleted_us}


def _lock_rows(tx: Transaction, project_row: ProjectRow, ids: Collection[str], *, preview: bool) -> dict[str, Row[Any]]:
    """Return, by id, the rows of the items `ids` that are not purged; lock the rows, except for a preview."""
    if not ids:
        return {}
    mine = (item.c.id.in_(ids), item.c.project_id == project_row.id, item.c.purged_us.is_(None))
    statement = item_rows().where(*mine).order_by(item.c.id)
    return {row.id: row for row in tx.execute(statement if preview else statement.with_for_update(of=item))}


def _not_deleted(tx: Transaction, project_row: ProjectRow, item_id: str) -> ApiProblem:
    """Return the error for a request to purge an item that is missing, purged already, or not deleted."""
    row = tx.execute(select(item).where(item.c.id == item_id, item.c.project_id == project_row.id)).first()
    if row is None:
        return NotFoundProblem(f"There is no item {item_id!r} in this project.", code="no-item")
    if row.purged_us is not None:
        return was_purged(Kind(row.kind), item_id, row.purged_us)
    return ConflictProblem(
        f"The {row.kind} {item_id!r} is not among the deleted items that the request selects; delete it first, or "
        "leave out the other conditions.",
        code="not-deleted",
    )


def _versions(
    tx: Transaction, project_row: ProjectRow, prepared: PreparedPurge, rows: Mapping[str, Row[Any]]
) -> dict[str, list[Any]]:
    """Return, by the id of an item, the datasets of which a version contains the item.

    The preparation has searched the versions already, so only commits that were added since are searched. If a revision
    has received a content digest since the preparation, all versions are searched again.
    """
    contents, parts = contents_of(tx, tuple(rows))
    search = prepared.search
    if not parts.keys() <= search.wanted.keys():
        search = VersionSearch(project_row.id, parts)
    search.update(tx)
    return search.holders(tx, contents)


def _purged(row: Row[Any], *, named: bool) -> PurgedItem:
    return PurgedItem(item=row.id, kind=Kind(row.kind), path=_path(row) if named else "")


def _refused(row: Row[Any], held: FoundHolders) -> HeldItem:
    return HeldItem(item=row.id, kind=Kind(row.kind), path=_path(row), holders=tuple(held.holders), others=held.others)


def _path(row: Row[Any]) -> str:
    return f"{row.path}/{row.name}".lstrip("/")


def _still_held(refused: HeldItem) -> ConflictProblem:
    more = f" and {refused.others:,} more" if refused.others else ""
    return ConflictProblem(
        f"The {refused.kind} {refused.path!r} cannot be purged, because it is still needed by "
        f"{', '.join(map(words_of, refused.holders))}{more}.",
        code=STILL_HELD,
        context=refused.model_dump(mode="json"),
    )
