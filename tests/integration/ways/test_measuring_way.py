"""Workflow of measuring a server: the commands of the how-to page, on a real server with a real worker."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest
from tests.support.command_line import CommandLine
from tests.support.server_process import QUICK_LEASES, ServerProcess
from tests.support.tiers import is_soak

from marey_client import Marey
from marey_client.chaos import running
from marey_client.chaos.hostile_attempts import HOSTILE_CASES
from marey_client.chaos.worker_processes import WORKER_FAULTS
from marey_client.load import calibrating
from marey_client.load.scratch import PREFIX

TEXT = (Path(__file__).parents[3] / "docs" / "how-to" / "measure-a-server.md").read_text(encoding="utf-8")
SHORT = ["--seconds", "1", "--replicates", "1"]
"""Options that shorten the load tests of the page."""


def told(*words: str) -> list[str]:
    """Return the arguments of the only command of the page that begins with `marey`, followed by the given words."""
    lines = [line for block in re.findall(r"```sh\n(.*?)```", TEXT, re.DOTALL) for line in block.splitlines()]
    (found,) = [line for line in lines if line.startswith(" ".join(("marey", *words)))]
    return shlex.split(found)[1:]


@pytest.mark.soak
def test_a_running_server_is_measured_and_keeps_no_scratch_project(run: CommandLine, marey: Marey) -> None:
    shown = run(*told("bench", "load", "--rate", "10,50,100"), *SHORT)
    assert "cycles/s" in shown.stdout
    assert shown.stderr.count("ms of processor time") == 3
    shown = run(*told("bench", "load", "--rate", "1", "--seconds"), "--rate", "3", *SHORT)
    assert "start p50" in shown.stdout
    assert [one.name for one in marey.projects() if one.name.startswith(PREFIX)] == []


def test_the_capacity_is_computed(run: CommandLine) -> None:
    assert "saturates first" in run(*told("capacity")).stdout


@pytest.mark.soak
def test_a_new_server_is_measured_and_removed(run: CommandLine, monkeypatch: pytest.MonkeyPatch) -> None:
    if not is_soak():
        monkeypatch.setattr(calibrating, "FEWEST_JOBS", 6)
        monkeypatch.setattr(calibrating, "JOBS_OF_A_WORKER", 2)
    assert "cycles/s" in run(*told("bench", "serve"), *SHORT).stdout
    assert "predicted jobs/s" in run(*told("bench", "costs"), "--rounds", "1").stdout


@pytest.mark.soak
@pytest.mark.timeout(600)
def test_each_fault_happens_and_each_job_has_one_visible_result(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Outside the tier `soak`, fewer workers start: `tests/faults` kills workers at every point."""
    faults, healthy = (WORKER_FAULTS, running.HEALTHY_WORKERS) if is_soak() else (WORKER_FAULTS[::2], 1)
    monkeypatch.setattr(running, "WORKER_FAULTS", faults)
    monkeypatch.setattr(running, "HEALTHY_WORKERS", healthy)
    total = len(HOSTILE_CASES) + len(faults)
    server = ServerProcess(tmp_path, **QUICK_LEASES).start()
    try:
        shown = CommandLine(server, tmp_path)(*told("doctor", "--chaos"), "--faults", total)
        with server.client() as marey:
            assert list(marey.projects()) == []
    finally:
        server.stop()
    assert shown.stderr.startswith("seed 7\n")
    assert shown.stdout.count("one visible result after") == total + healthy
    for fault in ("killed after claim", "killed before complete", "paused before complete", "stale fence"):
        assert fault in shown.stdout
