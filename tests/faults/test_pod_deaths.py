"""Pods that die, lie or run twice, and a cluster that does not answer: every job still ends once."""

from __future__ import annotations

import base64
import json
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml
from docs.generate import POOL_MANIFEST
from tests.support.attached_worker import python_path
from tests.support.cluster.admission import admit
from tests.support.cluster.kubelet import MAREY
from tests.support.cluster.objects import Document
from tests.support.cluster.quick_pools import QuickPoolsServer
from tests.support.cluster.stub import IMAGE, StubCluster, running_cluster
from tests.support.patience import PATIENCE_S
from tests.support.server_process import QUICK_LEASES, ServerProcess

from marey_client import Marey
from marey_schemas.access import ProjectCreate
from marey_schemas.queue.jobs import Job, JobCreate

pytestmark = pytest.mark.timeout(900)

LIES = """
import argparse, httpx
parser = argparse.ArgumentParser()
parser.add_argument("--server")
parser.add_argument("--token-file", type=argparse.FileType())
parser.add_argument("--name")
given, _ = parser.parse_known_args()
headers = {"Authorization": f"Bearer {given.token_file.read().strip()}"}
claim = {"worker": given.name, "kinds": ["misbehave"], "wait_s": 20}
leases = httpx.post(f"{given.server}/api/v1/leases", json=claim, headers=headers, timeout=60).json()["leases"]
(lease,) = leases
headers = {"Authorization": f"Bearer {lease['attempt_token']}"}
place = f"{given.server}/api/v1/jobs/{lease['job']}/attempts/{lease['fence']}/heartbeat"
httpx.post(place, json={}, headers=headers, timeout=60).raise_for_status()
"""
"""Program that claims a job, sends one heartbeat, and exits with status 0 as if it had completed the job."""


class FirstLies(dict[str, tuple[str, ...]]):
    """Commands by image; the first look-up returns `LIES` instead."""

    lied = False

    def __getitem__(self, image: str) -> tuple[str, ...]:
        if self.lied:
            return super().__getitem__(image)
        self.lied = True
        return (sys.executable, "-c", LIES)


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[StubCluster]:
    with running_cluster(tmp_path / "cluster") as stub:
        stub.kubelet.environment = {"PYTHONPATH": python_path()}
        yield stub


@pytest.fixture
def server(tmp_path: Path, database_url: str, cluster: StubCluster) -> Iterator[ServerProcess]:
    options = {"image": IMAGE, "kubeconfig": str(cluster.kubeconfig), "relist_s": 2}
    launching = {
        "MAREY_LAUNCHER": "kubernetes",
        "MAREY_LAUNCHER_OPTIONS": json.dumps(options),
        "MAREY_POOLS": json.dumps([{"name": "crew", "most": 1, "idle_s": 1, "kinds": ["misbehave"]}]),
    }
    process = QuickPoolsServer(tmp_path, database_url, PYTHONPATH=python_path(), **launching, **QUICK_LEASES)
    yield process
    process.stop()


def submit(marey: Marey, folder: Path) -> Job:
    """Submit a job that waits until the file `go` exists in `folder`."""
    folder.mkdir()
    marey.create_project(ProjectCreate(name="lab"))
    params = {"how": "wait", "folder": str(folder)}
    return marey.jobs.submit("lab", JobCreate(kind="misbehave", params=params))


def finish(marey: Marey, job: Job, folder: Path) -> list[str | None]:
    """Let a job end, check that it succeeded, and return the outcomes of its attempts."""
    (folder / "go").touch()
    assert marey.jobs.wait(job.id, timeout_s=PATIENCE_S).state == "succeeded"
    return [attempt.outcome for attempt in marey.jobs.attempts(job.id)]


def ended_pods(cluster: StubCluster) -> list[Document]:
    return [pod for pod in cluster.all("pods") if pod["status"]["phase"] in ("Succeeded", "Failed")]


def state_of(pod: Document) -> Document | None:
    """Return the state of the container of a pod, if it has one."""
    return next((one["state"] for one in pod["status"].get("containerStatuses", ())), None)


