"""Erasure of items: their content, names and tags, and the traces of these in jobs and events.

What remains of an item is a row with its id, its kind, the times of its creation, deletion and purge, and one row for
each revision, with its number, its time and the job that made it. Rows of `lineage` refer to these.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any

from sqlalchemy import ColumnElement, Row, Text, cast, delete, exists, func, or_, select, update
from sqlalchemy.dialects.postgresql import ARRAY, array

from marey_schemas.kinds import Kind
from marey_server.store import collections
from marey_server.store.jobs.result_cache import forget_results
from marey_server.store.projects import ProjectRow
from marey_server.store.tables import attempt, collection, dataset, event, item, item_tag, job, revision, revision_part
from marey_server.store.transaction import IN_LIST, Transaction


def erase(tx: Transaction, project_row: ProjectRow, rows: Sequence[Row[Any]], jobs: Sequence[str], at_us: int) -> None:
    """Erase deleted items, and record an event for each; `jobs` are the jobs that name one of them."""
    ids = [row.id for row in rows]
    _forget_in_jobs(tx, frozenset(ids), jobs)
    _forget_in_events(tx, ids, "name", "collection")
    tx.execute(delete(revision_part).where(revision_part.c.item_id.in_(ids)))
    tx.execute(delete(item_tag).where(item_tag.c.item_id.in_(ids)))
    bare = {"author_id": None, "message": "", "content": None}
    tx.execute(update(revision).where(revision.c.item_id.in_(ids)).values(**bare))
    empty = {
        "name": "", "name_folded": "", "summary": {}, "frames": 0, "skeleton_id": None, "creator_id": None,
        "stored_bytes": 0, "collection_id": collections.ensure(tx, project_row, ""),
    }  # fmt: skip
    changed = {"purged_us": at_us, "updated_us": tx.now_us, "rev": item.c.rev + 1}
    tx.execute(update(item).where(item.c.id.in_(ids)).values(**empty, **changed))
    _drop_empty_folders(tx, project_row.id, {row.path for row in rows})
    tx.emit_each(("item.purged", project_row.id, row.id, {"item_kind": Kind(row.kind).value}) for row in rows)


# -- jobs -------------------------------------------------------------------------------------------------------------


def _forget_in_jobs(tx: Transaction, items: frozenset[str], jobs: Sequence[str]) -> None:
    """Remove the names of items from the inputs and outputs of jobs, and forget the results that these items were."""
    makers: list[str] = []
    for start in range(0, len(jobs), IN_LIST):
        some = select(job.c.id, job.c.inputs, job.c.outputs).where(job.c.id.in_(jobs[start : start + IN_LIST]))
        for row in tx.execute(some.order_by(job.c.id).with_for_update()).all():
            inputs, outputs = _without_names(row.inputs, items), _outputs_without_names(row.outputs, items)
            if outputs != row.outputs:
                makers.append(row.id)
            if (inputs, outputs) != (row.inputs, row.outputs):
                tx.execute(update(job).where(job.c.id == row.id).values(inputs=inputs, outputs=outputs))
    _forget_in_answers(tx, items, makers)
    forget_results(tx, makers)


def _forget_in_answers(tx: Transaction, items: Collection[str], jobs: Sequence[str]) -> None:
    """Remove the names of items from the answers to workers, which are stored in case that a worker asks again."""
    for start in range(0, len(jobs), IN_LIST):
        some = select(attempt.c.job_id, attempt.c.fence, attempt.c.answer).where(
            attempt.c.job_id.in_(jobs[start : start + IN_LIST]), attempt.c.answer.is_not(None)
        )
        for row in tx.execute(some).all():
            answer = {**row.answer, "outputs": _outputs_without_names(row.answer.get("outputs"), items)}
            if answer["outputs"] is not None:
                this = attempt.c.job_id == row.job_id, attempt.c.fence == row.fence
                tx.execute(update(attempt).where(*this).values(answer=answer))


def _without_names(inputs: Mapping[str, Any], items: Collection[str]) -> dict[str, Any]:
    """Return the inputs of a job without the names and folders of `items`; they get the member `purged` instead.

    An input whose items were distributed over tasks has no list of items, and is unchanged.
    """
    return {
        name: [_purged_pin(pin) if pin.get("item") in items else pin for pin in pins]
        if isinstance(pins, list)
        else pins
        for name, pins in inputs.items()
    }


def _purged_pin(pin: Mapping[str, Any]) -> dict[str, Any]:
    kept = {key: value for key, value in pin.items() if key != "below"}
    return {**kept, "name": "", "collection": "", "purged": True}


def _outputs_without_names(
    outputs: Iterable[Mapping[str, Any]] | None, items: Collection[str]
) -> list[Mapping[str, Any]] | None:
    if outputs is None:
        return None
    return [
        {**{key: value for key, value in one.items() if key != "entry"}, "name": "", "purged": True}
        if one["item"] in items
        else one
        for one in outputs
    ]


# -- events and folders -----------------------------------------------------------------------------------------------


def _forget_in_events(tx: Transaction, ids: Sequence[str], *members: str) -> None:
    """Remove members, which contain names, from the events about items or folders."""
    body: ColumnElement[Any] = func.json_remove(event.c.body, *(f"$.{name}" for name in members))
    if tx.is_postgres:
        body = event.c.body.op("-", return_type=event.c.body.type)(cast(array(members), ARRAY(Text)))
    for start in range(0, len(ids), IN_LIST):
        about = event.c.subject.in_(ids[start : start + IN_LIST])
        tx.execute(update(event).where(about).values(body=body))


def _drop_empty_folders(tx: Transaction, project_id: str, paths: Collection[str]) -> None:
    """Delete deleted folders, at `paths` and above, that contain no items any more, and their names in events.

    Folders that a dataset needs remain.
    """
    parts = [path.split("/") for path in paths if path]
    above = {"/".join(names[:count]) for names in parts for count in range(1, len(names) + 1)}
    inner, placed = collection.alias("inner"), item.alias("placed")
    within = or_(
        inner.c.path == collection.c.path,
        func.substr(inner.c.path, 1, func.length(collection.c.path) + 1) == collection.c.path + "/",
    )
    holds_items = (
        exists()
        .where(inner.c.project_id == project_id, inner.c.deleted_us.is_not(None), within)
        .where(placed.c.collection_id == inner.c.id)
    )
    used = exists().where(dataset.c.collection_id == collection.c.id)
    empty = (collection.c.project_id == project_id, collection.c.deleted_us.is_not(None), ~holds_items, ~used)
    chosen = sorted(above)
    for start in range(0, len(chosen), IN_LIST):
        some = collection.c.path.in_(chosen[start : start + IN_LIST])
        dropped = tx.execute(delete(collection).where(*empty, some).returning(collection.c.id)).scalars().all()
        _forget_in_events(tx, dropped, "path", "was")
