"""Rules about pods that the server starts, checked with the API of a cluster: of the stub, or of a real one.

The tests need a namespace, a kubeconfig that may create and list Jobs, pods and Secrets there, and the image of the
worker. The pods reach no server. Their workers repeat the first claim until they are stopped, so they run as long as a
test needs them.
"""

from __future__ import annotations

import json
import secrets
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import pytest
from kubernetes import client, config
from tests.support.cluster.dispatching import LARGE, DispatchBench, name_of
from tests.support.cluster.objects import Document
from tests.support.patience import PATIENCE_S
from tests.support.queue_desk import Desk

from marey_server.launchers.kubernetes.worker_jobs import WorkerJobs
from marey_server.launchers.launcher import EngineError

T = TypeVar("T")


@dataclass
class NamedCluster:
    """Cluster that a kubeconfig names, with functions to examine it; names of a test's objects contain `instance`."""

    kubeconfig: Path
    image: str
    namespace: str = "marey"
    instance: str = field(default_factory=lambda: f"test-{secrets.token_hex(4)}")

    def __post_init__(self) -> None:
        self._api = config.new_client_from_config(str(self.kubeconfig))

    @property
    def options(self) -> dict[str, Any]:
        """Options of the launcher for this cluster."""
        return {
            "image": self.image, "kubeconfig": str(self.kubeconfig), "namespace": self.namespace,
            "instance": self.instance, "relist_s": 1, "timeout_s": 30.0, "memory_mb": 512,
        }  # fmt: skip

    def all(self, kind: str) -> list[Document]:
        """Return the Jobs, pods or Secrets of this test."""
        core, batch = client.CoreV1Api(self._api), client.BatchV1Api(self._api)
        lists: dict[str, Callable[..., Any]] = {
            "jobs": batch.list_namespaced_job,
            "pods": core.list_namespaced_pod,
            "secrets": core.list_namespaced_secret,
        }
        selector = f"app.kubernetes.io/instance={self.instance}"
        response = lists[kind](self.namespace, label_selector=selector, _preload_content=False, _request_timeout=30)
        found: list[Document] = json.loads(response.data)["items"]
        return found

    def running_pods(self) -> list[str]:
        """Return the names of the pods that run."""
        return [pod["metadata"]["name"] for pod in self.all("pods") if pod["status"]["phase"] == "Running"]

    def wait_for(self, condition: Callable[[], T]) -> T:
        """Wait until a condition holds, and return its value."""
        deadline = time.monotonic() + PATIENCE_S
        while not (found := condition()):
            assert time.monotonic() < deadline, self.described()
            time.sleep(0.2)
        return found

    def described(self) -> str:
        """Return the states of Jobs and pods, for the message of a failed test."""
        return json.dumps([{one["metadata"]["name"]: one.get("status")} for one in self.all("jobs") + self.all("pods")])

    def close(self) -> None:
        """Delete the objects that a failed test has left, and close the connections."""
        batch = client.BatchV1Api(self._api)
        for job in self.all("jobs"):
            batch.delete_namespaced_job(job["metadata"]["name"], self.namespace, propagation_policy="Background")
        self._api.close()


@pytest.mark.parametrize("database_url", ["sqlite"], indirect=True)
class OwnPodContract:
    """Tests that the stub and every real cluster must pass; each subclass defines the fixture `cluster`."""

    @pytest.fixture
    def bench(self, desk: Desk, cluster: NamedCluster, tmp_path: Path) -> Iterator[DispatchBench]:
        bench = DispatchBench(desk, cluster, tmp_path)
        yield bench
        bench.close()

    def start(self, bench: DispatchBench) -> str:
        """Submit a large job, and let its pod start; return the name of its Job."""
        job = bench.desk.submit("sum", resources=LARGE)
        bench.rounds_until(bench.pods)
        return name_of(job, 1, bench.cluster.instance)

    def test_a_job_is_started_once_by_two_servers(self, bench: DispatchBench, cluster: NamedCluster) -> None:
        first = bench.dispatcher
        name = self.start(bench)
        bench.desk.clock.advance(300)  # the lead of the first server, which is suspended, expires
        bench.open()
        bench.round()
        bench.do(first.adjust())
        assert bench.jobs() == [name]
        (secret,) = cluster.all("secrets")
        (job,) = cluster.all("jobs")
        assert [owner["uid"] for owner in secret["metadata"]["ownerReferences"]] == [job["metadata"]["uid"]]
        assert job["spec"]["podFailurePolicy"]["rules"][1]["action"] == "FailJob"

    def test_a_cancelled_job_leaves_no_objects(self, bench: DispatchBench, cluster: NamedCluster) -> None:
        job = bench.desk.submit("sum", resources=LARGE)
        bench.rounds_until(bench.pods)
        bench.desk.cancel(job)
        bench.rounds_until(lambda: not bench.jobs() and not cluster.all("pods"), step_s=1)
        cluster.wait_for(lambda: not cluster.all("secrets"))

    def test_a_job_without_its_token_gets_it_from_the_next_server(
        self, bench: DispatchBench, cluster: NamedCluster, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        bench.desk.submit("sum", resources=LARGE)

        async def die(*_: Any) -> None:
            raise EngineError("the server has died here")

        with monkeypatch.context() as dying:
            dying.setattr(WorkerJobs, "_supply_token", die)
            with pytest.raises(EngineError, match="has died"):
                bench.round()
        assert (len(bench.jobs()), cluster.all("secrets")) == (1, [])
        bench.do(bench.dispatcher.close())
        bench.open()
        bench.rounds_until(bench.pods)
        assert len(bench.jobs()) == 1

    def test_the_tasks_of_a_job_run_in_the_pods_of_an_indexed_job(self, bench: DispatchBench) -> None:
        given = {"things": [{"item": bench.desk.things(1)[0]}]}
        parent = bench.desk.submit("survey", params={"number": 2}, inputs=given, resources=LARGE)
        bench.rounds_until(lambda: len(bench.pods()) == 2)
        assert bench.jobs() == [name_of(parent, 1, bench.cluster.instance)]
        bench.desk.cancel(parent)
        bench.rounds_until(lambda: not bench.jobs() and not bench.pods(), step_s=1)