@pytest.mark.soak
def test_workers_survive_the_server_and_a_silent_cluster(
    cluster: StubCluster, server: ServerProcess, tmp_path: Path
) -> None:
    cluster.faults.status = 503
    cluster.faults.watches = "gone"
    server.start()
    folder = tmp_path / "job"
    with server.client() as marey:
        job = submit(marey, folder)
        cluster.wait_for(lambda: "the cluster answers 503" in server.log.read_text(), PATIENCE_S)
        assert marey.jobs.get(job.id).state == "queued"
        cluster.faults.status = None
        cluster.wait_for((folder / "started").exists, PATIENCE_S)
        server.kill()
        server.start()
        assert finish(marey, job, folder) == ["succeeded"]
        assert len(cluster.kubelet.commands) == 1, "the new server found the worker of the old one"
        cluster.wait_for(lambda: not cluster.all("jobs") and not cluster.all("pods"), PATIENCE_S)
    assert cluster.all("secrets") == []
    server.check_database()


@pytest.mark.soak
def test_two_pods_of_one_job_do_its_work_once(cluster: StubCluster, server: ServerProcess, tmp_path: Path) -> None:
    cluster.controllers.duplicates = True
    server.start()
    folder = tmp_path / "job"
    with server.client() as marey:
        job = submit(marey, folder)
        cluster.wait_for((folder / "started").exists, PATIENCE_S)
        cluster.wait_for(lambda: len(cluster.running_pods()) == 2, PATIENCE_S)
        assert finish(marey, job, folder) == ["succeeded"]
    server.check_database()


@pytest.mark.soak
def test_a_pod_that_exits_with_status_0_has_not_completed_its_job(
    cluster: StubCluster, server: ServerProcess, tmp_path: Path
) -> None:
    cluster.kubelet.images = FirstLies({IMAGE: MAREY})
    server.start()
    folder = tmp_path / "job"
    with server.client() as marey:
        job = submit(marey, folder)
        ended = cluster.wait_for(lambda: ended_pods(cluster), PATIENCE_S)
        assert ended[0]["status"]["phase"] == "Succeeded", cluster.described()
        assert finish(marey, job, folder) == ["lost", "succeeded"]
    server.check_database()


def test_the_shipped_deployment_waits_for_its_token_and_restarts_dead_workers(
    cluster: StubCluster, tmp_path: Path, database_url: str
) -> None:
    server = ServerProcess(tmp_path, database_url, PYTHONPATH=python_path(), **QUICK_LEASES).start()
    try:
        deployment = yaml.safe_load(POOL_MANIFEST.read_text(encoding="utf-8"))
        (container,) = deployment["spec"]["template"]["spec"]["containers"]
        container["image"] = IMAGE
        container["args"] = [server.url if word == "http://marey:8460" else word for word in container["args"]]
        admit(deployment)
        cluster.apply(deployment)
        waiting = {"reason": "ContainerCreating", "message": ""}
        cluster.wait_for(lambda: [state_of(pod) for pod in cluster.all("pods")] == [{"waiting": waiting}] * 2)
        data = {"worker.token": base64.b64encode(server.token.encode()).decode()}
        cluster.apply({"kind": "Secret", "metadata": {"name": "marey-worker-token"}, "data": data})
        folder = tmp_path / "job"
        with server.client() as marey:
            job = submit(marey, folder)
            cluster.wait_for((folder / "started").exists, PATIENCE_S)
            (attempt,) = marey.jobs.attempts(job.id)
            cluster.run(lambda: cluster.kubelet.kill(str(attempt.worker)))
            assert finish(marey, job, folder) == ["lost", "succeeded"]
        cluster.wait_for(lambda: len(cluster.running_pods()) == 2)
        assert len(cluster.kubelet.commands) == 3
    finally:
        cluster.run(lambda: cluster.objects.delete("deployments", "marey-pool"))
        server.stop()
    server.check_database()


def test_the_job_of_a_pod_without_memory_is_done_by_the_next_pod(
    cluster: StubCluster, server: ServerProcess, tmp_path: Path
) -> None:
    server.start()
    folder = tmp_path / "job"
    with server.client() as marey:
        job = submit(marey, folder)
        cluster.wait_for((folder / "started").exists, PATIENCE_S)
        (pod,) = cluster.running_pods()
        cluster.run(lambda: cluster.kubelet.kill(pod, "OOMKilled"))
        assert finish(marey, job, folder) == ["lost", "succeeded"]
    assert "out-of-memory" in server.log.read_text()
    server.check_database()
