"""Task that keeps the number of workers of a pool between its limits, as the queue needs them."""

from __future__ import annotations

import asyncio
import logging
import secrets
import time
from collections.abc import Callable, Sequence
from functools import partial

from marey_schemas.backoff import Backoff
from marey_server.access.principal import SYSTEM
from marey_server.errors import ApiProblem
from marey_server.launchers.launcher import HEALTHY_AFTER_S, EngineError, LaunchedWorker, Launcher, WorkerRequest
from marey_server.launchers.pool_size import PoolLimits, PoolSize
from marey_server.launchers.rounds import ServerLead, ask, repeat
from marey_server.process.worker_pools import WorkerPool
from marey_server.store.database.connections import Database
from marey_server.store.database.lanes import SERVER
from marey_server.store.monitoring.demand import Demand, JobReach, read_demand

log = logging.getLogger(__name__)

ROUND_S = 10.0
"""Seconds between two adjustments of the number of workers."""
MOST_EXPLAINED = 10
"""Greatest number of ended workers per round for which the engine is asked for the reason."""
VISIBLE_AFTER_S = 60.0
"""Seconds after its start for which a worker counts as present although the engine does not list it."""
START_PAUSES = Backoff(first_s=5.0, longest_s=600.0, jitter=0.25)
QUIET_ENDS = ("finished", "stopped", "deadline", "preempted")
"""Reasons for ends of workers that are logged as information, and that do not delay the next start."""


def _reach(pool: WorkerPool) -> JobReach:
    return JobReach(pool.labels, pool.kinds)


class PoolKeeper:
    """Task that keeps the number of workers of one pool between its limits.

    Parameters
    ----------
    other_pools : the other pools of the server, which may run the same jobs
    clock_s : monotonic clock in seconds
    """

    def __init__(
        self,
        pool: WorkerPool,
        launcher: Launcher,
        database: Database,
        other_pools: Sequence[WorkerPool] = (),
        *,
        clock_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self._pool = pool
        self._launcher = launcher
        self._database = database
        self._reach = _reach(pool)
        self._other_reaches = [_reach(other) for other in other_pools]
        self._clock_s = clock_s
        self._lead = ServerLead(database, f"pool {pool.name}")
        self._size = PoolSize(PoolLimits(pool.least, pool.most, pool.slots, shrink_after_s=pool.idle_s))
        self._unanswered: tuple[str, int] | None = None
        """Key and count of a start whose answer was lost."""
        self._started: dict[str, float] = {}
        """Times of the starts of workers that the engine may not list yet, by name."""
        self._running_since: dict[str, float] = {}
        self._stopped: set[str] = set()
        self._ended: set[str] | None = None
        self._quick_failures = 0
        self._start_after_s = 0.0

    async def keep(self) -> None:
        """Adjust the number of workers every `ROUND_S` seconds, until the task is cancelled."""
        await repeat(f"pool {self._pool.name}", self.adjust, ROUND_S)

    async def close(self) -> None:
        """Close the launcher, and let another server become the leader for this pool."""
        try:
            await self._launcher.close()
            if self._launcher.outlives_server:
                await self._lead.give_up()
        except (EngineError, ApiProblem) as error:
            log.warning("pool %s: %s", self._pool.name, getattr(error, "detail", error))

    async def adjust(self) -> None:
        """Start or stop workers once, if this process is the leader.

        Raises `EngineError` if the engine refuses a request, and `ApiProblem` if the database cannot be used.
        """
        if self._launcher.outlives_server and not await self._lead.take():
            self._size.forget()
            self._ended = None
            return
        listed = await ask(self._launcher.list())
        await self._note_ends(listed)
        present = self._present(listed)
        demand = await self._read_demand(present)
        running = sum(demand.running.values())
        now_s = self._clock_s()
        size = self._size.decide(now_s, queued=demand.queued, running=running, present=len(present))
        if size > len(present) and now_s >= self._start_after_s:
            await self._start(*(self._unanswered or (secrets.token_hex(4), size - len(present))))
        elif size <= len(present):
            self._unanswered = None  # the workers are there, or are no longer needed
        idle = [name for name in present if name not in demand.running]
        superfluous = idle[: max(0, len(present) - size)]
        if superfluous:
            log.info("pool %s: stopping %d workers that have no jobs", self._pool.name, len(superfluous))
        self._stopped.update(superfluous)
        if stopping := tuple(sorted(self._stopped)):
            await ask(self._launcher.stop(stopping))

    # -- workers --

    async def _start(self, key: str, count: int) -> None:
        """Start workers. If the answer is lost, `key` and count are kept, so that the start can be repeated."""
        pool = self._pool
        request = WorkerRequest(
            labels=pool.labels, kinds=pool.kinds, slots=pool.slots, cpus=pool.cpus, memory_bytes=pool.memory_bytes,
            gpus=pool.gpus, deadline_s=pool.deadline_s,
        )  # fmt: skip
        self._unanswered = key, count
        names = await ask(self._launcher.start(request, count, key=key))
        self._unanswered = None
        now_s = self._clock_s()
        self._started.update(dict.fromkeys(names, now_s))
        log.info("pool %s: started %d workers: %s", pool.name, len(names), ", ".join(names))

    def _present(self, listed: tuple[LaunchedWorker, ...]) -> list[str]:
        """Return the names of the workers that are starting or running, the starting ones first."""
        now_s = self._clock_s()
        known = {worker.name for worker in listed}
        self._started = {
            name: at_s for name, at_s in self._started.items() if name not in known and now_s - at_s < VISIBLE_AFTER_S
        }
        alive = [worker for worker in listed if worker.state != "ended"]
        self._stopped &= {worker.name for worker in alive} | self._started.keys()
        self._running_since = {
            worker.name: self._running_since.get(worker.name, now_s) for worker in alive if worker.state == "running"
        }
        alive.sort(key=lambda worker: (worker.state == "running", worker.name))
        return [name for name in (*self._started, *(worker.name for worker in alive)) if name not in self._stopped]

    async def _note_ends(self, listed: tuple[LaunchedWorker, ...]) -> None:
        """Log why workers have ended since the last round; after quick failures, delay the next start."""
        ended = {worker.name for worker in listed if worker.state == "ended"}
        news = set() if self._ended is None else ended - self._ended
        for name in sorted(news)[:MOST_EXPLAINED]:
            end = await ask(self._launcher.why_ended(name))
            if end is None:
                continue
            quiet = end.reason in QUIET_ENDS or name in self._stopped
            level = logging.INFO if quiet else logging.WARNING
            log.log(level, "worker %s ended: %s, status %s. %s", name, end.reason, end.status, end.detail)
            ran_s = self._clock_s() - self._running_since.get(name, self._clock_s())
            if not quiet and ran_s < HEALTHY_AFTER_S:
                self._quick_failures += 1
                self._start_after_s = self._clock_s() + START_PAUSES.delay_s(self._quick_failures)
        if len(news) > MOST_EXPLAINED:
            log.info("pool %s: %d other workers ended", self._pool.name, len(news) - MOST_EXPLAINED)
        if any(self._clock_s() - since_s >= HEALTHY_AFTER_S for since_s in self._running_since.values()):
            self._quick_failures = 0
        self._ended = ended

    # -- engine and database --

    async def _read_demand(self, present: list[str]) -> Demand:
        pool = self._pool
        read = partial(
            read_demand,
            reach=self._reach,
            workers=present,
            limit=pool.most * pool.slots + 1,
            others=self._other_reaches,
        )
        return await asyncio.wrap_future(self._database.queue_read(SERVER, SYSTEM, read))
