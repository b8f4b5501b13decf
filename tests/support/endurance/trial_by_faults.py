"""Trial by faults: mixed jobs run once undisturbed and once under faults, with equal results."""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from benchmarks.pipeline_under_fire import write_takes
from tests.support.endurance.faults import FAULTS, Fault, inject, plan
from tests.support.endurance.installation import SERVE, WITHOUT_FENCE, WORKERS, Installation, installation
from tests.support.endurance.workload import Ends, Workload, new_workload

TAKES = 6
END_S = 300.0
"""Longest time until all jobs have ended, after the last fault."""
Say = Callable[[str], None]


@dataclass(frozen=True)
class FaultTrial:
    """Parameters of a trial: number of calls that submit jobs, duration of the faults in seconds, seed, and others."""

    rounds: int
    seconds: float
    seed: int
    every_s: float = 3.0
    s3: str = "seaweedfs"
    workers: int = WORKERS
    names: Collection[str] = ()
    """Kinds of faults; empty: all."""
    slow_s: float = 0.0
    fenced: bool = True
    """False: the servers do not compare fences, so that the trial must find broken rules."""
    only: Collection[str] = ()
    """Kinds of jobs; empty: all."""
    keep_logs: Path | None = None


def run(trial: FaultTrial, say: Say) -> list[str]:
    """Run a trial, and return the rules that were broken."""
    possible = [name for name in FAULTS if not (trial.s3 == "moto" and name == "S3 server killed")]  # it has no disk
    faults = plan(trial.seed, trial.seconds, trial.every_s, trial.names or possible)
    module = SERVE if trial.fenced else WITHOUT_FENCE
    with installation(trial.s3, workers=trial.workers, module=module, keep_logs=trial.keep_logs) as made:
        made.begin_work()
        say("the installation runs")
        takes = write_takes(made.folder / "material", TAKES, seconds=1.0)
        broken: list[str] = []
        ends: dict[str, Ends] = {}
        first = new_workload(made.client(), "peace", takes, slow_s=trial.slow_s, kinds=trial.only)
        say("the clips are imported")
        phases: dict[str, list[Fault]] = {"peace": [], "fire": faults}
        for name, planned in phases.items():
            begun = time.monotonic()
            work = first if name == "peace" else first.beside(name)
            _submit_under(made, work, trial.rounds, planned, say)
            broken += work.await_end(END_S)
            ends[name] = work.ends()
            broken += [f"{name}: {one}" for one in ends[name].faults]
            say(_summary(name, work, ends[name], time.monotonic() - begun))
        broken += _differences(ends["peace"], ends["fire"])
        broken += made.stop_marey()
        broken += [f"fsck: {one}" for one in made.check_store()]
    return broken


def _submit_under(made: Installation, work: Workload, rounds: int, faults: list[Fault], say: Say) -> None:
    """Submit all jobs; if faults happen meanwhile, a few at a time."""
    pause_s = sum(one.after_s + one.seconds for one in faults) / 2 / max(1, rounds)
    stopping = threading.Event()
    with ThreadPoolExecutor(1) as pool:
        submitting = pool.submit(_submit_all, work, rounds, pause_s, stopping)
        try:
            for number, fault in enumerate(faults):
                time.sleep(fault.after_s)
                say(f"fault {number + 1} of {len(faults)}: {fault}")
                inject(made, fault)
        except BaseException:
            stopping.set()
            raise
        submitting.result()


def _submit_all(work: Workload, rounds: int, pause_s: float, stopping: threading.Event) -> None:
    for number in range(rounds):
        if stopping.is_set():
            return
        work.submit(number)
        stopping.wait(pause_s)


def _differences(peace: Ends, fire: Ends) -> Iterator[str]:
    """Yield the jobs and items that differ between the two runs."""
    for what, one, other in (("job", peace.jobs, fire.jobs), ("item", peace.contents, fire.contents)):
        for name in sorted(one.keys() | other.keys()):
            if one.get(name) != other.get(name):
                yield f"the {what} {name} is {other.get(name)} under faults, and {one.get(name)} without"


def _summary(name: str, work: Workload, ends: Ends, seconds: float) -> str:
    states = Counter(text.partition(" ")[0] for text in ends.jobs.values())
    return (
        f"{name}: {len(work.submitted)} jobs in {seconds:.0f} s, {_counts(states)}; "
        f"attempts: {_counts(ends.attempts)}; {len(ends.contents)} items"
    )


def _counts(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{count} {name}" for name, count in sorted(counts.items()))
