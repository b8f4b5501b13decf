"""Workflow of a schedule: the commands and the Python of the how-to page, on a real server with a real worker."""

from __future__ import annotations

import re
import shlex
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from tests.support.command_line import CommandLine
from tests.support.present import present

from marey_client import Marey
from marey_client.project import ProjectHandle
from marey_motion.formats import write_bvh
from marey_motion.gait import generate_gait
from marey_schemas.queue.schedules import ScheduleChange

pytestmark = pytest.mark.timeout(300)

TEXT = (Path(__file__).parents[3] / "docs" / "how-to" / "schedule-jobs.md").read_text(encoding="utf-8")


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", TEXT, re.DOTALL)


@pytest.fixture
def lab(lab_of: Callable[..., ProjectHandle], tmp_path: Path) -> ProjectHandle:
    (tmp_path / "walk.bvh").write_bytes(write_bvh(generate_gait(1.3, 0.5, 3.0)))
    return lab_of(tmp_path / "walk.bvh", collection="studio")


def test_the_commands_and_the_python_of_the_page_work_in_their_order(
    marey: Marey, lab: ProjectHandle, run: CommandLine, tmp_path: Path
) -> None:
    (tmp_path / "nightly.json").write_text(blocks("json")[0])
    lines = [line for block in blocks("sh") for line in block.splitlines()]
    printed = {line: run(*shlex.split(line)[1:]).stdout for line in lines}
    assert "Europe/Berlin" in printed["marey schedule ls lab"]
    assert "0 3 * * 1-5" in printed["marey schedule show lab nightly"]
    job = marey.jobs.get(printed["marey schedule run lab nightly"].split()[1])
    assert (job.kind, job.into) == ("export", "exports")
    assert list(lab.schedules.list()) == []
    (python,) = blocks("python")
    exec(compile(python, "schedule-jobs.md", "exec"), {"project": lab})
    assert list(lab.schedules.list()) == []


def test_the_server_submits_a_job_at_its_time_and_the_worker_runs_it(
    marey: Marey, lab: ProjectHandle, run: CommandLine, tmp_path: Path
) -> None:
    (tmp_path / "nightly.json").write_text(blocks("json")[0])
    run("schedule", "create", "lab", "minutely", "--cron", "* * * * *", "--job", "nightly.json")
    deadline = time.monotonic() + 150
    while (found := lab.schedules.at("minutely").read()).last_job is None:
        assert time.monotonic() < deadline, found
        time.sleep(0.5)
    lab.schedules.at("minutely").change(ScheduleChange(paused=True))
    assert marey.jobs.wait(present(found.last_job), timeout_s=60).state == "succeeded"
