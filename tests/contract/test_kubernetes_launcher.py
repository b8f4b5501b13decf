"""The launcher `kubernetes` against the stub cluster, whose pods run small programs here."""

from __future__ import annotations

import asyncio
import base64
import datetime
import logging
from collections.abc import Coroutine, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any, TypeVar

import pytest
from kubernetes.aio.config import incluster_config
from tests.support.cluster.kubelet import SCRIPT
from tests.support.cluster.stub import IMAGE, StubCluster, running_cluster
from tests.support.patience import PATIENCE_S
from tests.support.present import present
from tests.support.webhook_receiver import SELF_SIGNED

from marey_schemas.backoff import Backoff
from marey_server.launchers.kubernetes import view
from marey_server.launchers.kubernetes.launcher import KubernetesLauncher, make_kubernetes_launcher
from marey_server.launchers.kubernetes.manifests import Pool, worker_job
from marey_server.launchers.kubernetes.options import ClusterOptions
from marey_server.launchers.launcher import EngineError, LaunchContext, LauncherUnusable, WorkerEnd, WorkerRequest

T = TypeVar("T")

SECRET = "marey_secret_of_workers"
WAITS = (*SCRIPT, "import signal, sys, time; signal.signal(15, lambda *_: sys.exit(0)); time.sleep(600)")
FAILS = (*SCRIPT, "import sys; print('first line', flush=True); sys.exit('no such device')")
ENDS = (*SCRIPT, "pass")


class Bench:
    """A launcher with a short pause between lists, and the loop on which it runs."""

    def __init__(self, cluster: StubCluster, folder: Path) -> None:
        self.cluster = cluster
        self._folder = folder
        self._runner = asyncio.Runner()
        self._launchers: list[KubernetesLauncher] = []
        self.launcher = self.make()

    def make(self, pool: str = "crew", **options: Any) -> KubernetesLauncher:
        usual = {"image": IMAGE, "kubeconfig": self.cluster.kubeconfig, "relist_s": 2, "timeout_s": 60.0}
        context = LaunchContext(
            pool, "http://marey:8460", SECRET, self._folder, "text", "info", options={**usual, **options}
        )
        self._launchers.append(make_kubernetes_launcher(context))
        return self._launchers[-1]

    def do(self, call: Coroutine[Any, Any, T]) -> T:
        return self._runner.run(call)

    def start(self, count: int = 1, key: str = "k1", **request: Any) -> tuple[str, ...]:
        return self.do(self.launcher.start(WorkerRequest(**request), count, key=key))

    def states(self) -> dict[str, str]:
        return {worker.name: worker.state for worker in self.do(self.launcher.list())}

    def until(self, states: dict[str, str]) -> None:
        """Wait until the launcher lists these workers in these states."""

        async def wait() -> None:
            deadline = asyncio.get_running_loop().time() + PATIENCE_S
            while (found := {one.name: one.state for one in await self.launcher.list()}) != states:
                assert asyncio.get_running_loop().time() < deadline, f"{found}\n{self.cluster.described()}"
                await asyncio.sleep(0.05)

        self.do(wait())

    def end(self, name: str) -> WorkerEnd | None:
        return self.do(self.launcher.why_ended(name))

    def close(self) -> None:
        for launcher in self._launchers:
            self.do(launcher.close())
        self._runner.close()


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[StubCluster]:
    with running_cluster(tmp_path / "cluster") as stub:
        stub.kubelet.images[IMAGE] = WAITS
        yield stub


@pytest.fixture
def bench(cluster: StubCluster, tmp_path: Path) -> Iterator[Bench]:
    bench = Bench(cluster, tmp_path)
    yield bench
    bench.close()


def test_each_worker_is_a_job_with_a_secret_that_ends_with_it(bench: Bench, cluster: StubCluster) -> None:
    names = bench.start(2)
    assert names == ("marey-crew-k1-0", "marey-crew-k1-1")
    jobs = {job["metadata"]["name"]: job for job in cluster.all("jobs")}
    assert jobs.keys() == set(names)
    pool = Pool("crew", "http://marey:8460", ClusterOptions(image=IMAGE), log_form="text")
    for name in names:
        assert jobs[name]["spec"] == worker_job(pool, name)["spec"]
    bench.until(dict.fromkeys(names, "running"))
    secrets = {one["metadata"]["name"]: one["data"]["worker.token"] for one in cluster.all("secrets")}
    assert secrets == dict.fromkeys(names, base64.b64encode(SECRET.encode()).decode())
    for command, variables in cluster.kubelet.commands:
        assert SECRET not in f"{command} {variables}"
    bench.do(bench.launcher.stop(names))
    bench.until({})
    cluster.wait_for(lambda: not cluster.all("pods"))
    assert cluster.all("secrets") == []
    assert bench.end(names[0]) == WorkerEnd("stopped")


