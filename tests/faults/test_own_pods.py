"""Pods of a job's own that run twice, die, lie or never start, and a cluster that does not answer: one result each.

The dispatcher runs in this process; the tests claim and complete jobs as pods do.
"""

from __future__ import annotations

from collections.abc import Iterator
from copy import deepcopy
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import true
from tests.support.cluster.dispatching import ENDS, LARGE, OWN_IMAGE, REFUSED, WAITS, DispatchBench, name_of
from tests.support.cluster.stub import IMAGE, StubCluster, running_cluster
from tests.support.present import present
from tests.support.queue_desk import Desk

from marey_schemas.backoff import Backoff
from marey_schemas.queue.scripts import ScriptCreate, ScriptRunCreate
from marey_schemas.queue.worker_protocol import Lease
from marey_server.errors import LeaseLostProblem
from marey_server.launchers.kubernetes import view
from marey_server.launchers.kubernetes.cluster import Cluster
from marey_server.launchers.kubernetes.worker_jobs import WorkerJobs
from marey_server.launchers.launcher import EngineError
from marey_server.store.jobs import fencing
from marey_server.store.scripts import registry, runs


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[StubCluster]:
    with running_cluster(tmp_path / "cluster") as stub:
        stub.kubelet.images[IMAGE] = WAITS
        yield stub


@pytest.fixture
def bench(desk: Desk, cluster: StubCluster, tmp_path: Path) -> Iterator[DispatchBench]:
    bench = DispatchBench(desk, cluster, tmp_path)
    yield bench
    bench.close()


def start(bench: DispatchBench) -> str:
    """Submit a large job, and let its pod start; return the id of the job."""
    job = bench.desk.submit("sum", resources=LARGE)
    bench.rounds_until(bench.pods)
    assert bench.jobs() == [name_of(job, 1)]
    return job


def publish(bench: DispatchBench, lease: Lease, value: str) -> None:
    bench.desk.stage(lease, "sum", facts={"by": value})
    bench.desk.complete(lease, result={"by": value})


def lose_lease(bench: DispatchBench) -> None:
    """Let the lease of the only running job expire, and let the server reclaim the job."""
    bench.desk.clock.advance(120)
    assert bench.desk.reap() == 1


def run_out_of_memory(bench: DispatchBench, cluster: StubCluster, job: str, number: int) -> None:
    """Let the pod of the start with this number claim the job, and die because its container has no memory left."""
    bench.rounds_until(lambda: name_of(job, number) in bench.jobs() and bench.pods())
    (lease,) = bench.claim(job)
    bench.desk.heartbeat(lease)
    (pod,) = bench.pods()
    cluster.run(lambda: cluster.kubelet.kill(pod, "OOMKilled"))
    bench.rounds_until(lambda: not bench.pods())
    lose_lease(bench)


def take_over(bench: DispatchBench) -> None:
    """Let two pods of one Job run, of which the first is suspended longer than its lease; check that one publishes."""
    job = start(bench)
    bench.rounds_until(lambda: len(bench.pods()) == 2)
    (first,) = bench.claim(job)
    assert bench.claim(job) == [], "the second pod waits while the lease of the first lives"
    lose_lease(bench)
    (second,) = bench.claim(job)
    assert second.fence > first.fence
    with pytest.raises(LeaseLostProblem):
        bench.desk.heartbeat(first)
    with pytest.raises(LeaseLostProblem):
        publish(bench, first, "first")
    publish(bench, second, "second")
    assert present(bench.desk.job(job).result)["by"] == "second"
    assert len(bench.desk.outputs(job)) == 1


def test_two_pods_of_one_job_publish_one_result(bench: DispatchBench, cluster: StubCluster) -> None:
    cluster.controllers.duplicates = True
    take_over(bench)
    bench.rounds_until(lambda: not bench.jobs() and not bench.pods(), step_s=1)
    assert cluster.all("secrets") == []


