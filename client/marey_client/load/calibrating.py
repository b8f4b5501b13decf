"""Measurement of the costs of a job in the queue: a backlog of jobs is drained by few and by many simulated workers."""

from __future__ import annotations

import itertools
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from marey_client.errors import MareyError
from marey_client.load.figures import ServerUse
from marey_client.load.offering import OfferedLoad
from marey_client.load.scratch import Scratch, scratch_project
from marey_client.marey import Marey

ALONE, SOME, CROWDED = 1, 4, 16
"""Numbers of workers of the calibration: a single worker, some workers, and enough workers to saturate the server."""
LONGEST_DRAIN_S = 300.0
JOBS_OF_A_WORKER = 10
"""Number of jobs in the backlog for each worker; a backlog has at least `FEWEST_JOBS` jobs."""
FEWEST_JOBS = 60

OnDrain = Callable[[str], None]
"""Function called with a text on the present round of the measurement."""


@dataclass(frozen=True)
class Drain:
    """Measurement of a backlog that workers completed: jobs per second, and the durations of requests in seconds."""

    per_s: float
    claims_s: tuple[float, ...]
    completions_s: tuple[float, ...]


@dataclass(frozen=True)
class Calibration:
    """Costs of a job on one server, and the measured jobs per second by number of workers, in `checked`.

    `claim_s` and `complete_s` are the mean durations of the two requests of a single worker, in seconds; `variation` is
    the standard deviation of these durations divided by the mean. `busy_s` is the time per job when `CROWDED` workers
    compete. `some_per_s` is the number of jobs per second of `SOME` workers. `work_s` is the time per job that a single
    worker spends outside its requests; it is longer than planned on a busy machine. `processor_s` and `database_bytes`
    are the processor time of the server and the growth of the database per job. All values are computed from all
    rounds.
    """

    claim_s: float
    complete_s: float
    variation: float
    busy_s: float
    work_s: float
    processor_s: float
    database_bytes: float
    some_per_s: float
    checked: dict[int, float]


def drain(scratch: Scratch, workers: int, work_s: float) -> Drain:
    """Submit a backlog of jobs, then let simulated workers run all of its jobs.

    The jobs per second are counted from the first completion to the last one. Raises `MareyError` if a request fails,
    or if jobs have not ended after `LONGEST_DRAIN_S`.
    """
    load = OfferedLoad(scratch, own_workers=True)
    load.submit_backlog(backlog_of(workers))
    begun = time.monotonic()
    with load.workers(workers, work_s):
        load.await_end(LONGEST_DRAIN_S, begun, lambda _: None)
    if load.errors or len(load.completed) < len(load.planned):
        answers = ", ".join(sorted(load.errors))
        why = f"the server answered: {answers}" if answers else f"they were not done after {LONGEST_DRAIN_S:g} s"
        raise MareyError(
            f"the simulated workers did not complete all jobs of the measurement; {why}; give a smaller --work-ms, or "
            "other --workers"
        )
    ends = sorted(load.completed.values())
    claims = sorted(load.durations_s["claim"])[: len(ends)]  # the longest are those that waited in vain at the end
    return Drain((len(ends) - 1) / (ends[-1] - ends[0]), tuple(claims), tuple(load.durations_s["complete"]))


def calibrate(marey: Marey, checked: Sequence[int], *, rounds: int, work_s: float, on_drain: OnDrain) -> Calibration:
    """Measure the costs of a job, and the jobs per second of the numbers of workers in `checked`.

    Each of the `rounds` measures every number of workers once, so that a change of the machine's speed affects all
    numbers alike.
    """
    counts = (ALONE, SOME, CROWDED, *checked)
    found: dict[int, list[Drain]] = {count: [] for count in counts}
    with scratch_project(marey) as scratch:
        drain(scratch, ALONE, 0.0)
        use = ServerUse(marey.transport)
        for number in range(rounds):
            for count in counts:
                on_drain(f"round {number + 1} of {rounds}, {count} workers")
                # Crowded workers send nothing but requests, so that only the server limits them.
                found[count].append(drain(scratch, count, 0.0 if count == CROWDED else work_s))
        used = use.figures(rounds * sum(map(backlog_of, counts)))
    requests_s = [
        list(itertools.chain.from_iterable(parts))
        for parts in ([one.claims_s for one in found[ALONE]], [one.completions_s for one in found[ALONE]])
    ]
    claim_s, complete_s = map(statistics.fmean, requests_s)
    return Calibration(
        claim_s=claim_s,
        complete_s=complete_s,
        variation=statistics.fmean(statistics.pstdev(one) / statistics.fmean(one) for one in requests_s),
        busy_s=1 / _together(found[CROWDED]),
        work_s=max(0.0, 1 / _together(found[ALONE]) - claim_s - complete_s),
        processor_s=used["processor_ms_per_job"] / 1e3,
        database_bytes=max(0.0, used["database_bytes_per_job"]),
        some_per_s=_together(found[SOME]),
        checked={count: _together(found[count]) for count in checked},
    )


def _together(drains: Sequence[Drain]) -> float:
    """Return the mean jobs per second of drains with equal numbers of jobs: all jobs divided by the total time."""
    return statistics.harmonic_mean([one.per_s for one in drains])


def backlog_of(workers: int) -> int:
    """Return the number of jobs in the backlog for this number of workers."""
    return max(FEWEST_JOBS, workers * JOBS_OF_A_WORKER)
