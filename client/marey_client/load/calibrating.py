"""Measurement of the costs of a job in the queue: a backlog of jobs is drained by few and by many simulated workers."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from marey_client.errors import MareyError
from marey_client.load.figures import ServerUse
from marey_client.load.offering import OfferedLoad
from marey_client.load.scratch import Scratch, scratch_project
from marey_client.marey import Marey

ALONE, CROWDED = 1, 16
"""Numbers of workers of the calibration: one that never waits for others, and enough to saturate the server."""
LONGEST_DRAIN_S = 300.0
JOBS_OF_A_WORKER = 10
"""Number of jobs in the backlog per worker; at least `FEWEST_JOBS`."""
FEWEST_JOBS = 60

OnDrain = Callable[[str], None]
"""Function called with the present activity."""


@dataclass(frozen=True)
class Drain:
    """Measured drain of a backlog: jobs per second, and median durations of the requests in seconds."""

    workers: int
    per_s: float
    claim_s: float
    complete_s: float


@dataclass(frozen=True)
class Round:
    """Costs of a job on one server, and the jobs per second of the checked numbers of workers, measured in turn.

    `claim_s` and `complete_s` are the mean durations of the requests of a worker that is alone, so that its jobs per
    second follow from them. `busy_s` is the time for which a job occupies the server when many workers compete: the
    reciprocal of the greatest jobs per second.
    """

    claim_s: float
    complete_s: float
    busy_s: float
    checked: dict[int, float]


@dataclass(frozen=True)
class Calibration:
    """All rounds, and what the server used per job in all of them."""

    rounds: tuple[Round, ...]
    work_s: float
    processor_s: float
    database_bytes: float

    def median(self, cost: Callable[[Round], float]) -> float:
        """Return the median of a number over the rounds."""
        return statistics.median(map(cost, self.rounds))


def drain(scratch: Scratch, workers: int, work_s: float) -> Drain:
    """Submit a backlog of jobs, then let simulated workers run it. Raises `MareyError` if a request fails.

    The jobs per second are counted from the first completion to the last one.
    """
    load = OfferedLoad(scratch, own_workers=True)
    load.submit_backlog(backlog_of(workers))
    begun = time.monotonic()
    with load.workers(workers, work_s):
        load.await_end(LONGEST_DRAIN_S, begun, lambda _: None)
    if load.errors or len(load.completed) < len(load.planned):
        raise MareyError(f"the backlog was not drained without errors: {dict(load.errors) or 'too slow'}")
    ends = sorted(load.completed.values())
    claims = sorted(load.durations_s["claim"])
    return Drain(
        workers,
        (len(ends) - 1) / (ends[-1] - ends[0]),
        statistics.median(claims[: len(ends)]),
        statistics.median(load.durations_s["complete"]),
    )


def calibrate(marey: Marey, checked: Sequence[int], *, rounds: int, work_s: float, on_drain: OnDrain) -> Calibration:
    """Measure the costs of a job, and the drains of other numbers of workers, in several rounds.

    The numbers of a round are compared with each other only, since the speed of the machine may change meanwhile.
    """
    counts = (ALONE, CROWDED, *checked)
    measured, jobs = [], 0
    with scratch_project(marey) as scratch:
        drain(scratch, ALONE, 0.0)
        use = ServerUse(marey.transport)
        for number in range(rounds):
            found = {}
            for count in counts:
                on_drain(f"round {number + 1} of {rounds}, {count} workers")
                # Crowded workers send nothing but requests, so that only the server limits them.
                found[count] = drain(scratch, count, 0.0 if count == CROWDED else work_s)
                jobs += backlog_of(count)
            measured.append(_round(found, checked, work_s))
        used = use.figures(jobs)
    return Calibration(
        tuple(measured), work_s, used["processor_ms_per_job"] / 1e3, max(0.0, used["database_bytes_per_job"])
    )


def _round(found: dict[int, Drain], checked: Sequence[int], work_s: float) -> Round:
    alone = found[ALONE]
    requests_s = 1 / alone.per_s - work_s
    claim_s = requests_s * alone.claim_s / (alone.claim_s + alone.complete_s)
    return Round(
        claim_s, requests_s - claim_s, 1 / found[CROWDED].per_s, {count: found[count].per_s for count in checked}
    )


def backlog_of(workers: int) -> int:
    """Return the number of jobs that a drain by this number of workers submits."""
    return max(FEWEST_JOBS, workers * JOBS_OF_A_WORKER)
