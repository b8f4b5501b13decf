"""Ends fan-outs: combines the results of tasks, or queues the gathering job so that a worker does."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from typing import Any

from sqlalchemy import and_, delete, select, update

from marey_schemas.jobs import FailureReason
from marey_server.store.jobs.endings import Ended, end_jobs, failure_document
from marey_server.store.jobs.events import wake_workers
from marey_server.store.jobs.fencing import RUNNING
from marey_server.store.tables import job, job_blob, staged_output
from marey_server.store.transaction import Transaction

MOST_GATHERED = 1000
"""Largest number of entries of a list, such as refusals, in a combined result."""


def gather(tx: Transaction, parent_id: str) -> list[Ended]:
    """End the gathering job, all of whose tasks have ended, or queue it where a worker is to gather what they brought.

    It goes on or has succeeded if they all have; else it is cancelled if that was asked for, and failed if a task
    failed.
    """
    head = tx.execute(select(job.c.kind, job.c.gathers, job.c.cancel_requested_us).where(job.c.id == parent_id)).one()
    rows = tx.execute(
        select(job.c.id, job.c.state, job.c.result, job.c.failure)
        .where(job.c.parent_id == parent_id)
        .order_by(job.c.position)
    ).all()
    result = {"tasks": len(rows), **combine_results(row.result for row in rows if row.result is not None)}
    running = and_(job.c.id == parent_id, job.c.state == RUNNING)
    failed = [row for row in rows if row.state == "failed"]
    if failed and head.cancel_requested_us is None:
        first = failed[0]
        failure = failure_document(
            FailureReason(first.failure["reason"]),
            first.failure["code"],
            f"{len(failed)} of {len(rows)} tasks failed; the first, {first.id}: {first.failure['detail']}",
        )
        return end_jobs(tx, running, "failed", failure=failure, result=result)
    succeeded = all(row.state == "succeeded" for row in rows)
    if succeeded and head.gathers and head.cancel_requested_us is None:
        tx.execute(update(job).where(running).values(state="queued", rev=job.c.rev + 1))
        wake_workers(tx, [head.kind])
        return []
    state = "succeeded" if succeeded and not head.gathers else "cancelled"
    return end_jobs(tx, running, state, result=result)


def release_tasks(tx: Transaction, gathered: Collection[str]) -> None:
    """Delete the results of the tasks of these jobs, which have been gathered.

    The blobs they named may be collected, and the tasks answer no later job: the gathered result does.
    """
    tasks = select(job.c.id).where(job.c.parent_id.in_(gathered))
    tx.execute(delete(job_blob).where(job_blob.c.job_id.in_(tasks)))
    tx.execute(delete(staged_output).where(staged_output.c.job_id.in_(tasks)))
    tx.execute(update(job).where(job.c.parent_id.in_(gathered)).values(cache_key=None))


def combine_results(results: Iterable[dict[str, Any]]) -> dict[str, Any]:
    """Numbers are added up, lists put together (the first thousand entries), tables combined; other facts stay with the
    tasks.
    """
    combined: dict[str, Any] = {}
    for result in results:
        for name, value in result.items():
            combined[name] = _combine(combined.get(name), value)
    return {name: value for name, value in combined.items() if value is not None}


def _combine(known: Any, value: Any) -> Any:
    """Combine a value with one more; values of different types are omitted."""
    if isinstance(value, int | float) and not isinstance(value, bool):
        return value + (known if isinstance(known, int | float) else 0)
    if isinstance(value, list):
        return [*(known if isinstance(known, list) else []), *value][:MOST_GATHERED]
    if isinstance(value, dict):
        return combine_results([known if isinstance(known, dict) else {}, value])
    return known
