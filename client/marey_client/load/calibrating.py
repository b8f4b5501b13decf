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
JOBS_OF_A_WORKER = 20
"""Number of jobs in the backlog per worker; at least `FEWEST_JOBS`."""
FEWEST_JOBS = 100

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
class Calibration:
    """Costs of a job on one server.

    `claim_s` and `complete_s` are the durations of the requests of a worker that is alone. `busy_s` is the time for
    which a job occupies the server when many workers compete: the reciprocal of the greatest jobs per second. Each
    number is the median of the rounds. `checked` contains the drains of the checked numbers of workers.
    """

    claim_s: float
    complete_s: float
    busy_s: float
    processor_s: float
    database_bytes: float
    work_s: float
    checked: dict[int, list[float]]


def drain(scratch: Scratch, workers: int, work_s: float) -> Drain:
    """Submit a backlog of jobs, then let simulated workers run it. Raises `MareyError` if a request fails.

    The jobs per second are counted from the first completion to the last one.
    """
    load = OfferedLoad(scratch, own_workers=True)
    load.submit_backlog(max(FEWEST_JOBS, workers * JOBS_OF_A_WORKER))
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
    """Measure the costs of a job, and the drains of other numbers of workers, in turn, several times.

    Measuring in turn lets a change of the machine's speed affect all numbers of workers.
    """
    found: dict[int, list[Drain]] = {count: [] for count in (ALONE, CROWDED, *checked)}
    with scratch_project(marey) as scratch:
        drain(scratch, ALONE, 0.0)
        use, jobs = ServerUse(marey.transport), 0
        for number in range(rounds):
            for count in found:
                on_drain(f"round {number + 1} of {rounds}, {count} workers")
                # Alone and crowded workers do nothing but requests, so that only the server limits them.
                found[count].append(drain(scratch, count, work_s if count in checked else 0.0))
                jobs += max(FEWEST_JOBS, count * JOBS_OF_A_WORKER)
        used = use.figures(jobs)
    alone = found[ALONE]
    return Calibration(
        claim_s=statistics.median(one.claim_s for one in alone),
        complete_s=statistics.median(one.complete_s for one in alone),
        busy_s=statistics.median(1 / one.per_s for one in found[CROWDED]),
        processor_s=used["processor_ms_per_job"] / 1e3,
        database_bytes=used["database_bytes_per_job"],
        work_s=work_s,
        checked={count: [one.per_s for one in found[count]] for count in checked},
    )