def test_a_start_whose_answers_are_lost_can_be_repeated(bench: Bench, cluster: StubCluster) -> None:
    cluster.faults.lose = {"POST"}
    with pytest.raises(EngineError, match="no valid answer"):
        bench.start(2)
    cluster.faults.lose = set()
    names = bench.start(2)
    bench.until(dict.fromkeys(names, "running"))
    assert len(cluster.all("pods")) == len(cluster.all("secrets")) == 2
    assert bench.start(2) == names
    assert len(cluster.all("jobs")) == 2


def test_the_secret_of_a_job_is_created_if_the_server_died_before(bench: Bench, cluster: StubCluster) -> None:
    names = bench.start()
    (job,) = cluster.all("jobs")
    cluster.run(lambda: cluster.objects.delete("jobs", names[0]))
    cluster.wait_for(lambda: not cluster.all("pods"))
    cluster.apply(job)
    cluster.wait_for(lambda: cluster.all("pods") and "containerStatuses" in cluster.all("pods")[0]["status"])
    bench.launcher = bench.make()  # the next server, or the next leader
    bench.until({names[0]: "running"})


def test_a_job_of_another_program_is_not_taken_for_a_worker(bench: Bench, cluster: StubCluster) -> None:
    bench.start()
    (job,) = cluster.all("jobs")
    bench.do(bench.launcher.stop(("marey-crew-k1-0",)))
    job["metadata"]["labels"] = {"app": "other"}
    cluster.apply(job)
    with pytest.raises(EngineError, match="another Job with the name marey-crew-k1-0"):
        bench.start()
    assert bench.states() == {}


def test_launchers_see_only_the_workers_of_their_pool(bench: Bench) -> None:
    bench.start()
    other = bench.make("other")
    bench.do(other.start(WorkerRequest(), 1, key="k1"))
    assert {worker.name for worker in bench.do(other.list())} == {"marey-other-k1-0"}
    assert list(bench.states()) == ["marey-crew-k1-0"]


def test_the_workers_of_an_indexed_job_are_stopped_one_by_one(bench: Bench, cluster: StubCluster) -> None:
    bench.launcher = bench.make(indexed=True)
    names = bench.start(3)
    assert names == ("marey-crew-k1-0", "marey-crew-k1-1", "marey-crew-k1-2")
    bench.until(dict.fromkeys(names, "running"))
    assert [job["metadata"]["name"] for job in cluster.all("jobs")] == ["marey-crew-k1"]
    assert bench.start(3) == names
    bench.do(bench.launcher.stop(names[:1]))
    bench.until({names[0]: "ended", names[1]: "running", names[2]: "running"})
    assert bench.end(names[0]) == WorkerEnd("stopped")
    bench.do(bench.launcher.stop(names[1:]))
    bench.until({})
    assert [word for command, _ in cluster.kubelet.commands for word in command if word in names] == [*names]


def test_one_death_in_an_indexed_job_ends_no_other_worker(bench: Bench, cluster: StubCluster) -> None:
    bench.launcher = bench.make(indexed=True)
    names = bench.start(2)
    bench.until(dict.fromkeys(names, "running"))
    (pod,) = [name for name in cluster.running_pods() if name.startswith(names[0])]
    cluster.run(lambda: cluster.kubelet.kill(pod))
    bench.until({names[0]: "ended", names[1]: "running"})
    assert bench.end(names[0]) == WorkerEnd("killed", -9, "signal 9")


def test_workers_of_an_indexed_job_that_has_not_started_are_not_stopped_alone(bench: Bench) -> None:
    bench.launcher = bench.make(indexed=True, queue="motion")
    names = bench.start(2)
    with pytest.raises(EngineError, match="cannot be stopped yet, because they have no pods: marey-crew-k1-0"):
        bench.do(bench.launcher.stop(names[:1]))
    bench.do(bench.launcher.stop(names))
    assert bench.states() == {}


def test_kueue_admits_and_preempts_workers(bench: Bench, cluster: StubCluster) -> None:
    bench.launcher = bench.make(queue="motion")
    first, second = bench.start()[0], bench.start(key="k2")[0]
    bench.until({first: "starting", second: "starting"})
    assert cluster.all("pods") == []
    cluster.controllers.quota = 1
    bench.until({first: "running", second: "starting"})
    cluster.run(lambda: cluster.controllers.preempt(first))
    bench.until({first: "starting", second: "starting"})
    cluster.controllers.quota = 2
    bench.until({first: "running", second: "running"})


