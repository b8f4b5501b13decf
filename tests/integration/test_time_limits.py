"""A job that exceeds its time limit, on a real server with a real worker."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from tests.support.attached_worker import python_path
from tests.support.server_process import ServerProcess

from marey_client import Marey
from marey_client.errors import JobUnsuccessful
from marey_schemas.access import ProjectCreate
from marey_schemas.queue.jobs import FailureReason, JobCreate, JobState, Resources


@pytest.fixture
def marey(tmp_path: Path) -> Iterator[Marey]:
    """The client of a server with a worker that knows a kind of job that can sleep."""
    process = ServerProcess(tmp_path, PYTHONPATH=python_path())
    process.start(workers=1)
    with process.client() as client:
        yield client
    assert process.stop() == 0


def test_a_job_over_its_time_has_failed_for_that_and_is_not_tried_again(marey: Marey) -> None:
    project = marey.create_project(ProjectCreate(name="lab"))
    sleep = {"how": "sleep", "seconds": 60}
    job = project.submit(JobCreate(kind="misbehave", params=sleep, resources=Resources(time_limit_s=1)))
    with pytest.raises(JobUnsuccessful):
        marey.jobs.wait(job.id, timeout_s=60)
    ended = marey.jobs.get(job.id)
    assert ended.state == JobState.FAILED
    assert ended.failure is not None
    assert ended.failure.reason == FailureReason.TIMEOUT
    assert "limit of 1 s" in ended.failure.detail
    (attempt,) = marey.jobs.attempts(job.id)
    assert attempt.outcome == "timeout"
