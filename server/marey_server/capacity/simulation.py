"""Discrete-event simulation of the queue: workers claim, run and complete jobs by the rules of the real queue.

The order of claims, the lock by concurrency keys, labels, leases, lost attempts, and retries after failures follow
`marey_server.store.jobs`; durations and limits are those of its `QueuePolicy`. The server is a number of equal stations
with one waiting line: each request occupies a station for some time, and the worker waits some further time for the
answer. Time is in seconds from the start of the simulation.
"""

from __future__ import annotations

import heapq
import itertools
import random
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

from marey_server.store.jobs.policy import DEFAULT_POLICY, SECOND_US, QueuePolicy

FIRST_HEARTBEAT_S = 1.0
"""Time in seconds from the start of an attempt to its first heartbeat.

An attempt that is lost before this heartbeat does not count towards `max_attempts`.
"""


@dataclass(frozen=True)
class RequestCosts:
    """Costs of one request, in seconds.

    The request occupies a station of the server for `busy_s`. Then the worker waits `idle_s` more for the answer. A
    station stands for a part of the server that processes one request at a time.
    """

    busy_s: float = 0.0
    idle_s: float = 0.0


FREE = RequestCosts()


@dataclass(frozen=True)
class QueueCosts:
    """Costs of the requests of workers, and the number of stations that process requests at the same time.

    If `batch_s` is not 0, a station processes all waiting requests together, like writes with a common commit: the
    batch occupies the station for `batch_s` plus the `busy_s` of each request. The times of requests have a gamma
    distribution with the coefficient of variation (standard deviation over mean) `variation`; 0: they are constant.
    """

    claim: RequestCosts = FREE
    complete: RequestCosts = FREE
    heartbeat: RequestCosts = FREE
    stations: int = 1
    batch_s: float = 0.0
    variation: float = 0.0


@dataclass(frozen=True)
class SimulatedJob:
    """A job: when it is submitted, how long a worker needs for it, and the fields that decide when it may run."""

    submitted_s: float
    work_s: float
    priority: int = 0
    concurrency_key: str | None = None
    labels: frozenset[str] = frozenset()
    max_attempts: int = 3


@dataclass(frozen=True)
class FailureRates:
    """Probabilities that an attempt fails at its end, and that its worker dies at a random time of the attempt.

    A dead worker is replaced at once, but its job waits for the end of the lease.
    """

    failure: float = 0.0
    death: float = 0.0


NO_FAILURES = FailureRates()


@dataclass
class JobHistory:
    """History of a simulated job: its starts, its end, and the numbers of its attempts and failures.

    Times are in seconds from the start of the simulation. `end_s` is None if the job was never completed; `unstarted`
    counts attempts whose worker died before the first heartbeat.
    """

    starts_s: list[float] = field(default_factory=list)
    end_s: float | None = None
    failures: int = 0
    attempts: int = 0
    unstarted: int = 0
    failed: bool = False


@dataclass(frozen=True)
class SimulatedRun:
    """Result of a simulation: the history of each job, in the order of the jobs, and the simulated time in `seconds`.

    `busy_share` is the share of this time in which the server was occupied.
    """

    jobs: list[JobHistory]
    busy_share: float
    seconds: float

    @property
    def per_s(self) -> float:
        """Completed jobs per second, from the first completion to the last one."""
        ends = sorted(one.end_s for one in self.jobs if one.end_s is not None)
        return (len(ends) - 1) / (ends[-1] - ends[0])


def simulate(
    jobs: Sequence[SimulatedJob],
    workers: Sequence[frozenset[str]],
    costs: QueueCosts,
    *,
    seed: int = 0,
    failure_rates: FailureRates = NO_FAILURES,
    policy: QueuePolicy = DEFAULT_POLICY,
) -> SimulatedRun:
    """Simulate the queue until no event is left; equal arguments give equal results.

    `workers` contains the labels of each worker. A job that no worker may run is never started.
    """
    return _Simulation(jobs, workers, costs, random.Random(seed), failure_rates, policy).run()  # noqa: S311 - no secret