def test_deaths_are_explained(bench: Bench, cluster: StubCluster) -> None:
    (name,) = bench.start(key="k1")
    bench.until({name: "running"})
    assert bench.end(name) is None
    (pod,) = cluster.running_pods()
    cluster.run(lambda: cluster.kubelet.kill(pod, "OOMKilled"))
    bench.until({name: "ended"})
    end = bench.end(name)
    assert (present(end).reason, present(end).status) == ("out-of-memory", -9)
    assert present(bench.end("marey-crew-k0-0")).reason == "unknown"


def test_the_log_explains_a_failure(bench: Bench, cluster: StubCluster) -> None:
    cluster.kubelet.images[IMAGE] = FAILS
    (name,) = bench.start()
    bench.until({name: "ended"})
    assert bench.end(name) == WorkerEnd("failed", 1, "exit status 1\nfirst line\nno such device")


def test_a_worker_whose_deadline_passes_is_ended(bench: Bench) -> None:
    (name,) = bench.start(deadline_s=2)
    bench.until({name: "running"})
    bench.until({name: "ended"})
    assert present(bench.end(name)).reason == "deadline"


def test_an_evicted_worker_is_replaced_once_it_has_ended(bench: Bench, cluster: StubCluster) -> None:
    cluster.kubelet.images[IMAGE] = (*SCRIPT, "import time; time.sleep(600)")
    (name,) = bench.start()
    bench.until({name: "running"})
    (pod,) = cluster.running_pods()
    cluster.run(lambda: cluster.kubelet.evict(pod))
    cluster.wait_for(lambda: any(other != pod for other in cluster.running_pods()))
    assert cluster.running_pods() != [pod]
    assert bench.end(name) == WorkerEnd("preempted", -15, "EvictionByEvictionAPI")
    assert bench.states() == {name: "running"}


def test_ended_workers_disappear_with_their_logs_and_secrets(bench: Bench, cluster: StubCluster) -> None:
    cluster.kubelet.images[IMAGE] = ENDS
    bench.launcher = bench.make(ended_s=1)
    (name,) = bench.start()
    bench.until({})
    assert (cluster.all("pods"), cluster.all("secrets")) == ([], [])
    assert present(bench.end(name)).reason == "unknown"


def test_an_image_that_does_not_exist_is_logged_once(
    bench: Bench, cluster: StubCluster, caplog: pytest.LogCaptureFixture
) -> None:
    del cluster.kubelet.images[IMAGE]
    (name,) = bench.start()
    cluster.wait_for(lambda: any("containerStatuses" in pod["status"] for pod in cluster.all("pods")))
    with caplog.at_level(logging.WARNING):
        for _ in range(10):
            bench.do(asyncio.sleep(0.1))
            bench.do(bench.launcher.list())
    assert [record.getMessage() for record in caplog.records] == [
        f"worker {name} cannot start: ErrImagePull: {IMAGE}: not found"
    ]


