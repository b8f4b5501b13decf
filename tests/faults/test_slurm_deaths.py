"""The crash matrix with workers that a real Slurm cluster runs: every job still ends once, with one result."""

from __future__ import annotations

import json
import shlex
import signal
import sys
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest
from tests.faults.test_pod_deaths import LIES
from tests.support.attached_worker import python_path
from tests.support.cluster.quick_pools import QuickPoolsServer
from tests.support.launcher_contract import processes_of
from tests.support.patience import PATIENCE_S, wait_until
from tests.support.server_process import QUICK_LEASES, ServerProcess
from tests.support.slurm_cluster import SlurmCluster, running_cluster

from marey_client import Marey
from marey_schemas.access import ProjectCreate
from marey_schemas.queue.jobs import Job, JobCreate
from marey_server.process.data_folder import WORKER_LOGS

pytestmark = [pytest.mark.slurm, pytest.mark.timeout(900), pytest.mark.xdist_group("workers that Slurm runs")]

FIRST_DIFFERS = """#!/bin/sh
if mkdir {mark} 2> /dev/null; then
    {difference}
fi
exec {python} "$@"
"""
"""Python interpreter of the workers, of which the first that starts differs from the others."""


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[SlurmCluster]:
    with running_cluster(tmp_path_factory.mktemp("slurm")) as one:
        yield one


@pytest.fixture
def server(tmp_path: Path, database_url: str, cluster: SlurmCluster) -> Iterator[QuickPoolsServer]:
    process = QuickPoolsServer(tmp_path, database_url, **settings_of(tmp_path, cluster))
    yield process
    close(process, cluster)


def settings_of(folder: Path, cluster: SlurmCluster) -> dict[str, str]:
    """Return the settings of a server with one pool, whose workers run a program that a test may write."""
    pool = {"name": "crew", "least": 1, "most": 1, "kinds": ["draw", "misbehave"], "memory_mb": 512}
    first_differs(folder, ":")
    return {
        "MAREY_LAUNCHER": "slurm",
        "MAREY_LAUNCHER_OPTIONS": json.dumps({"python": str(folder / "python")}),
        "MAREY_POOLS": json.dumps([pool]),
        "SLURM_CONF": str(cluster.configuration),
        "PYTHONPATH": python_path(),
        **QUICK_LEASES,
    }


def first_differs(folder: Path, difference: str) -> None:
    """Let the first worker run these shell commands before it starts."""
    program = folder / "python"
    mark = shlex.quote(str(folder / "first"))
    program.write_text(FIRST_DIFFERS.format(mark=mark, difference=difference, python=shlex.quote(sys.executable)))
    program.chmod(0o700)


def close(server: ServerProcess, cluster: SlurmCluster) -> None:
    """Stop a server and then its workers, which would otherwise outlive it."""
    server.stop()
    cluster.ask("scancel", "--me")
    wait_until(lambda: not cluster.ask("squeue", "--noheader").strip(), pause_s=0.2)


def started(server: ServerProcess, *, fault: str | None = None) -> Marey:
    """Start a server with the project `lab`; return a client."""
    marey = server.start(fault=fault).client()
    marey.create_project(ProjectCreate(name="lab"))
    return marey


def submit(marey: Marey, *, name: str = "drawn", seconds: float = 0.0) -> Job:
    """Submit a job that waits and then creates a skeleton."""
    params = {"name": name, "seed": 1, "seconds": seconds}
    return marey.jobs.submit("lab", JobCreate(kind="draw", params=params))


def outcomes(marey: Marey, job: Job) -> list[str | None]:
    return [attempt.outcome for attempt in marey.jobs.attempts(job.id)]


def check_published_once(server: ServerProcess, marey: Marey) -> None:
    """Fail unless there is one skeleton, with one revision, and the store is consistent."""
    assert [(one.path, one.item.revision) for one in marey.project("lab").skeletons.list()] == [("drawn", 1)]
    server.check_database()


def running_worker(marey: Marey, job: Job) -> psutil.Process:
    """Return the worker that runs a job, as soon as there is one."""
    wait_until(lambda: marey.jobs.get(job.id).state == "running", pause_s=0.1)
    *_, attempt = marey.jobs.attempts(job.id)
    (worker,) = processes_of(attempt.worker)
    return worker


@pytest.mark.soak
@pytest.mark.parametrize("place", ["after_claim", "after_blob", "before_complete", "after_complete"])
def test_the_job_of_a_killed_worker_is_done_by_the_next_task(
    server: QuickPoolsServer, tmp_path: Path, place: str
) -> None:
    first_differs(tmp_path, f"export MAREY_FAULT=worker.{place}:kill")
    with started(server) as marey:
        job = submit(marey)
        assert marey.jobs.wait(job.id, timeout_s=PATIENCE_S).state == "succeeded"
        assert outcomes(marey, job) == (["succeeded"] if place == "after_complete" else ["lost", "succeeded"])
        check_published_once(server, marey)
    wait_until(lambda: "ended: killed, status -9" in server.log.read_text())


