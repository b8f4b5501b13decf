"""Reclaims jobs with an expired lease, from dead workers and from workers that did not stop in time."""

from __future__ import annotations

import logging
import threading
from typing import Any, NamedTuple

from sqlalchemy import Row, and_, select, tuple_, update
from sqlalchemy.exc import OperationalError

from marey_schemas.queue.worker_protocol import ClaimRequest, Lease
from marey_server.store.jobs import result_cache
from marey_server.store.jobs.endings import AttemptEnd
from marey_server.store.jobs.failure import ENDING_COLUMNS, apply_outcome, decide_expired_outcome
from marey_server.store.jobs.fencing import QUEUED, RUNNING, held
from marey_server.store.jobs.policy import DEFAULT_POLICY, SECOND_US, QueuePolicy
from marey_server.store.jobs.propagation import propagate_ends
from marey_server.store.jobs.queue import claim
from marey_server.store.purge_lock import hold_off_purges
from marey_server.store.tables import job
from marey_server.store.transaction import Transaction

log = logging.getLogger(__name__)

PAGE = 256


class StartGrace:
    """Delay before expired leases are reclaimed, after a time in which workers could not renew their leases.

    The delay is as long as a lease; in this time, live workers renew their leases. It begins when this process has
    started, when the database was unreachable, when the clock has jumped, and after a long write that blocked all other
    writes, also heartbeats.
    """

    def __init__(self, policy: QueuePolicy = DEFAULT_POLICY) -> None:
        self._ttl_us = policy.lease_ttl_us
        self._longest_silence_us = policy.lease_ttl_us - round(policy.heartbeat_s * SECOND_US)
        self._lock = threading.Lock()
        self._since_us: int | None = None
        self._seen_us = 0

    def over(self, now_us: int) -> bool:
        """Return whether the delay has passed, so that leases may be reclaimed; `now_us` is the time of the database.

        The delay starts again if the last call was too long ago, or at a later time than `now_us`.
        """
        with self._lock:
            if self._since_us is None or not 0 <= now_us - self._seen_us <= self._longest_silence_us:
                self._since_us = now_us
            self._seen_us = now_us
            return now_us - self._since_us >= self._ttl_us

    def restart(self) -> None:
        """Start the delay again, because the database could not be reached."""
        with self._lock:
            self._since_us = None


class ReapedPage(NamedTuple):
    """Number of reclaimed jobs, and the position to continue from; `after` is None after the last page."""

    taken: int
    after: tuple[int, str] | None


def reap_page(
    tx: Transaction,
    policy: QueuePolicy = DEFAULT_POLICY,
    after: tuple[int, str] | None = None,
    limit: int = PAGE,
) -> ReapedPage:
    """Reclaim up to `limit` jobs whose leases have expired, the longest overdue first.

    `after` is the position that the previous page returned. Each job is changed only on the condition that its lease is
    still expired and no other attempt has claimed it. So a concurrent heartbeat or result is either accepted, or
    refused because the lease is lost. If a job cannot be reclaimed, the others are reclaimed nevertheless.
    """
    overdue = and_(job.c.state == RUNNING, job.c.lease_expires_us <= tx.now_us)
    statement = select(*ENDING_COLUMNS).where(overdue).order_by(job.c.lease_expires_us, job.c.id).limit(limit)
    if after is not None:
        statement = statement.where(tuple_(job.c.lease_expires_us, job.c.id) > after)
    if tx.is_postgres:
        projects = set(tx.execute(statement.with_only_columns(job.c.project_id)).scalars())
        hold_off_purges(tx, *projects)
        statement = statement.where(job.c.project_id.in_(projects))
    rows = tx.execute(statement.with_for_update(skip_locked=True)).all()
    taken = sum(_take_back(tx, row, policy) for row in rows)
    last = rows[-1] if len(rows) == limit else None
    return ReapedPage(taken, None if last is None else (last.lease_expires_us, last.id))


def _take_back(tx: Transaction, row: Row[Any], policy: QueuePolicy) -> bool:
    """Reclaim a job whose lease has expired, and return whether this succeeded.

    Reclaiming ends the attempt and the lease. The job is queued again, or it ends, and then the jobs that depend on it
    are updated. An error is logged, and the result is False. Only `OperationalError` is raised, because it concerns the
    database and not this job.
    """
    try:
        with tx.connection.begin_nested():
            outcome = decide_expired_outcome(row, policy)
            condition = and_(held(row.id, row.fence), job.c.lease_expires_us <= tx.now_us)
            end = AttemptEnd(row.id, row.fence, outcome.attempt_outcome, "The lease ran out.")
            apply_outcome(tx, row, condition, outcome, end, fence=job.c.fence + 1)
        tx.after_commit(tx.observer.count_lost_lease)
    except OperationalError:  # concerns the database, not this job: the whole page is tried again
        raise
    except Exception:
        log.exception("%s cannot be taken back from a worker that no longer sends heartbeats", row.id)
        return False
    return True


def claim_after_reaping(
    tx: Transaction, request: ClaimRequest, grace: StartGrace, policy: QueuePolicy = DEFAULT_POLICY
) -> list[Lease]:
    """Claim jobs; if there are none, reclaim the jobs whose leases have expired, and try to claim once more.

    Nothing is reclaimed during `grace`.
    """
    leases = claim(tx, request, policy)
    if not leases and grace.over(tx.now_us) and reap_page(tx, policy).taken:
        leases = claim(tx, request, policy)
    return leases


def correct_times(tx: Transaction, policy: QueuePolicy = DEFAULT_POLICY) -> int:
    """Shorten leases and waits that end too late because the clock of the database was set back.

    Returns the number of changed jobs.
    """
    latest_us = tx.now_us + policy.lease_ttl_us
    leases = tx.execute(
        update(job).where(job.c.state == RUNNING, job.c.lease_expires_us > latest_us).values(lease_expires_us=latest_us)
    )
    rested_us = tx.now_us + round(policy.longest_backoff_s * SECOND_US)
    rests = tx.execute(
        update(job).where(job.c.state == QUEUED, job.c.run_at_us > rested_us).values(run_at_us=tx.now_us)
    )
    return leases.rowcount + rests.rowcount


def share_waiting(tx: Transaction) -> int:
    """Give waiting jobs the shared results that now exist; return the number of these jobs."""
    ended = result_cache.share_waiting(tx)
    propagate_ends(tx, ended)
    return len(ended)
