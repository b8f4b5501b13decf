"""Demand for workers with certain labels: the jobs that wait for such workers, and the workers that run jobs.

The number of rows that a query reads is limited, so that its cost does not grow with the length of the queue. It grows
with the number of projects that have queued jobs.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from sqlalchemy import ColumnElement, FromClause, Select, and_, exists, false, func, or_, select

from marey_server.access.labels import keys_within
from marey_server.store.jobs.claiming.turns import projects_with_queued_jobs
from marey_server.store.jobs.fencing import QUEUED, RUNNING
from marey_server.store.quotas.running_jobs import count_leased
from marey_server.store.tables import attempt, job, project, queue_share
from marey_server.store.transaction import Transaction, in_lists


@dataclass(frozen=True)
class Demand:
    """Demand for the workers of a pool at one moment.

    `queued` is the number of queued jobs that could run now; the count stops at a limit. `running` maps the names of
    the pool's workers to the numbers of jobs that they run; workers without jobs are missing.
    """

    queued: int = 0
    running: Mapping[str, int] = field(default_factory=dict)


@dataclass(frozen=True)
class JobReach:
    """Jobs that the workers of a pool can run.

    These are the jobs that require no other labels than `labels`, and whose kind is in `kinds`. An empty `kinds` stands
    for all kinds.
    """

    labels: Mapping[str, str]
    kinds: Sequence[str] = ()


def read_demand(
    tx: Transaction, reach: JobReach, workers: Sequence[str], limit: int, others: Sequence[JobReach] = ()
) -> Demand:
    """Return the demand for workers with the given reach.

    Parameters
    ----------
    reach : jobs that the workers can run
    workers : names of the workers that exist already
    limit : number of queued jobs at which counting stops
    others : jobs that the workers of the other pools can run; a job that several pools can run counts only for the
        pools with the fewest labels
    """
    return Demand(_count_queued(tx, _wanted(reach, others), limit), _count_running(tx, workers))


def _wanted(reach: JobReach, others: Sequence[JobReach]) -> ColumnElement[bool]:
    """Return the SQL condition for the jobs that count as demand for a pool with this `reach`.

    The pool can run these jobs, and none of the `others` with fewer labels can.
    """
    keys: dict[tuple[str, ...], list[str]] = {}
    for key in keys_within(reach.labels):
        simpler = [one for one in others if len(one.labels) < len(reach.labels) and key in keys_within(one.labels)]
        if all(one.kinds for one in simpler):
            left_out = {kind for one in simpler for kind in one.kinds}
            keys.setdefault(tuple(sorted(left_out)), []).append(key)
    wanted = or_(false(), *(and_(job.c.labels_key.in_(some), job.c.kind.not_in(out)) for out, some in keys.items()))
    return and_(wanted, job.c.kind.in_(reach.kinds)) if reach.kinds else wanted


def _count_queued(tx: Transaction, wanted: ColumnElement[bool], limit: int) -> int:
    """Return the number of jobs that could start now, at most `limit`.

    Of the jobs with the same concurrency key, at most one counts, and none if one of them runs. If a project has a
    limit of running jobs, only as many of its queued jobs count as may run in addition to those that run already.
    """
    startable = and_(job.c.state == QUEUED, job.c.run_at_us <= tx.now_us, wanted)
    waiting = projects_with_queued_jobs()
    projects = tx.execute(
        select(project.c.id, queue_share.c.most_running, count_leased(project.c.id).label("running"))
        .select_from(waiting.join(project, project.c.id == waiting.c.project_id))
        .outerjoin(queue_share, queue_share.c.project_id == project.c.id)
        .where(project.c.deleted_us.is_(None))
    ).all()
    found = 0
    for row in projects:
        most = limit - found if row.most_running is None else min(limit - found, row.most_running - row.running)
        if most > 0:
            unkeyed = select(job.c.id).where(job.c.project_id == row.id, job.c.concurrency_key.is_(None), startable)
            counted = _count_rows(tx, unkeyed, most)
            found += counted if counted == most else counted + _count_rows(tx, _keys(row.id, startable), most - counted)
    return found


def _count_rows(tx: Transaction, rows: Select[*tuple[Any, ...]], most: int) -> int:
    return int(tx.execute(select(func.count()).select_from(rows.limit(most).subquery())).scalar_one())


def _keys(project_id: str, startable: ColumnElement[bool]) -> Select[*tuple[Any, ...]]:
    """Return a query for the concurrency keys of a project for which a job could start now.

    Each step looks up the next key in an index, so the cost grows with the number of keys, not of jobs.
    """
    first, later, rival = job.alias("first"), job.alias("later"), job.alias("rival")

    def queued(one: FromClause) -> ColumnElement[bool]:
        return and_(one.c.project_id == project_id, one.c.state == QUEUED, one.c.concurrency_key.is_not(None))

    keys = select(func.min(first.c.concurrency_key).label("key")).where(queued(first)).cte("keys", recursive=True)
    following = select(func.min(later.c.concurrency_key)).where(queued(later), later.c.concurrency_key > keys.c.key)
    keys = keys.union_all(select(following.scalar_subquery()).where(keys.c.key.is_not(None)))
    same_key = (rival.c.project_id == project_id, rival.c.concurrency_key == keys.c.key)
    return select(keys.c.key).where(
        keys.c.key.is_not(None),
        exists().where(job.c.project_id == project_id, job.c.concurrency_key == keys.c.key, startable),
        ~exists().where(*same_key, rival.c.state == RUNNING),
    )


def _count_running(tx: Transaction, workers: Sequence[str]) -> dict[str, int]:
    """Return, by name of the worker, the number of jobs that it runs with a valid lease.

    Workers without jobs are missing.
    """
    by_job = job.c.id.concat("")  # so that SQLite looks up the attempts of running jobs, not the jobs of all attempts
    current = and_(attempt.c.job_id == by_job, attempt.c.fence == job.c.fence)
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