@pytest.mark.soak
@pytest.mark.parametrize("place", ["claim.after_commit", "complete.before_commit", "complete.after_commit"])
def test_workers_complete_their_jobs_at_the_server_that_replaces_a_killed_one(
    server: QuickPoolsServer, place: str
) -> None:
    with started(server, fault=f"{place}:kill") as marey:
        job = submit(marey)
        assert server.wait_until_dead() == -signal.SIGKILL
        server.start()
        assert marey.jobs.wait(job.id, timeout_s=PATIENCE_S).state == "succeeded"
        assert outcomes(marey, job)[-1] == "succeeded"
        assert len({attempt.worker for attempt in marey.jobs.attempts(job.id)}) == 1, "the worker outlived its server"
        check_published_once(server, marey)


def sleeper_among(marey: Marey, jobs: list[Job]) -> list[tuple[Job, psutil.Process]]:
    """Return the job whose first worker is suspended, and this worker, or an empty list."""
    running = [
        (job, worker) for job in jobs for one in marey.jobs.attempts(job.id) for worker in processes_of(one.worker)
    ]
    return [(job, worker) for job, worker in running if worker.status() == psutil.STATUS_STOPPED]


@pytest.mark.soak
def test_a_worker_that_slept_through_its_lease_is_refused(
    cluster: SlurmCluster, tmp_path: Path, database_url: str
) -> None:
    settings = settings_of(tmp_path, cluster)
    (pool,) = json.loads(settings["MAREY_POOLS"])
    settings["MAREY_POOLS"] = json.dumps([pool | {"least": 2, "most": 2}])
    first_differs(tmp_path, "export MAREY_FAULT=worker.before_complete:stop")
    server = QuickPoolsServer(tmp_path, database_url, **settings)
    logs = server.data / WORKER_LOGS
    try:
        with started(server) as marey:
            wait_until(lambda: sum("works for" in file.read_text() for file in logs.glob("*.log")) == 2, pause_s=0.1)
            jobs = [submit(marey, name=name, seconds=8) for name in ("one", "two")]
            wait_until(lambda: sleeper_among(marey, jobs), pause_s=0.2)
            [(job, sleeper)] = sleeper_among(marey, jobs)
            wait_until(lambda: len(outcomes(marey, job)) == 2, pause_s=0.1)
            sleeper.resume()
            assert {marey.jobs.wait(one.id, timeout_s=PATIENCE_S).state for one in jobs} == {"succeeded"}
            first, *_, last = outcomes(marey, job)
            assert (first, last) == ("lost", "succeeded")
            assert [one.item.revision for one in marey.project("lab").skeletons.list()] == [1, 1]
            server.check_database()
    finally:
        close(server, cluster)


@pytest.mark.soak
def test_a_worker_that_exits_with_status_0_has_not_completed_its_job(server: QuickPoolsServer, tmp_path: Path) -> None:
    (tmp_path / "lies.py").write_text(LIES)
    first_differs(tmp_path, f'exec {sys.executable} {tmp_path / "lies.py"} "$@"')
    (folder := tmp_path / "job").mkdir()
    (folder / "go").touch()
    with started(server) as marey:
        params = {"how": "wait", "folder": str(folder)}
        job = marey.jobs.submit("lab", JobCreate(kind="misbehave", params=params))
        assert marey.jobs.wait(job.id, timeout_s=PATIENCE_S).state == "succeeded"
        assert outcomes(marey, job) == ["lost", "succeeded"]
    server.check_database()


@pytest.mark.soak
def test_a_job_goes_on_while_the_node_daemon_is_dead(cluster: SlurmCluster, server: QuickPoolsServer) -> None:
    with started(server) as marey:
        job = submit(marey, seconds=3)
        worker = running_worker(marey, job)
        cluster.node.kill()
        cluster.node.wait()
        assert marey.jobs.wait(job.id, timeout_s=PATIENCE_S).state == "succeeded"
        assert outcomes(marey, job) == ["succeeded"]
        assert worker.is_running()
        cluster.start_node()
        check_published_once(server, marey)


@pytest.mark.soak
def test_a_worker_that_dies_without_a_controller_is_replaced_when_there_is_one_again(
    cluster: SlurmCluster, server: QuickPoolsServer
) -> None:
    with started(server) as marey:
        job = submit(marey, seconds=20)
        worker = running_worker(marey, job)
        cluster.kill_controller()
        worker.kill()
        wait_until(lambda: outcomes(marey, job)[:1] == ["lost"], pause_s=0.1)
        cluster.start_controller()
        assert marey.jobs.wait(job.id, timeout_s=PATIENCE_S).state == "succeeded"
        assert outcomes(marey, job) == ["lost", "succeeded"]
        check_published_once(server, marey)


@pytest.mark.soak
def test_the_job_of_a_suspended_worker_whose_task_slurm_runs_again_is_published_once(
    cluster: SlurmCluster, server: QuickPoolsServer
) -> None:
    """Slurm wakes the worker to end it, so the worker returns its job unless its lease has ended before."""
    with started(server) as marey:
        job = submit(marey, seconds=4)
        worker = running_worker(marey, job)
        worker.suspend()
        [task] = cluster.ask("squeue", "--noheader", "--states=RUNNING", "--array", "--format=%i").split()
        cluster.ask("scontrol", "requeue", task)
        assert marey.jobs.wait(job.id, timeout_s=PATIENCE_S).state == "succeeded"
        first, *_, last = outcomes(marey, job)
        assert first in ("interrupted", "lost")
        assert last == "succeeded"
        check_published_once(server, marey)
