"""Load test of a server: runs at several rates, each repeated, in a scratch project."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

from marey_client.errors import MareyError
from marey_client.load.figures import MOST_REPLICATES, RateFigures, Replicate, ServerUse
from marey_client.load.offering import arrival_times, run_with_other_workers, run_with_own_workers
from marey_client.load.scratch import Scratch, scratch_project
from marey_client.marey import Marey

OnRun = Callable[[str, float, float | None], None]
"""Function called with the present activity, the seconds since its start, and its planned seconds."""

SAMPLE_EVERY_S = 1.0
WARM_UP_S = 1.0
MOST_RATE = 10_000.0
MOST_WORKERS = 256
LONGEST_S = 3600.0
LONGEST_WORK_S = 600.0


@dataclass(frozen=True)
class LoadPlan:
    """Plan of a load test.

    Parameters
    ----------
    rates : submissions per second; the test runs at one rate after the other
    seconds : duration of the submissions of a run
    replicates : number of runs at each rate, for the confidence intervals
    workers : number of simulated workers; 0: the other workers of the server run the jobs
    work_s : seconds for which a simulated worker works on a job
    seed : seed of the random times of the submissions
    """

    rates: tuple[float, ...]
    seconds: float = 20.0
    replicates: int = 3
    workers: int = 4
    work_s: float = 0.0
    seed: int = 0

    def __post_init__(self) -> None:
        if not self.rates or not all(0 < rate <= MOST_RATE for rate in self.rates):
            raise ValueError(f"rates must be greater than 0 and at most {MOST_RATE:,.0f} per second")
        if not 1 <= self.seconds <= LONGEST_S:
            raise ValueError(f"the seconds of a run must be between 1 and {LONGEST_S:,.0f}")
        if not 1 <= self.replicates <= MOST_REPLICATES:
            raise ValueError(f"the number of replicates must be between 1 and {MOST_REPLICATES}")
        if not 0 <= self.workers <= MOST_WORKERS:
            raise ValueError(f"the number of workers must be at most {MOST_WORKERS}")
        if not 0 <= self.work_s <= LONGEST_WORK_S:
            raise ValueError(f"the work of a job must last between 0 and {LONGEST_WORK_S:,.0f} s")


def load_test(marey: Marey, plan: LoadPlan, on_run: OnRun) -> Iterator[RateFigures]:
    """Run a load test in a scratch project; yield the figures of each rate when they are known.

    The project is removed at the end, also after an error or Ctrl-C. For administrators, the figures contain what the
    server used. Raises `MareyError` if the server cannot be tested with this token.
    """
    administrator = (user := marey.me().user) is not None and user.administrator
    with scratch_project(marey) as scratch:
        on_run("warm-up", 0.0, WARM_UP_S)
        _run(scratch, plan, min(plan.rates), WARM_UP_S, plan.seed, lambda _: None)
        for place, rate in enumerate(plan.rates):
            use = ServerUse(marey.transport) if administrator else None
            replicates = []
            for number in range(plan.replicates):
                what = f"{rate:g}/s, run {number + 1} of {plan.replicates}"
                tick = _ticking(use, lambda seconds, what=what: on_run(what, seconds, plan.seconds))
                seed = plan.seed + place * MOST_REPLICATES + number
                replicates.append(_run(scratch, plan, rate, plan.seconds, seed, tick))
            completed = sum(one.completed for one in replicates)
            if not completed:
                raise MareyError(_nothing_completed(plan, replicates))
            yield RateFigures.of(rate, replicates, use.figures(completed) if use else {})


def _run(
    scratch: Scratch, plan: LoadPlan, rate: float, seconds: float, seed: int, tick: Callable[[float], None]
) -> Replicate:
    times_s = arrival_times(rate, seconds, seed)
    if plan.workers == 0:
        return run_with_other_workers(scratch, times_s, seconds, tick=tick)
    return run_with_own_workers(scratch, times_s, seconds, workers=plan.workers, work_s=plan.work_s, tick=tick)


def _ticking(use: ServerUse | None, report: Callable[[float], None]) -> Callable[[float], None]:
    """Return a function that reports the progress of a run, and reads the server's metrics about once a second."""
    sampled = time.monotonic()

    def tick(seconds: float) -> None:
        nonlocal sampled
        report(seconds)
        if use is not None and time.monotonic() - sampled >= SAMPLE_EVERY_S:
            sampled = time.monotonic()
            use.sample()

    return tick


def _nothing_completed(plan: LoadPlan, replicates: list[Replicate]) -> str:
    errors = ", ".join(sorted({what for one in replicates for what in one.errors}))
    if errors:
        return f"no job was completed; the server answered: {errors}"
    if not any(one.submitted for one in replicates):
        return "no job was submitted, because the runs are too short for this rate; give more --seconds"
    hint = "" if plan.workers else "; `marey worker ls` shows the workers of the server"
    return f"no job was completed, and there was no error{hint}"
