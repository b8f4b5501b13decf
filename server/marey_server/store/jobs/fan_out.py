"""End of fan-outs: combines the results of tasks, or queues the parent job so that a worker combines them.

A commit of many outputs takes seconds. If the transaction that ends the last task made such a commit, other writers
would wait. So the parent job stays in the state `running`, without unfinished tasks, until `finishing` has ended it.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from typing import Any

from sqlalchemy import ColumnElement, and_, delete, not_, select, update

from marey_schemas.queue.job_kinds import UnknownKindError, find_kind
from marey_schemas.queue.jobs import NOTHING_DONE, FailureReason, nothing_done
from marey_server.store.jobs import commits
from marey_server.store.jobs.endings import Ended, end_jobs, failure_document
from marey_server.store.jobs.events import wake_workers
from marey_server.store.jobs.fencing import RUNNING
from marey_server.store.tables import dataset_commit, job, job_blob, staged_output
from marey_server.store.transaction import Transaction
from marey_server.store.wakeups import OUTPUTS_TO_COMMIT, wakeups

MOST_GATHERED = 1000
"""Greatest number of entries in a list of a combined result, such as its refusals."""
MOST_AT_END = 1_000
"""Greatest number of entries that are committed in the transaction that ends the last task."""

DEFERRED: ColumnElement[bool] = and_(
    job.c.state == RUNNING,
    job.c.lease_expires_us.is_(None),
    job.c.size.is_not(None),
    not_(job.c.gathers),
    job.c.dependencies_left == 0,
    job.c.commit_to.is_not(None),
)
"""Condition for jobs whose outputs are still to be committed, although all their tasks have ended."""


def gather(tx: Transaction, parent_id: str) -> list[Ended]:
    """End a parent job whose tasks have all ended; return the jobs that ended.

    If a task failed, the parent job fails. If no task failed, but some did not succeed, the parent job is cancelled. If
    all tasks succeeded, there are four cases:

    * If a worker must combine the results of the tasks, the parent job is queued. The returned list is empty.
    * If the tasks refused all inputs, and the kind declares that this is a failure, the parent job fails.
    * If the outputs are too many to be committed in this transaction, the module `finishing` commits them later. The
      returned list is empty.
    * Otherwise, the parent job succeeds, or fails if its outputs cannot be committed.

    If the cancellation of the parent job was requested before, the job is cancelled in two cases: a task did not
    succeed, or a worker must combine the results of the tasks.
    """
    columns = (*commits.JOB_COLUMNS, job.c.gathers, job.c.cancel_requested_us)
    head = tx.execute(select(*columns).where(job.c.id == parent_id)).one()
    rows = tx.execute(
        select(job.c.id, job.c.state, job.c.result, job.c.failure)
        .where(job.c.parent_id == parent_id)
        .order_by(job.c.position)
    ).all()
    result: dict[str, Any] = {
        "tasks": len(rows),
        **combine_results(row.result for row in rows if row.result is not None),
    }
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
    if not succeeded or head.gathers:
        return end_jobs(tx, running, "cancelled", result=result)
    if _refused_all(head.kind, result):
        first = result["refused"][0]
        detail = f"all inputs were refused; the first, {first['name']}: {first['detail']}"
        failure = failure_document(FailureReason.ERROR, NOTHING_DONE, detail)
        return end_jobs(tx, running, "failed", failure=failure, result=result)
    if _is_large(tx, head, result):
        _defer(tx, running, result)
        return []
    made = commits.commit_tasks(tx, head)
    if made.failure is not None:
        return end_jobs(tx, running, "failed", failure=made.failure, result=result)
    return end_jobs(tx, running, "succeeded", result=result, **made.columns)


def _refused_all(kind_name: str, result: Mapping[str, Any]) -> bool:
    """Return whether the tasks of a job refused all inputs, and the kind of the job declares that this is a failure."""
    try:
        fails = find_kind(kind_name).refusing_all_fails
    except UnknownKindError:
        return False
    return fails and nothing_done(result)


def _is_large(tx: Transaction, head: Any, result: Mapping[str, Any]) -> bool:
    """Return whether the commit of a parent job may have more than `MOST_AT_END` entries.

    `head` has the column `commit_to`, and `result` contains the number of outputs. A job that replaces a folder may
    also remove all entries of the version from which it started.
    """
    if head.commit_to is None:
        return False
    count = result.get("outputs", 0)
    target = head.commit_to
    if target["replace"] and target["base"] is not None:
        of_base = (dataset_commit.c.dataset_id == target["dataset_id"], dataset_commit.c.digest == target["base"])
        count += tx.execute(select(dataset_commit.c.entries).where(*of_base)).scalar() or 0
    return bool(count > MOST_AT_END)


def _defer(tx: Transaction, running: ColumnElement[bool], result: Mapping[str, Any]) -> None:
    """Store the combined result of the tasks of a parent job; the server commits the outputs later (`finishing`)."""
    tx.execute(update(job).where(running).values(result=result, dependencies_left=0, rev=job.c.rev + 1))
    tx.after_commit(lambda: wakeups.announce([OUTPUTS_TO_COMMIT]))


def release_tasks(tx: Transaction, gathered: Collection[str]) -> None:
    """Delete the staged outputs of the tasks of the parent jobs `gathered`, and release the blobs that tasks name.

    The outputs and blobs are not needed any more, because a worker has combined the results of the tasks.
    Garbage collection may then delete the blobs, and the results of the tasks are no longer cached.
    """
    tasks = select(job.c.id).where(job.c.parent_id.in_(gathered))
    tx.execute(delete(job_blob).where(job_blob.c.job_id.in_(tasks)))
    tx.execute(delete(staged_output).where(staged_output.c.job_id.in_(tasks)))
    tx.execute(update(job).where(job.c.parent_id.in_(gathered)).values(cache_key=None))


def combine_results(results: Iterable[dict[str, Any]]) -> dict[str, Any]:
    """Combine results of tasks: numbers are added, lists concatenated (first thousand entries), objects merged.

    Values of other types are omitted; they remain in the results of the tasks.
    """
    combined: dict[str, Any] = {}
    for result in results:
        for name, value in result.items():
            combined[name] = _combine(combined.get(name), value)
    return {name: value for name, value in combined.items() if value is not None}


def _combine(known: Any, value: Any) -> Any:
    """Return `known` combined with `value`: numbers are added, lists joined (up to `MOST_GATHERED`), objects merged.

    If `value` is no number, list or object, `known` is returned. If `known` has another type than `value`, the result
    is `value` alone.
    """
    if isinstance(value, int | float) and not isinstance(value, bool):
        return value + (known if isinstance(known, int | float) else 0)
    if isinstance(value, list):
        return [*(known if isinstance(known, list) else []), *value][:MOST_GATHERED]
    if isinstance(value, dict):
        return combine_results([known if isinstance(known, dict) else {}, value])
    return known