def test_without_the_fence_two_pods_would_publish(
    bench: DispatchBench, cluster: StubCluster, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Negative control: the test above must fail if writes do not check the fence."""
    cluster.controllers.duplicates = True
    monkeypatch.setattr(fencing, "same_fence", lambda _fence: true())
    with pytest.raises(pytest.fail.Exception, match="DID NOT RAISE"):
        take_over(bench)


def test_a_pod_that_exits_with_status_0_has_not_completed_its_job(bench: DispatchBench, cluster: StubCluster) -> None:
    cluster.kubelet.images[IMAGE] = ENDS
    job = bench.desk.submit("sum", resources=LARGE)
    bench.rounds_until(lambda: [one for one in cluster.all("jobs") if "succeeded" in str(one["status"])])
    bench.rounds_until(lambda: cluster.all("jobs")[0]["status"].get("conditions"))
    bench.round()
    assert (bench.desk.state(job), bench.jobs()) == ("queued", [name_of(job, 1)]), "it waits, as its pod did not claim"
    cluster.kubelet.images[IMAGE] = WAITS
    bench.rounds_until(lambda: name_of(job, 2) in bench.jobs(), step_s=1)
    (lease,) = bench.claim(job)
    publish(bench, lease, "second")
    assert bench.desk.state(job) == "succeeded"


def test_a_pod_that_dies_is_replaced_when_its_lease_has_expired(bench: DispatchBench, cluster: StubCluster) -> None:
    job = start(bench)
    (lease,) = bench.claim(job)
    bench.desk.heartbeat(lease)
    (pod,) = bench.pods()
    cluster.run(lambda: cluster.kubelet.kill(pod))
    bench.rounds_until(lambda: not bench.pods())
    bench.round()
    assert bench.jobs() == [name_of(job, 1)], "the lease still lives"
    lose_lease(bench)
    bench.rounds_until(lambda: name_of(job, 2) in bench.jobs())
    (second,) = bench.claim(job)
    publish(bench, second, "second")
    with pytest.raises(LeaseLostProblem):
        bench.desk.heartbeat(lease)


def test_a_job_that_kills_every_pod_ends_and_the_queue_keeps_moving(bench: DispatchBench, cluster: StubCluster) -> None:
    poison = start(bench)
    for number in range(1, 4):
        run_out_of_memory(bench, cluster, poison, number)
    failure = bench.desk.job(poison).failure
    assert failure is not None
    assert failure.reason == "attempts_exhausted"
    bench.round(60)
    assert len(bench.jobs()) == 3
    other = bench.desk.submit("errand", resources=LARGE)
    bench.rounds_until(lambda: name_of(other, 1) in bench.jobs())


def test_a_job_that_is_cancelled_before_its_pod_starts_leaves_nothing(
    bench: DispatchBench, cluster: StubCluster
) -> None:
    cluster.kubelet.paused = True
    job = bench.desk.submit("sum", resources=LARGE)
    bench.rounds_until(bench.jobs)
    bench.desk.cancel(job)
    bench.rounds_until(lambda: not bench.jobs() and not cluster.all("pods"), step_s=1)
    assert (cluster.all("secrets"), cluster.kubelet.commands) == ([], [])


def test_a_pod_that_the_server_refuses_is_not_started_again_at_once(
    bench: DispatchBench, cluster: StubCluster, caplog: pytest.LogCaptureFixture
) -> None:
    cluster.kubelet.images[IMAGE] = REFUSED
    job = bench.desk.submit("sum", resources=LARGE)
    bench.rounds_until(lambda: any(one["status"].get("conditions") for one in cluster.all("jobs")))
    bench.rounds_until(lambda: "status 42" in caplog.text)
    for _ in range(3):
        bench.round(0.5)
    assert bench.jobs() == [name_of(job, 1)]
    bench.rounds_until(lambda: name_of(job, 2) in bench.jobs(), step_s=1)


def test_jobs_whose_images_are_no_longer_allowed_keep_no_other_job_waiting(bench: DispatchBench) -> None:
    desk = bench.desk
    given = {
        "name": "train", "repository": "https://git.invalid/motion", "commit": "a" * 40, "image": OWN_IMAGE,
        "argv": ["python", "train.py", "{output:fields}"], "outputs": {"fields": {"kind": "fields"}},
    }  # fmt: skip
    script = ScriptCreate.model_validate(given)
    desk.database.write(desk.user, registry.register_script, "lab", script, ("https://git.invalid/",))
    for seed in range(3):
        desk.database.write(desk.user, runs.run_script, "lab", "train", ScriptRunCreate(seed=seed))
    job = desk.submit("sum", resources=LARGE)
    bench.open(most=1, images=[])
    for _ in range(4):
        bench.round()
    assert bench.jobs() == [name_of(job, 1)]


def test_jobs_that_no_node_can_run_give_their_places_to_others(bench: DispatchBench, cluster: StubCluster) -> None:
    cluster.kubelet.images.clear()
    bench.open(most=1, patience_s=100)
    stuck = bench.desk.submit("sum", resources=LARGE)
    bench.rounds_until(bench.jobs)
    other = bench.desk.submit("sum", params={"number": 2}, resources=LARGE)
    bench.rounds_until(lambda: name_of(other, 1) in bench.jobs(), step_s=20)
    assert name_of(stuck, 1) not in bench.jobs()
    told = bench.desk.job(stuck).progress
    assert told is not None
    assert "no node ran the pod within 100 s" in told.note
    assert "ErrImagePull" in told.note
    cluster.kubelet.images[IMAGE] = WAITS
    bench.rounds_until(bench.pods)
    bench.desk.complete(bench.claim(other)[0])
    bench.desk.clock.advance(101)
    bench.rounds_until(lambda: name_of(stuck, 1) in bench.jobs(), step_s=1)


def test_a_job_whose_pod_the_cluster_refuses_keeps_no_other_job_waiting(
    bench: DispatchBench, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = bench.desk.submit("sum", resources=LARGE)
    second = bench.desk.submit("sum", params={"number": 2}, resources=LARGE)
    real = Cluster.create_job

    async def create_job(cluster: Cluster, job: dict[str, Any]) -> dict[str, Any]:
        if job["metadata"]["name"] == name_of(first, 1):
            job = deepcopy(job)
            job["spec"]["template"]["spec"]["restartPolicy"] = "Always"
        return await real(cluster, job)

    monkeypatch.setattr(Cluster, "create_job", create_job)
    bench.round()
    bench.round()
    assert bench.jobs() == [name_of(second, 1)]
    told = bench.desk.job(first).progress
    assert told is not None
    assert "the cluster refused the pod: the cluster answers 4" in told.note
    monkeypatch.undo()
    bench.desk.clock.advance(61)
    bench.round()
    assert bench.jobs() == sorted([name_of(first, 1), name_of(second, 1)])


def test_a_server_that_dies_before_it_has_created_the_token_is_replaced(
    bench: DispatchBench, cluster: StubCluster, monkeypatch: pytest.MonkeyPatch
) -> None:
    job = bench.desk.submit("sum", resources=LARGE)

    async def die(*_: Any) -> None:
        raise EngineError("the server has died here")

    with monkeypatch.context() as dying:
        dying.setattr(WorkerJobs, "_supply_token", die)
        with pytest.raises(EngineError, match="has died"):
            bench.round()
    assert (bench.jobs(), cluster.all("secrets")) == ([name_of(job, 1)], [])
    bench.do(bench.dispatcher.close())
    bench.open()
    bench.rounds_until(bench.pods)
    assert bench.jobs() == [name_of(job, 1)], "the next server found the Job of the first"
    assert len(bench.claim(job)) == 1


def test_two_servers_that_start_the_same_job_start_it_once(bench: DispatchBench) -> None:
    first = bench.dispatcher
    job = bench.desk.submit("sum", resources=LARGE)
    bench.round()
    bench.desk.clock.advance(300)  # the lead of the first server, which is suspended, expires
    bench.open()
    bench.round()
    bench.do(first.adjust())
    assert bench.jobs() == [name_of(job, 1)]


@pytest.mark.parametrize("watches", ["drop", "gone", "silent"])
def test_without_watches_lists_show_what_pods_do(bench: DispatchBench, cluster: StubCluster, watches: Any) -> None:
    cluster.faults.watches = watches
    job = start(bench)
    (pod,) = bench.pods()
    cluster.run(lambda: cluster.kubelet.kill(pod))
    bench.rounds_until(lambda: not bench.pods())
    bench.rounds_until(lambda: name_of(job, 2) in bench.jobs(), step_s=1)


def test_an_error_of_the_cluster_starts_nothing_twice(
    bench: DispatchBench, cluster: StubCluster, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(view, "PAUSES", Backoff(first_s=0.05, longest_s=0.2))
    job = bench.desk.submit("sum", resources=LARGE)
    cluster.faults.status = 500
    with pytest.raises(EngineError, match="the cluster answers 500"):
        bench.round()
    cluster.faults.status = None
    cluster.faults.lose = {"POST"}
    with pytest.raises(EngineError, match="no valid answer"):
        bench.round()
    cluster.faults.lose = set()
    cluster.faults.delay_s = 0.3
    bench.rounds_until(bench.pods)
    assert bench.jobs() == [name_of(job, 1)]


def test_the_tasks_of_a_job_are_one_indexed_job_and_a_dead_task_gets_another_pod(
    bench: DispatchBench, cluster: StubCluster
) -> None:
    cluster.controllers.duplicates = True
    parent = bench.desk.submit(
        "survey", params={"number": 3}, inputs={"things": [{"item": bench.desk.things(1)[0]}]}, resources=LARGE
    )
    bench.rounds_until(lambda: len(bench.pods()) == 6)
    assert bench.jobs() == [name_of(parent, 1)]
    leases = [bench.claim(parent, task=position)[0] for position in range(3)]
    assert [lease.position for lease in leases] == [0, 1, 2]
    assert bench.claim(parent, task=1) == [], "the second pod of the index waits"
    for lease in leases:
        bench.desk.heartbeat(lease)
    dead = [pod for pod in bench.pods() if pod.startswith(f"{name_of(parent, 1)}-1-")]
    for pod in dead:
        cluster.run(partial(cluster.kubelet.kill, pod))
    for lease in (leases[0], leases[2]):
        bench.desk.complete(lease, result={"at": lease.position})
    lose_lease(bench)
    task = leases[1].job
    bench.rounds_until(lambda: name_of(task, leases[1].fence + 2) in bench.jobs())
    (again,) = bench.claim(task)
    with pytest.raises(LeaseLostProblem):
        bench.desk.complete(leases[1], result={"at": 1})
    bench.desk.complete(again, result={"at": 1})
    assert bench.desk.state(parent) == "queued", "it gathers the results now"
    bench.rounds_until(lambda: name_of(parent, 2) in bench.jobs())
    (gathering,) = bench.claim(parent)
    bench.desk.complete(gathering, result={"tasks": 3})
    bench.rounds_until(lambda: not bench.pods(), step_s=1)
    assert bench.desk.state(parent) == "succeeded"