class _Simulation:
    def __init__(
        self,
        jobs: Sequence[SimulatedJob],
        workers: Sequence[frozenset[str]],
        costs: QueueCosts,
        draw: random.Random,
        failure_rates: FailureRates,
        policy: QueuePolicy,
    ) -> None:
        self._jobs, self._workers, self._costs, self._draw = jobs, workers, costs, draw
        self._failure_rates = failure_rates
        self._policy = replace(policy, random_unit=draw.random)
        self._now_s = 0.0
        self._events: list[tuple[float, int, Callable[[], None]]] = []
        self._numbers = itertools.count()
        self._histories = [JobHistory() for _ in jobs]
        self._queued: list[tuple[int, float, int]] = []  # heap in the order of claims
        self._idle: deque[int] = deque()
        self._keys: set[str] = set()
        self._free_stations = costs.stations
        self._line: deque[tuple[RequestCosts, Callable[[], None]]] = deque()
        self._busy_s = 0.0

    def run(self) -> SimulatedRun:
        for number, job in enumerate(self._jobs):
            self._at(job.submitted_s, lambda number=number: self._queue(number, self._now_s))
        for worker in range(len(self._workers)):
            self._at(0.0, lambda worker=worker: self._ask(worker))
        while self._events:
            self._now_s, _, act = heapq.heappop(self._events)
            act()
        share = self._busy_s / (self._now_s * self._costs.stations) if self._now_s else 0.0
        return SimulatedRun(self._histories, share, self._now_s)

    def _at(self, time_s: float, act: Callable[[], None]) -> None:
        heapq.heappush(self._events, (time_s, next(self._numbers), act))

    # -- the server --

    def _request(self, costs: RequestCosts, answered: Callable[[], None]) -> None:
        """Send a request; `answered` is called when the server has processed it, before the answer arrives."""
        if not costs.busy_s:
            answered()
            return
        self._line.append((costs, answered))
        self._serve()

    def _serve(self) -> None:
        while self._free_stations and self._line:
            together = len(self._line) if self._costs.batch_s else 1
            taken = [self._line.popleft() for _ in range(together)]
            self._free_stations -= 1
            busy_s = self._drawn(self._costs.batch_s + sum(costs.busy_s for costs, _ in taken))
            self._busy_s += busy_s

            def done(taken: list[tuple[RequestCosts, Callable[[], None]]] = taken) -> None:
                self._free_stations += 1
                for _, answered in taken:
                    answered()
                self._serve()

            self._at(self._now_s + busy_s, done)

    def _drawn(self, mean_s: float) -> float:
        """Draw the duration of a request, in seconds, from a distribution with the mean `mean_s`."""
        if not mean_s or not self._costs.variation:
            return mean_s
        shape = self._costs.variation**-2
        return self._draw.gammavariate(shape, mean_s / shape)

    # -- the queue --

    def _queue(self, number: int, run_at_s: float) -> None:
        """Queue the job with this number, which may run from `run_at_s` on."""
        if run_at_s > self._now_s:
            self._at(run_at_s, lambda: self._queue(number, run_at_s))
            return
        heapq.heappush(self._queued, (-self._jobs[number].priority, run_at_s, number))
        self._wake()

    def _wake(self) -> None:
        """Let idle workers that may run a queued job claim again, but at most as many workers as jobs are queued."""
        fit = (
            worker
            for worker in list(self._idle)
            if any(self._jobs[number].labels <= self._workers[worker] for _, _, number in self._queued)
        )
        for worker in itertools.islice(fit, len(self._queued)):
            self._idle.remove(worker)
            self._ask(worker)

    def _ask(self, worker: int) -> None:
        self._request(self._costs.claim, lambda: self._claim(worker))

    def _claim(self, worker: int) -> None:
        number = self._pick(self._workers[worker])
        if number is None:
            self._idle.append(worker)
            return
        key = self._jobs[number].concurrency_key
        if key is not None:
            self._keys.add(key)
        expires_s = self._now_s + self._policy.lease_ttl_s
        self._at(self._now_s + self._drawn(self._costs.claim.idle_s), lambda: self._start(worker, number, expires_s))

    def _pick(self, labels: frozenset[str]) -> int | None:
        """Remove and return the first queued job that a worker with these labels may run now, or None."""
        passed = []
        found = None
        while self._queued and found is None:
            place = heapq.heappop(self._queued)
            job = self._jobs[place[2]]
            if job.labels <= labels and job.concurrency_key not in self._keys:
                found = place[2]
            else:
                passed.append(place)
        for place in passed:
            heapq.heappush(self._queued, place)
        return found

    # -- attempts --

    def _start(self, worker: int, number: int, expires_s: float) -> None:
        history, work_s = self._histories[number], self._jobs[number].work_s
        history.starts_s.append(self._now_s)
        dies = self._draw.random() < self._failure_rates.death
        lived_s = work_s * self._draw.random() if dies else work_s
        beats = list(_heartbeats(lived_s, self._policy.heartbeat_s))
        for beat_s in beats:
            self._at(self._now_s + beat_s, lambda: self._request(self._costs.heartbeat, lambda: None))
        if not dies:
            self._at(self._now_s + work_s, lambda: self._finish(worker, number))
            return
        renewed_s = self._now_s + beats[-1] + self._policy.lease_ttl_s if beats else expires_s
        self._at(self._now_s + lived_s, lambda: self._ask(worker))
        self._at(renewed_s, lambda: self._lose(number, counted=bool(beats)))

    def _finish(self, worker: int, number: int) -> None:
        failed = self._draw.random() < self._failure_rates.failure

        def answered() -> None:
            self._end(number, failed=failed)
            self._at(self._now_s + self._drawn(self._costs.complete.idle_s), lambda: self._ask(worker))

        self._request(self._costs.complete, answered)

    def _end(self, number: int, *, failed: bool) -> None:
        history = self._histories[number]
        history.attempts += 1
        if not failed:
            history.end_s = self._now_s
            self._release(number)
            return
        history.failures += 1
        self._again(number, wait_s=self._policy.backoff_us(history.failures) / SECOND_US)

    def _lose(self, number: int, *, counted: bool) -> None:
        """Take a job back from a dead worker at the end of its lease.

        `counted` is true if the attempt counts, because it has sent a heartbeat.
        """
        history = self._histories[number]
        if counted:
            history.attempts += 1
        else:
            history.unstarted += 1
        self._again(number, wait_s=0.0)

    def _again(self, number: int, *, wait_s: float) -> None:
        """Queue a job again `wait_s` seconds after a failed or lost attempt, or end it as failed.

        The job fails if no attempts are left, or if too many attempts were lost before their first heartbeat.
        """
        history = self._histories[number]
        over = history.attempts >= self._jobs[number].max_attempts or history.unstarted > self._policy.max_unstarted
        history.failed = over
        if not over:
            self._queue(number, self._now_s + wait_s)
        self._release(number)

    def _release(self, number: int) -> None:
        """Free the concurrency key of a job, and let another job with this key start."""
        key = self._jobs[number].concurrency_key
        if key is not None:
            self._keys.discard(key)
            self._wake()


def _heartbeats(seconds: float, every_s: float) -> list[float]:
    """Return the times of the heartbeats of an attempt that lasts `seconds`, in seconds from its start."""
    later = itertools.takewhile(lambda beat_s: beat_s < seconds, itertools.count(every_s, every_s))
    return [beat_s for beat_s in (FIRST_HEARTBEAT_S, *later) if beat_s < seconds]
