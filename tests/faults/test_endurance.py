"""The trials of a whole installation, in short forms; `make soak` runs the long ones."""

from __future__ import annotations

import os
import re
import subprocess
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from tests.support.endurance.faults import FAULTS, plan
from tests.support.endurance.installation import left_behind
from tests.support.endurance.measured_growth import growth_of
from tests.support.forked_programs import nursery

pytestmark = pytest.mark.timeout(900)


@dataclass(frozen=True)
class Ended:
    """End of a trial: its exit status, and its output including the error output."""

    status: int
    output: str


Trial = Callable[..., Ended]


@pytest.fixture
def trial(tmp_path: Path) -> Trial:
    """Function that runs a trial in a process of its own: it adopts orphans, which would disturb other tests."""

    def run(*words: str) -> Ended:
        file = tmp_path / "output"
        with file.open("wb") as output:
            process = nursery().start(
                ["tests.support.endurance", *words],
                dict(os.environ),
                output=output.fileno(),
                with_stdin=False,
                own_children=True,
            )
        try:
            return Ended(process.wait(800), file.read_text())
        finally:
            process.kill()

    return run


@pytest.mark.soak
def test_jobs_under_faults_have_the_results_of_a_quiet_run(trial: Trial) -> None:
    done = trial("faults", "--rounds", "10", "--seconds", "8", "--every", "0.7", "--workers", "3")
    assert done.status == 0, done.output[-6000:]
    assert "fault 2 of" in done.output, done.output
    assert "fire: 15 jobs" in done.output, done.output


@pytest.mark.soak
def test_the_trial_finds_that_fences_are_not_compared(trial: Trial) -> None:
    """A suspended worker continues after its lease has ended, and completes a job that another worker is running.

    In a trial, all suspended workers may be idle, so up to three trials run.
    """
    words = ("--rounds", "8", "--seconds", "40", "--every", "0.6", "--slow", "9", "--jobs", "draw")
    told = ""
    for _ in range(3):
        done = trial("faults", *words, "--only", "worker suspended", "--without-fence")
        told += done.output[-3000:]
        if done.status == 1 and re.search(r"BROKEN (the item draw|fire)", done.output):
            return
    pytest.fail(told)


@pytest.mark.soak
def test_a_short_load_breaks_no_rule(trial: Trial) -> None:
    done = trial("load", "--minutes", "1", "--rate", "8", "--read-ms", "5000")
    assert done.status == 0, done.output[-6000:]


def test_equal_seeds_give_equal_faults_and_every_kind_happens() -> None:
    plans = [plan(seed, 200.0, 1.0, FAULTS) for seed in (1, 1, 2)]
    assert plans[0] == plans[1] != plans[2]
    assert {fault.name for fault in plans[0]} == set(FAULTS)
    assert {fault.name for fault in plan(1, 20.0, 1.0, ["server killed"])} == {"server killed"}


def test_a_process_that_is_left_behind_is_found() -> None:
    with subprocess.Popen(["sleep", "60"]) as left:
        try:
            assert f"the process {left.pid} is left: sleep 60" in left_behind(())
            assert not any(str(left.pid) in one for one in left_behind({left.pid}))
        finally:
            left.kill()


def test_growth_is_found_with_its_interval() -> None:
    chance = np.random.default_rng(1)
    times_s = np.arange(0.0, 1800.0, 5.0)
    grown = growth_of(times_s, 200 + times_s / 36 + chance.normal(0, 1, len(times_s)))
    assert abs(grown.slope_mb_h - 100) < grown.margin_mb_h < 10
    steady = growth_of(times_s, 200 + chance.normal(0, 1, len(times_s)))
    assert abs(steady.slope_mb_h) < 2 * steady.margin_mb_h
    with pytest.raises(ValueError, match="run the trial for longer"):
        growth_of(times_s[:5], times_s[:5])
