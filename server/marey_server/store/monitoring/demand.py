"""Demand for workers with certain labels: the jobs that wait for such workers, and the workers that run jobs.

The number of rows that a query reads is limited, so that its cost does not grow with the length of the queue.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from sqlalchemy import and_, exists, func, select

from marey_server.access.labels import keys_within
from marey_server.store.jobs.fencing import QUEUED, RUNNING
from marey_server.store.tables import attempt, job, project
from marey_server.store.transaction import Transaction, in_lists


@dataclass(frozen=True)
class Demand:
    """Demand for workers at one moment.

    `queued` is the number of jobs that could run now, at most the given limit. `running` is the number of jobs that
    each of the given workers runs; workers without jobs are missing.
    """

    queued: int = 0
    running: Mapping[str, int] = field(default_factory=dict)


def read_demand(
    tx: Transaction, labels: Mapping[str, str], kinds: Sequence[str], workers: Sequence[str], limit: int
) -> Demand:
    """Return the demand for workers with these labels.

    Parameters
    ----------
    labels : labels of the workers, which can run jobs that require any subset of these labels
    kinds : kinds of jobs that the workers run; empty: all kinds
    workers : names of the workers that exist already
    limit : number of queued jobs at which counting stops
    """
    return Demand(_count_queued(tx, labels, kinds, limit), _count_running(tx, workers))


def _count_queued(tx: Transaction, labels: Mapping[str, str], kinds: Sequence[str], limit: int) -> int:
    """Return the number of jobs that a claim with these labels and kinds could get, at most `limit`.

    A job that waits only for another job with the same concurrency key is counted, too.
    """
    conditions = [
        job.c.state == QUEUED,
        job.c.run_at_us <= tx.now_us,
        job.c.labels_key.in_(keys_within(labels)),
        exists().where(project.c.id == job.c.project_id, project.c.deleted_us.is_(None)),
    ]
    if kinds:
        conditions.append(job.c.kind.in_(kinds))
    found = select(job.c.id).where(*conditions).limit(limit).subquery()
    return int(tx.execute(select(func.count()).select_from(found)).scalar_one())


def _count_running(tx: Transaction, workers: Sequence[str]) -> dict[str, int]:
    """Return the number of jobs of each worker whose leases have not expired."""
    current = and_(attempt.c.job_id == job.c.id, attempt.c.fence == job.c.fence)
    counted: dict[str, int] = {}
    for names in in_lists(workers):
        rows = tx.execute(
            select(attempt.c.worker, func.count().label("jobs"))
            .select_from(job.join(attempt, current))
            .where(job.c.state == RUNNING, job.c.lease_expires_us > tx.now_us, attempt.c.worker.in_(names))
            .group_by(attempt.c.worker)
        )
        counted |= {row.worker: row.jobs for row in rows}
    return counted
