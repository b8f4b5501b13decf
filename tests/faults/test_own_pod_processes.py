"""Pods that run one job each, as real workers of a real server: kills, duplicates, restarts, tasks and images."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from tests.support.attached_worker import python_path
from tests.support.cluster.dispatching import LARGE, OWN_IMAGE
from tests.support.cluster.kubelet import MAREY
from tests.support.cluster.stub import IMAGE, StubCluster, running_cluster
from tests.support.git_repositories import committed
from tests.support.patience import PATIENCE_S
from tests.support.present import present
from tests.support.server_process import QUICK_LEASES, ServerProcess

from marey_client import Marey
from marey_client.explanations import explain_job
from marey_schemas.access import ProjectCreate
from marey_schemas.queue.jobs import Job, JobCreate
from marey_schemas.queue.scripts import ScriptCreate

pytestmark = pytest.mark.timeout(900)


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[StubCluster]:
    with running_cluster(tmp_path / "cluster") as stub:
        stub.kubelet.environment = {"PYTHONPATH": python_path()}
        stub.kubelet.images[OWN_IMAGE] = MAREY
        yield stub


@pytest.fixture
def server(tmp_path: Path, database_url: str, cluster: StubCluster) -> Iterator[ServerProcess]:
    options = {"image": IMAGE, "kubeconfig": str(cluster.kubeconfig), "relist_s": 2}
    launching = {
        "MAREY_LAUNCHER": "kubernetes",
        "MAREY_LAUNCHER_OPTIONS": json.dumps(options),
        "MAREY_OWN_PODS": json.dumps({"most": 4, "memory_mb": 4096, "images": ["registry.example.org/motion/torch"]}),
    }
    process = ServerProcess(tmp_path, database_url, PYTHONPATH=python_path(), **launching, **QUICK_LEASES)
    yield process
    process.stop()


def submit(marey: Marey, folder: Path) -> Job:
    """Submit a large job that waits until the file `go` exists in `folder`."""
    folder.mkdir()
    marey.create_project(ProjectCreate(name="lab"))
    params = {"how": "wait", "folder": str(folder)}
    return marey.jobs.submit("lab", JobCreate(kind="misbehave", params=params, resources=LARGE))


def finish(marey: Marey, job: Job, folder: Path) -> list[str | None]:
    """Let a job end, check that it succeeded, and return the outcomes of its attempts."""
    (folder / "go").touch()
    assert marey.jobs.wait(job.id, timeout_s=PATIENCE_S).state == "succeeded"
    return [attempt.outcome for attempt in marey.jobs.attempts(job.id)]


def run_out_of_memory(cluster: StubCluster, marey: Marey, job_id: str) -> bool:
    """Let the container of a pod have no memory left some heartbeats after its claim; return False if the job ended."""

    def state() -> str:
        return marey.jobs.get(job_id).state.value

    cluster.wait_for(lambda: state() == "failed" or (state() == "running" and running(cluster)), PATIENCE_S)
    if state() == "failed":
        return False
    time.sleep(1.5)
    (pod,) = cluster.running_pods()
    cluster.run(lambda: cluster.kubelet.kill(pod, "OOMKilled"))
    cluster.wait_for(lambda: not running(cluster), PATIENCE_S)
    return True


def running(cluster: StubCluster) -> bool:
    return bool(cluster.running_pods())


def exit_codes(cluster: StubCluster) -> list[int]:
    """Return the exit statuses of the pods that have ended."""
    states = [one["state"] for pod in cluster.all("pods") for one in pod["status"].get("containerStatuses", ())]
    return [state["terminated"]["exitCode"] for state in states if "terminated" in state]


def test_a_waiting_pod_takes_over_after_a_kill_and_the_others_end_with_status_0(
    cluster: StubCluster, server: ServerProcess, tmp_path: Path
) -> None:
    cluster.controllers.duplicates = True
    server.start()
    folder = tmp_path / "job"
    with server.client() as marey:
        job = submit(marey, folder)
        cluster.wait_for(lambda: (folder / "started").exists() and len(cluster.running_pods()) == 2, PATIENCE_S)
        (holder,) = [pod for pod in cluster.running_pods() if "attempt 1" in cluster.kubelet.log_of(pod)]
        cluster.run(lambda: cluster.kubelet.kill(holder))
        assert finish(marey, job, folder) == ["lost", "succeeded"]
        cluster.wait_for(lambda: not running(cluster), PATIENCE_S)
    server.check_database()


@pytest.mark.soak
def test_the_server_dies_between_a_job_and_its_token(
    cluster: StubCluster, server: ServerProcess, tmp_path: Path
) -> None:
    server.start(fault="dispatch.before_token:kill")
    folder = tmp_path / "job"
    with server.client() as marey:
        job = submit(marey, folder)
        server.wait_until_dead()
        assert (len(cluster.all("jobs")), cluster.all("secrets")) == (1, [])
        server.start()
        cluster.wait_for((folder / "started").exists, PATIENCE_S)
        assert finish(marey, job, folder) == ["succeeded"]
    assert len(cluster.kubelet.commands) == 1
    server.check_database()


@pytest.mark.soak
def test_a_stopped_pod_returns_its_job_and_counts_as_a_failure_of_the_pod(
    cluster: StubCluster, server: ServerProcess, tmp_path: Path
) -> None:
    server.start()
    folder = tmp_path / "job"
    with server.client() as marey:
        job = submit(marey, folder)
        cluster.wait_for((folder / "started").exists, PATIENCE_S)
        (pod,) = cluster.running_pods()
        cluster.run(lambda: cluster.kubelet.evict(pod))
        cluster.wait_for(lambda: exit_codes(cluster) == [143], PATIENCE_S)
        assert finish(marey, job, folder) == ["interrupted", "succeeded"]
        assert len(cluster.all("jobs")) == 1, "the cluster has replaced the evicted pod"
        params = {"how": "sleep", "seconds": 600.0}
        again = marey.jobs.submit("lab", JobCreate(kind="misbehave", params=params, resources=LARGE))
        cluster.wait_for(lambda: marey.jobs.get(again.id).state == "running", PATIENCE_S)
        marey.jobs.cancel(again.id)
        assert marey.jobs.wait(again.id, timeout_s=PATIENCE_S, require_success=False).state == "cancelled"
        cluster.wait_for(lambda: not running(cluster), PATIENCE_S)
    server.check_database()


@pytest.mark.soak
def test_a_script_with_an_image_runs_in_a_pod_with_this_image(
    cluster: StubCluster, server: ServerProcess, tmp_path: Path
) -> None:
    code = "import json, sys; json.dump({'ran': 1}, open(sys.argv[1], 'w'))"
    repository, commit = committed(tmp_path / "scripts", {"run.py": code})
    server.environment["MAREY_SCRIPT_REPOSITORIES"] = json.dumps([repository])
    cluster.kubelet.paused = True
    server.start()
    declared = {
        "name": "train", "repository": repository, "commit": commit, "argv": ["python", "run.py", "{output:fields}"],
        "outputs": {"fields": {"kind": "fields"}}, "limits": {"seconds": 60, "memory_mb": 512}, "image": OWN_IMAGE,
    }  # fmt: skip
    with server.client() as marey:
        project = marey.create_project(ProjectCreate(name="lab"))
        project.scripts.register(ScriptCreate.model_validate(declared))
        job = project.scripts.at("train").run({}, into="trained")
        cluster.wait_for(lambda: "its script names the image" in explain_job(marey, job.id)[0])
        cluster.kubelet.paused = False
        assert present(marey.jobs.wait(job.id, timeout_s=PATIENCE_S).result)["fields"] == {"ran": 1}
    (pod,) = cluster.all("pods")
    assert pod["spec"]["containers"][0]["image"] == OWN_IMAGE
    server.check_database()


@pytest.mark.soak
def test_tasks_share_an_indexed_job_of_which_one_pod_is_killed(cluster: StubCluster, server: ServerProcess) -> None:
    server.start()
    with server.client() as marey:
        marey.create_project(ProjectCreate(name="lab"))
        job = marey.jobs.submit("lab", JobCreate(kind="tally", params={"tasks": 3}, resources=LARGE))
        pod = cluster.wait_for(cluster.running_pods, PATIENCE_S)[0]
        cluster.run(lambda: cluster.kubelet.kill(pod))
        assert present(marey.jobs.wait(job.id, timeout_s=PATIENCE_S).result)["seen"] == [[0, 3], [1, 3], [2, 3]]
        indexed = [one for one in cluster.all("jobs") if one["spec"].get("completionMode") == "Indexed"]
        assert len(indexed) == 1
    server.check_database()


@pytest.mark.soak
def test_a_job_that_exhausts_the_memory_of_every_pod_fails(
    cluster: StubCluster, server: ServerProcess, tmp_path: Path
) -> None:
    server.start()
    folder = tmp_path / "job"
    with server.client() as marey:
        job = submit(marey, folder)
        while run_out_of_memory(cluster, marey, job.id):
            assert len(cluster.kubelet.commands) < 10, "an attempt that sent no heartbeat does not count"
        failed = marey.jobs.wait(job.id, timeout_s=PATIENCE_S, require_success=False)
        assert (failed.state, failed.attempt) == ("failed", 3)
        other = marey.jobs.submit("lab", JobCreate(kind="add", params={"a": 1, "b": 2}, resources=LARGE))
        assert present(marey.jobs.wait(other.id, timeout_s=PATIENCE_S).result)["sum"] == 3
    assert "out-of-memory" in server.log.read_text()
    server.check_database()
