"""The trials of a whole installation, in short forms; `make soak` runs the long ones."""

from __future__ import annotations

import re
import subprocess
import sys

import numpy as np
import pytest
from tests.support.endurance.faults import FAULTS, plan
from tests.support.endurance.installation import left_behind
from tests.support.endurance.measured_growth import growth_of

pytestmark = pytest.mark.timeout(900)


def trial(*words: str) -> subprocess.CompletedProcess[str]:
    """Run a trial as its users do: it adopts orphans of its processes, which would disturb other tests."""
    command = [sys.executable, "-m", "tests.support.endurance", *words]
    return subprocess.run(command, capture_output=True, text=True, timeout=800, check=False)


def test_jobs_under_faults_have_the_results_of_a_quiet_run() -> None:
    done = trial("faults", "--rounds", "10", "--seconds", "8", "--every", "0.7", "--workers", "3")
    assert done.returncode == 0, done.stdout[-6000:] + done.stderr[-3000:]
    assert "fault 2 of" in done.stdout, done.stdout
    assert "fire: 15 jobs" in done.stdout, done.stdout


@pytest.mark.soak
def test_the_trial_finds_that_fences_are_not_compared() -> None:
    """A worker that is suspended while it draws completes a job that another worker has by then.

    In one trial, all suspended workers may be idle, so there are up to three.
    """
    words = ("--rounds", "8", "--seconds", "40", "--every", "0.6", "--slow", "9", "--jobs", "draw")
    told = ""
    for _ in range(3):
        done = trial("faults", *words, "--only", "worker suspended", "--without-fence")
        told += done.stdout[-3000:] + done.stderr[-1000:]
        if done.returncode == 1 and re.search(r"BROKEN (the item draw|fire)", done.stdout):
            return
    pytest.fail(told)


@pytest.mark.soak
def test_a_short_load_breaks_no_rule() -> None:
    done = trial("load", "--minutes", "1", "--rate", "8", "--read-ms", "5000")
    assert done.returncode == 0, done.stdout[-6000:] + done.stderr[-3000:]


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
