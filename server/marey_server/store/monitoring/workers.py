"""List of workers: those that claimed jobs from this process, and those that run jobs according to the queue.

The database has no record of workers, because a waiting worker must not cost writes. Each server process remembers the
claims that it received; the attempts in the database show the workers of other servers while they run jobs.
"""

from __future__ import annotations

import math
import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import NamedTuple

from sqlalchemy import and_, func, select

from marey_schemas.queue.worker_protocol import ClaimRequest, Lease
from marey_schemas.queue.workers import Worker
from marey_schemas.sizes import KIB, MIB
from marey_server.access.roles import require_administrator
from marey_server.errors import TooManyRequestsProblem
from marey_server.store.database.clock import datetime_of
from marey_server.store.jobs.fencing import RUNNING
from marey_server.store.jobs.policy import DEFAULT_POLICY, SECOND_US, QueuePolicy
from marey_server.store.jobs.reaper import StartGrace, claim_after_reaping
from marey_server.store.tables import attempt, job
from marey_server.store.transaction import Transaction

MOST_REMEMBERED = 5000
MOST_BYTES = 16 * MIB
LARGEST_CLAIM_BYTES = 64 * KIB
"""Limits of the claims that a process remembers: their number, their total size in bytes, and the size of one claim.

If there are too many claims, or they are too large together, the oldest claim of the user with the most workers is
forgotten. A single claim that is too large is not remembered.
"""
MOST_OF_USER = 2000
"""Greatest number of workers of one user that may be alive in one server process, unless the settings change it."""
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


class _Remembered(NamedTuple):
    """Last claim of a worker, the time at which it was received, and the memory that it takes."""

    at_s: float
    claim: ClaimRequest
    size_bytes: int


class WorkerMemory:
    """Last claim of each worker that claimed jobs from this process. It is thread-safe.

    A worker chooses its name, so one user could send claims with any number of names. So the number of live workers of
    each user is limited. If there are too many claims, workers of the user with the most workers are forgotten first. A
    worker that has sent no claim for `ALIVE_S` seconds does not count, so workers may be replaced by workers with new
    names.

    Parameters
    ----------
    clock_s : clock that never goes back, in seconds
    most_of_user : greatest number of workers of one user that are alive
    """

    def __init__(self, clock_s: Callable[[], float] = time.monotonic, most_of_user: int = MOST_OF_USER) -> None:
        self._clock_s = clock_s
        self._most_of_user = most_of_user
        self._of_user: dict[str | None, OrderedDict[WorkerKey, _Remembered]] = {}
        """Workers of each user, in the order of their last claims, the oldest first."""
        self._count = self._held_bytes = 0
        self._lock = threading.Lock()

    def require_place(self, user_id: str | None, token_id: str | None, worker: str) -> None:
        """Raise `TooManyRequestsProblem` if the worker is not alive yet, but too many other workers of its user are."""
        now_s = self._clock_s()
        with self._lock:
            workers = self._of_user.get(user_id, OrderedDict())
            known = workers.get(WorkerKey(token_id, worker))
            last = next(islice(reversed(workers.values()), self._most_of_user - 1, None), None)
        if known is not None and now_s - known.at_s <= ALIVE_S:
            return
        if last is None or (left_s := ALIVE_S - (now_s - last.at_s)) < 0:
            return
        raise TooManyRequestsProblem(
            f"You have {self._most_of_user:,} workers with different names that claimed jobs in the last {ALIVE_S:.0f} "
            "seconds, and more are not allowed. Let workers keep their names, start fewer workers with more slots, or "
            "ask the operator to raise the setting `user_workers`.",
            code="too-many-workers",
            headers={"Retry-After": str(max(1, math.ceil(left_s)))},
            context={"quota": "user_workers", "limit": self._most_of_user},
        )

    def hear(self, user_id: str | None, token_id: str | None, claim: ClaimRequest) -> None:
        """Remember an accepted claim as the last claim of its worker."""
        size = _size_bytes(claim)
        if size > LARGEST_CLAIM_BYTES:
            return
        key = WorkerKey(token_id, claim.worker)
        with self._lock:
            workers = self._of_user.setdefault(user_id, OrderedDict())
            if key in workers:
                self._subtract(workers.pop(key))
            workers[key] = _Remembered(self._clock_s(), claim, size)
            self._count += 1
            self._held_bytes += size
            while self._count > MOST_REMEMBERED or self._held_bytes > MOST_BYTES:
                self._forget_one()

    def _forget_one(self) -> None:
        user_id, workers = max(self._of_user.items(), key=lambda one: len(one[1]))
        self._subtract(workers.popitem(last=False)[1])
        if not workers:
            del self._of_user[user_id]

    def _subtract(self, forgotten: _Remembered) -> None:
        self._count -= 1
        self._held_bytes -= forgotten.size_bytes

    def heard(self) -> list[HeardWorker]:
        """Return the workers whose last claim was received within the last `FORGOTTEN_AFTER_S` seconds."""
        now_s = self._clock_s()
        with self._lock:
            every = [one for workers in self._of_user.values() for one in workers.items()]
        heard = [HeardWorker(key, last.claim, now_s - last.at_s) for key, last in every]
        return [one for one in heard if one.age_s <= FORGOTTEN_AFTER_S]


def _size_bytes(claim: ClaimRequest) -> int:
    texts = (claim.worker, claim.version or "", *claim.kinds, *claim.labels, *claim.labels.values())
    return 512 + sum(64 + 4 * len(text) for text in texts)


def claim_and_remember(
    tx: Transaction, request: ClaimRequest, memory: WorkerMemory, grace: StartGrace, policy: QueuePolicy
) -> list[Lease]:
    """Claim jobs as `claim_after_reaping` does, and remember the worker.

    Raises `TooManyRequestsProblem` if too many workers of the caller are alive. This limit does not apply to pods that
    were started for one job; the setting `own_pods` limits their number.
    """
    caller = tx.principal
    if caller.kind != "pod":
        memory.require_place(caller.user_id, caller.token_id, request.worker)
    leases = claim_after_reaping(tx, request, grace, policy)
    memory.hear(caller.user_id, caller.token_id, request)
    return leases


class _Running(NamedTuple):
    """Number of attempts that a worker runs, and time of its last heartbeat in microseconds."""

    attempts: int
    seen_us: int


def list_workers(
    tx: Transaction, heard: Sequence[HeardWorker], policy: QueuePolicy = DEFAULT_POLICY
) -> tuple[Worker, ...]:
    """Return the workers in `heard` and those that run jobs, sorted by name.

    Raises `ForbiddenProblem` if the caller is no administrator, because names of workers are often names of hosts.
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
    """Return the workers that run jobs with a valid lease, each with the number of these jobs."""
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