def test_a_long_list_is_read_in_pages(bench: Bench, cluster: StubCluster, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("marey_server.launchers.kubernetes.cluster.PAGE", 2)
    cluster.kubelet.paused = True
    names = bench.start(5)
    bench.launcher = bench.make()
    assert bench.states() == dict.fromkeys(names, "starting")
    bench.do(bench.launcher.stop(names))


# -- faults of the API --


@pytest.mark.parametrize("watches", ["drop", "gone", "silent"])
def test_without_watches_lists_show_changes(bench: Bench, cluster: StubCluster, watches: Any) -> None:
    cluster.faults.watches = watches
    (name,) = bench.start()
    bench.until({name: "running"})
    (pod,) = cluster.running_pods()
    cluster.run(lambda: cluster.kubelet.kill(pod))
    bench.until({name: "ended"})
    assert present(bench.end(name)).reason == "killed"


def test_watches_that_fail_at_once_do_not_flood_the_cluster(bench: Bench, cluster: StubCluster) -> None:
    cluster.faults.watches = "gone"
    bench.do(bench.launcher.list())
    bench.do(asyncio.sleep(3))
    watches = [path for method, path in cluster.api.requests if method == "WATCH" and path.endswith("/jobs")]
    assert 2 <= len(watches) <= 6


def test_a_watch_shows_changes_before_the_next_list(bench: Bench, cluster: StubCluster) -> None:
    bench.launcher = bench.make(relist_s=600)
    (name,) = bench.start()
    bench.until({name: "running"})
    (pod,) = cluster.running_pods()
    cluster.run(lambda: cluster.kubelet.kill(pod))
    bench.until({name: "ended"})
    lists = [path for method, path in cluster.api.requests if method == "GET" and path.endswith("/jobs")]
    assert len(lists) <= 2


def test_a_version_that_the_cluster_has_forgotten_is_listed_again(bench: Bench, cluster: StubCluster) -> None:
    bench.launcher = bench.make(relist_s=600)
    (name,) = bench.start()
    bench.until({name: "running"})
    cluster.faults.watches = "drop"  # ends the watches that run now
    (pod,) = cluster.running_pods()
    cluster.run(lambda: cluster.kubelet.kill(pod))
    cluster.wait_for(lambda: not cluster.running_pods())
    cluster.run(cluster.objects.forget_events)
    cluster.faults.watches = "work"
    bench.until({name: "ended"})


def test_a_cluster_that_fails_is_reported_and_followed_again(
    bench: Bench, cluster: StubCluster, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(view, "PAUSES", Backoff(first_s=0.05, longest_s=0.2))
    cluster.faults.status = 503
    for call in (lambda: bench.states(), lambda: bench.start(), lambda: bench.end("marey-crew-k1-0")):
        with pytest.raises(EngineError, match="the cluster answers 503: a fault of the stub"):
            call()
    cluster.faults.status = None
    (name,) = bench.start()
    bench.until({name: "running"})
    cluster.faults.status = 500
    bench.do(asyncio.sleep(1))
    assert bench.states() == {name: "running"}  # what was known
    cluster.faults.status = None
    (pod,) = cluster.running_pods()
    cluster.run(lambda: cluster.kubelet.kill(pod))
    bench.until({name: "ended"})


def test_a_cluster_that_does_not_answer_is_reported_in_time(bench: Bench, cluster: StubCluster) -> None:
    cluster.faults.delay_s = 30.0
    slow = bench.make(timeout_s=0.3)
    with pytest.raises(EngineError, match="does not answer in time"):
        bench.do(slow.list())
    with pytest.raises(EngineError, match="does not answer in time"):
        bench.do(slow.start(WorkerRequest(), 1, key="k1"))
    cluster.faults.delay_s = 0.0


def test_the_shipped_role_is_enough_and_gives_no_more(bench: Bench, cluster: StubCluster) -> None:
    bench.launcher = bench.make(namespace="kube-system")
    with pytest.raises(EngineError, match="403: cannot list resource 'jobs' in the namespace 'kube-system'"):
        bench.do(bench.launcher.list())
    rights = cluster.api.callers["server-token"]
    assert not rights.allows("get", "", "secrets")
    assert not rights.allows("list", "", "secrets")
    assert not rights.allows("create", "apps", "deployments")


def test_a_server_in_a_pod_uses_the_newest_token_of_its_service_account(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    certificate, token = tmp_path / "ca.crt", tmp_path / "token"
    certificate.write_text(SELF_SIGNED)
    token.write_text("old-token")
    monkeypatch.setattr(incluster_config, "SERVICE_CERT_FILENAME", str(certificate))
    monkeypatch.setattr(incluster_config, "SERVICE_TOKEN_FILENAME", str(token))
    with running_cluster(tmp_path / "cluster", certificate) as cluster:
        cluster.kubelet.images[IMAGE] = WAITS
        cluster.api.callers["old-token"] = cluster.api.callers["server-token"]
        monkeypatch.setenv("KUBERNETES_SERVICE_HOST", "127.0.0.1")
        monkeypatch.setenv("KUBERNETES_SERVICE_PORT", cluster.url.rpartition(":")[2])
        bench = Bench(cluster, tmp_path)
        bench.launcher = bench.make(kubeconfig=None)
        names = bench.start()
        bench.until({names[0]: "running"})
        token.write_text("server-token")
        del cluster.api.callers["old-token"]
        tomorrow = SimpleNamespace(datetime=Tomorrow, timedelta=datetime.timedelta)
        monkeypatch.setattr(incluster_config, "datetime", tomorrow)  # the client reads the token again each minute
        assert bench.start(2) == ("marey-crew-k1-0", "marey-crew-k1-1")
        bench.do(bench.launcher.stop(bench.start(2)))
        bench.close()


class Tomorrow(datetime.datetime):
    """Clock that is one day ahead."""

    @classmethod
    def now(cls, tz: datetime.tzinfo | None = None) -> Tomorrow:
        return super().now(tz) + datetime.timedelta(days=1)


def test_an_invalid_kubeconfig_is_an_error_of_the_engine(bench: Bench, tmp_path: Path) -> None:
    with pytest.raises(EngineError, match="the access to the cluster is not configured"):
        bench.do(bench.make(kubeconfig=tmp_path / "missing").list())
    with pytest.raises(EngineError, match="the access to the cluster is not configured"):
        bench.do(bench.make(kubeconfig=None).list())
    with pytest.raises(LauncherUnusable, match="image: the image must be named by its digest"):
        bench.make(image="marey-worker:latest")
