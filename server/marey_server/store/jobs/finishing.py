"""Commits of the many outputs of parent jobs, without letting other writers wait.

A read transaction plans the commit. Several short writes store the chunks of its tree. A last write ends the job and
moves the branch. If others have committed since the plan was computed, the last write adds their changes to the plan.
If their changes concern the same entries, or if items of the project were purged since, the commit is planned again. If
the server stops before the last write, nothing but chunks has been stored, and the next server begins again.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

from sqlalchemy import select

from marey_schemas.queue.commits import MOST_COMMITTED
from marey_server import faults
from marey_server.access.principal import SYSTEM
from marey_server.errors import ApiProblem, DamagedProblem, UnavailableProblem
from marey_server.store.database.connections import Database
from marey_server.store.datasets.chunks import store_chunks
from marey_server.store.datasets.naming import find_ref
from marey_server.store.datasets.output_plans import OutputEntries, PlannedCommit, plan_outputs
from marey_server.store.jobs import commits
from marey_server.store.jobs.endings import end_jobs
from marey_server.store.jobs.fan_out import DEFERRED
from marey_server.store.jobs.propagation import propagate_ends
from marey_server.store.purge_lock import hold_off_purges, last_purge
from marey_server.store.tables import dataset, job
from marey_server.store.transaction import Transaction
from marey_versions.tree.chunks import DamagedChunk

CHUNKS_AT_ONCE = 500
"""Greatest number of chunks that one write stores, so that the write is short."""
MOST_PLANS = 5
"""Greatest number of times that a commit is planned in a row, before the next job has its turn."""


log = logging.getLogger(__name__)


def commit_deferred(database: Database) -> int:
    """Commit the outputs of jobs whose tasks have all ended, and end these jobs; return how many have ended.

    A job fails if its commit is refused, or cannot be computed because chunks of the dataset are damaged. After any
    other error, the job stays as it is; the other jobs are ended nevertheless.
    """
    return sum(_commit_one(database, one) for one in database.read(SYSTEM, _deferred_jobs))


def _deferred_jobs(tx: Transaction) -> list[str]:
    return list(tx.execute(select(job.c.id).where(DEFERRED).order_by(job.c.id)).scalars())


def _commit_one(database: Database, job_id: str) -> bool:
    """Commit the outputs of one job, and end it; return whether it has ended now.

    Errors are only logged, except `UnavailableProblem`, which is raised.
    """
    try:
        for _ in range(MOST_PLANS):
            plan = database.read(SYSTEM, _plan, job_id)
            if plan is None:
                return False
            for chunks in _portions(plan.chunks):
                database.submit_write(SYSTEM, store_chunks, chunks).result()
            faults.point("deferred_commit.after_chunks")
            if database.submit_write(SYSTEM, _end, plan).result():
                return True
    except UnavailableProblem:
        raise
    except Exception:
        log.exception("the outputs of %s cannot be committed", job_id)
    return False


def _portions(chunks: Mapping[str, bytes]) -> Iterator[Mapping[str, bytes]]:
    """Yield the chunks in portions, sorted by digest: all writers lock chunks in this order."""
    digests = sorted(chunks)
    for start in range(0, len(digests), CHUNKS_AT_ONCE):
        yield {digest: chunks[digest] for digest in digests[start : start + CHUNKS_AT_ONCE]}


@dataclass(frozen=True)
class _JobPlan:
    """Planned commit of the outputs of a job, or the reason why no commit was planned."""

    job_id: str
    project_id: str
    last_purge: int
    """Time of the last purge of the project before the plan was computed, in microseconds; 0 if there was none."""
    wanted: OutputEntries | None = None
    """Outputs of the job; None if the job must be cancelled, or must end with `failure`."""
    commit: PlannedCommit | None = None
    """The planned commit; None if `wanted` is None, or if the branch does not exist any more."""
    failure: dict[str, Any] | None = None
    """Failure with which the job must end, because its commit is refused or cannot be computed; otherwise None."""

    @property
    def chunks(self) -> Mapping[str, bytes]:
        """The chunks to be stored before the job ends."""
        return {} if self.commit is None else self.commit.chunks


_COLUMNS = (*commits.JOB_COLUMNS, job.c.cancel_requested_us)


def _plan(tx: Transaction, job_id: str) -> _JobPlan | None:
    """Plan the commit of a job; return None if the job has ended already.

    For a job whose cancellation was requested, the result contains no commit.
    """
    row = tx.execute(select(*_COLUMNS).where(job.c.id == job_id, DEFERRED)).first()
    if row is None:
        return None
    plan = _JobPlan(job_id, row.project_id, last_purge(tx, row.project_id))
    if row.cancel_requested_us is not None:
        return plan
    try:
        return _with_commit(tx, row, plan)
    except UnavailableProblem:
        raise
    except ApiProblem as error:
        return replace(plan, failure=commits.refused_commit(row.commit_to, error.error_code, error.detail))
    except DamagedChunk as error:
        log.exception("the outputs of %s cannot be committed", job_id)
        detail = f"The stored data of the dataset are damaged: {error}. Ask the operator to run `marey db fsck`."
        return replace(plan, failure=commits.refused_commit(row.commit_to, DamagedProblem.code, detail))


def _with_commit(tx: Transaction, row: Any, plan: _JobPlan) -> _JobPlan:
    wanted = commits.entries_of_tasks(tx, row)
    exists = select(dataset.c.id).where(dataset.c.id == wanted.dataset_id, dataset.c.deleted_us.is_(None))
    ref = None if tx.execute(exists).first() is None else find_ref(tx, wanted.dataset_id, wanted.branch)
    planned = None if ref is None else plan_outputs(tx, wanted, ref.digest, MOST_COMMITTED)
    return replace(plan, wanted=wanted, commit=planned)


def _end(tx: Transaction, plan: _JobPlan) -> bool:
    """End a job and commit its outputs as planned; return False if the commit must be planned again."""
    hold_off_purges(tx, plan.project_id)
    row = tx.execute(select(*_COLUMNS).where(job.c.id == plan.job_id, DEFERRED).with_for_update()).first()
    if row is None:  # another process has ended it
        return True
    this = job.c.id == row.id
    if row.cancel_requested_us is not None:
        propagate_ends(tx, end_jobs(tx, this, "cancelled"))
        return True
    if plan.failure is not None:
        propagate_ends(tx, end_jobs(tx, this, "failed", failure=plan.failure))
        return True
    if plan.wanted is None or last_purge(tx, row.project_id) != plan.last_purge:
        return False
    made = commits.commit_planned_tasks(tx, row, plan.wanted, plan.commit)
    if made is None:
        return False
    if made.failure is not None:
        propagate_ends(tx, end_jobs(tx, this, "failed", failure=made.failure))
    else:
        propagate_ends(tx, end_jobs(tx, this, "succeeded", **made.columns))
    faults.point("deferred_commit.before_commit")
    return True
