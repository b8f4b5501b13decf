"""Workers that are killed during evaluations: only the interrupted tasks are repeated, and the result is the same."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from tests.support.evaluation_takes import write_walks
from tests.support.patience import PATIENCE_S, wait_until
from tests.support.server_process import QUICK_LEASES, ServerProcess, WorkerProcess
from tests.support.tiers import is_soak

from marey_client import Marey
from marey_client.handles.evaluations import EvaluationHandle
from marey_client.imports import find_files
from marey_client.project import ProjectHandle
from marey_schemas.access import ProjectCreate
from marey_schemas.options.imports import ImportOptions
from marey_schemas.queue.jobs import Job, JobState

pytestmark = pytest.mark.timeout(900)


LONG: dict[str, Any] = {
    "name": "walks-eval",
    "speeds_m_s": (1.0, 1.25, 1.5, 1.75, 2.0),
    "turn_rates_deg_s": (-75.0, -50.0, -25.0, 0.0, 25.0, 50.0, 75.0, 100.0),
    "duration_s": 60.0 if is_soak() else 12.0,
    "baseline": False,
    "replicates": 1,
    "report": False,
}
"""Arguments of an evaluation of 80 trials in 10 tasks. A task takes longer than two polls of `wait_until`."""


@pytest.fixture
def server(tmp_path: Path, database_url: str) -> Iterator[ServerProcess]:
    process = ServerProcess(tmp_path, database_url, **QUICK_LEASES)
    process.start()
    yield process
    process.stop()


@pytest.fixture
def start_worker(tmp_path: Path, server: ServerProcess) -> Iterator[Callable[[str], WorkerProcess]]:
    workers: list[WorkerProcess] = []

    def start(name: str) -> WorkerProcess:
        workers.append(WorkerProcess(tmp_path / f"{name}.log").start(server.url, server.token, tmp_path, name=name))
        return workers[-1]

    yield start
    for worker in workers:
        worker.stop()


@pytest.fixture
def marey(server: ServerProcess) -> Iterator[Marey]:
    with server.client() as client:
        yield client


@pytest.fixture
def lab(marey: Marey, tmp_path: Path) -> ProjectHandle:
    """A project with nine walks."""
    project = marey.create_project(ProjectCreate(name="lab"))
    files = find_files([write_walks(tmp_path / "walks")]).files
    project.imports.upload(files, ImportOptions(collection="walks"))
    return project


def tasks_of(lab: ProjectHandle, job: Job) -> list[Job]:
    return list(lab.jobs(filters={"parent": job.id}))


def warm_up(marey: Marey, lab: ProjectHandle) -> Job:
    """Run a short evaluation of two tasks to its end, so that every worker has started; return the job."""
    options: dict[str, Any] = {
        **LONG,
        "name": "warm-up",
        "speeds_m_s": (1.0,),
        "turn_rates_deg_s": LONG["turn_rates_deg_s"],
    }
    job = lab.evaluate("walks", cache="off", **(options | {"duration_s": 1.0}))
    return marey.jobs.wait(job.id)


def workers_of(marey: Marey, lab: ProjectHandle, job: Job) -> set[str]:
    """Return the names of the workers that worked on the tasks of a job."""
    return {attempt.worker for task in tasks_of(lab, job) for attempt in marey.jobs.attempts(task.id)}


def digests(found: EvaluationHandle) -> dict[str, str]:
    return {name: part.document for name, part in found.item.parts.items()}


def test_a_worker_killed_at_four_fifths_costs_only_the_tasks_it_was_at(
    marey: Marey, lab: ProjectHandle, start_worker: Callable[[str], WorkerProcess]
) -> None:
    first = start_worker("first")
    job = lab.evaluate("walks", **LONG)
    wait_until(lambda: marey.jobs.get(job.id).children.get("succeeded", 0) >= 8, pause_s=0.1)
    first.kill()
    at_death = {task.id for task in tasks_of(lab, job) if task.state is JobState.SUCCEEDED}
    assert len(at_death) < 10, "the worker was killed too late to lose anything"

    start_worker("second")
    made = digests(lab.evaluation(job))
    tries = {task.id: [attempt.outcome for attempt in marey.jobs.attempts(task.id)] for task in tasks_of(lab, job)}
    assert len(tries) == 10
    assert all(tries[task] == ["succeeded"] for task in at_death)
    repeated = [outcomes for outcomes in tries.values() if len(outcomes) > 1]
    assert repeated in ([], [["lost", "succeeded"]])

    undisturbed = lab.evaluation(lab.evaluate("walks", cache="off", **LONG))
    assert digests(undisturbed) == made
    assert undisturbed.item.revision == 1


@pytest.mark.soak
def test_one_worker_and_two_make_the_same_bytes(
    marey: Marey, lab: ProjectHandle, start_worker: Callable[[str], WorkerProcess]
) -> None:
    options: dict[str, Any] = {**LONG, "speeds_m_s": (1.0, 1.5), "duration_s": 5.0, "baseline": True, "replicates": 2}
    start_worker("one")
    alone = digests(lab.evaluation(lab.evaluate("walks", **options)))
    start_worker("two")
    wait_until(lambda: "two" in workers_of(marey, lab, warm_up(marey, lab)), pause_s=0.1)
    job = lab.evaluate("walks", cache="off", **options)
    assert digests(lab.evaluation(job)) == alone
    assert workers_of(marey, lab, job) == {"one", "two"}


@pytest.mark.soak
def test_a_cancelled_evaluation_leaves_nothing_and_is_done_again_from_where_it_was(
    marey: Marey, lab: ProjectHandle, start_worker: Callable[[str], WorkerProcess]
) -> None:
    start_worker("one")
    job = lab.evaluate("walks", **LONG)
    wait_until(lambda: marey.jobs.get(job.id).children.get("succeeded", 0) >= 3, pause_s=0.1)
    marey.jobs.cancel(job.id)
    ended = marey.jobs.wait(job.id, timeout_s=PATIENCE_S, require_success=False)
    assert ended.state is JobState.CANCELLED
    assert list(lab.evaluations.list()) == []
    done = ended.children["succeeded"]

    again = marey.jobs.retry(job.id)
    assert again.children["succeeded"] == done
    assert lab.evaluation(again).name == "walks-eval"
