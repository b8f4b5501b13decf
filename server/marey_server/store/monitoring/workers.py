"""List of workers: those that claimed jobs from this process, and those that run jobs according to the queue.

The database has no record of workers, because a waiting worker must not cost writes. Each server process remembers the
claims that it received; the attempts in the database show the workers of other servers while they run jobs.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from sqlalchemy import and_, func, select

from marey_schemas.lru import LruCache
from marey_schemas.queue.worker_protocol import ClaimRequest
from marey_schemas.queue.workers import Worker
from marey_schemas.sizes import KIB, MIB
from marey_server.access.roles import require_administrator
from marey_server.store.database.clock import datetime_of
from marey_server.store.jobs.fencing import RUNNING
from marey_server.store.jobs.policy import DEFAULT_POLICY, SECOND_US, QueuePolicy
from marey_server.store.tables import attempt, job
from marey_server.store.transaction import Transaction

MOST_REMEMBERED = 5000
MOST_BYTES = 16 * MIB
LARGEST_CLAIM_BYTES = 64 * KIB
"""Limits of the claims that a process remembers. Workers that have been silent longest are forgotten first; a longer
claim is not remembered."""
FORGOTTEN_AFTER_S = 24 * 3600.0
ALIVE_S = 60.0
"""Seconds after a claim in which a worker counts as alive. Workers claim again at least every 30 seconds, or every 15
seconds while the server cannot be reached."""


class WorkerKey(NamedTuple):
    """Token and name of a worker; workers with different tokens may have the same name."""

    token_id: str | None
    name: str


@dataclass(frozen=True, slots=True)
class HeardWorker:
    """Last claim of a worker, and the number of seconds since this claim."""

    key: WorkerKey
    claim: ClaimRequest
    age_s: float

    @property
    def alive(self) -> bool:
        """Whether the claim is so recent that the worker may still wait for its answer."""
        return self.age_s <= ALIVE_S


class WorkerMemory:
    """Last claim of each worker that claimed jobs from this process."""

    def __init__(self, clock_s: Callable[[], float] = time.monotonic) -> None:
        self._clock_s = clock_s
        self._claims: LruCache[WorkerKey, tuple[float, ClaimRequest]] = LruCache(
            max_entries=MOST_REMEMBERED,
            max_bytes=MOST_BYTES,
            largest_bytes=LARGEST_CLAIM_BYTES,
            size_of=lambda remembered: _size_bytes(remembered[1]),
        )

    def hear(self, token_id: str | None, claim: ClaimRequest) -> None:
        """Remember an accepted claim."""
        self._claims.put(WorkerKey(token_id, claim.worker), (self._clock_s(), claim))

    def heard(self) -> list[HeardWorker]:
        """Return the remembered workers that were heard in the last `FORGOTTEN_AFTER_S`."""
        now_s = self._clock_s()
        heard = [HeardWorker(key, claim, now_s - at_s) for key, (at_s, claim) in self._claims.items()]
        return [one for one in heard if one.age_s <= FORGOTTEN_AFTER_S]


def _size_bytes(claim: ClaimRequest) -> int:
    texts = (claim.worker, claim.version or "", *claim.kinds, *claim.labels, *claim.labels.values())
    return 512 + sum(64 + 4 * len(text) for text in texts)


class _Running(NamedTuple):
    """Number of attempts that a worker runs, and time of its last heartbeat in microseconds."""

    attempts: int
    seen_us: int


def list_workers(
    tx: Transaction, heard: Sequence[HeardWorker], policy: QueuePolicy = DEFAULT_POLICY
) -> tuple[Worker, ...]:
    """Return the workers in `heard` and those that run jobs, by name, for administrators only.

    The names of workers are often names of hosts. Raises `ForbiddenProblem` if the caller is no administrator.
    """
    require_administrator(tx.principal)
    running = _running_workers(tx, policy)
    known = {one.key: one for one in heard}
    workers = [_document(tx, key, known.get(key), running.get(key)) for key in {**known, **running}]
    return tuple(sorted(workers, key=lambda worker: worker.name))


def _document(tx: Transaction, key: WorkerKey, heard: HeardWorker | None, running: _Running | None) -> Worker:
    claimed_us = 0 if heard is None else tx.now_us - round(heard.age_s * SECOND_US)
    return Worker(
        name=key.name,
        alive=running is not None or (heard is not None and heard.alive),
        seen_at=datetime_of(max(claimed_us, 0 if running is None else running.seen_us)),
        running=0 if running is None else running.attempts,
        version=None if heard is None else heard.claim.version,
        kinds=None if heard is None else heard.claim.kinds,
        labels=None if heard is None else heard.claim.labels,
    )


def _running_workers(tx: Transaction, policy: QueuePolicy) -> dict[WorkerKey, _Running]:
    """Return the workers whose leases have not expired."""
    rows = tx.execute(
        select(
            attempt.c.claimed_by,
            attempt.c.worker,
            func.count().label("attempts"),
            func.max(job.c.lease_expires_us).label("expires_us"),
        )
        .select_from(job.join(attempt, and_(attempt.c.job_id == job.c.id, attempt.c.fence == job.c.fence)))
        .where(job.c.state == RUNNING, job.c.lease_expires_us > tx.now_us)
        .group_by(attempt.c.claimed_by, attempt.c.worker)
    )
    return {
        WorkerKey(row.claimed_by, row.worker): _Running(
            row.attempts, min(row.expires_us - policy.lease_ttl_us, tx.now_us)
        )
        for row in rows
    }
