"""States and ends of workers, read from documents as a cluster sends them."""

from __future__ import annotations

from typing import Any

import pytest

from marey_server.launchers.kubernetes.states import blocked_reason, end_of, group_pods, has_ended, launched_workers
from marey_server.launchers.launcher import EndReason, WorkerEnd


def job(name: str = "w", *, completions: int | None = None, **status: Any) -> dict[str, Any]:
    spec = {} if completions is None else {"completionMode": "Indexed", "completions": completions}
    metadata = {"name": name, "annotations": {"marey-worker-labels": '{"site": "lyon"}'}}
    return {"metadata": metadata, "spec": spec, "status": status}


def ended_job(kind: str, reason: str, message: str = "") -> dict[str, Any]:
    return job(conditions=[{"type": kind, "status": "True", "reason": reason, "message": message}])


def pod(
    phase: str, state: dict[str, Any] | None = None, *, index: int | None = None, created: str = "", **status: Any
) -> dict[str, Any]:
    labels = {"batch.kubernetes.io/job-name": "w"}
    if index is not None:
        labels["batch.kubernetes.io/job-completion-index"] = str(index)
    of_container = [] if state is None else [{"name": "worker", "state": state}]
    metadata = {"name": f"w-{index}-{created}", "labels": labels, "creationTimestamp": created}
    return {"metadata": metadata, "status": {"phase": phase, "containerStatuses": of_container, **status}}


def terminated(code: int, reason: str = "Error") -> dict[str, Any]:
    return {"terminated": {"exitCode": code, "reason": reason, "startedAt": "2026-11-28T01:02:03Z"}}


DISRUPTED = [{"type": "DisruptionTarget", "status": "True", "reason": "PreemptionByScheduler"}]


@pytest.mark.parametrize(
    ("document", "reason", "status"),
    [
        (pod("Succeeded", terminated(0, "Completed")), "finished", 0),
        (pod("Failed", terminated(1)), "failed", 1),
        (pod("Failed", terminated(137, "OOMKilled")), "out-of-memory", -9),
        (pod("Failed", terminated(137)), "killed", -9),
        (pod("Failed", terminated(143), conditions=DISRUPTED), "preempted", -15),
        (pod("Failed", None, reason="Evicted", message="The node was low on resource: memory."), "preempted", None),
        (pod("Failed", None, reason="DeadlineExceeded"), "deadline", None),
        (pod("Failed", None, reason="UnexpectedAdmissionError", message="no GPU"), "failed", None),
    ],
)
def test_the_end_of_a_pod_is_explained(document: dict[str, Any], reason: EndReason, status: int | None) -> None:
    end = end_of(job(), [document])
    assert end is not None
    assert (end.reason, end.status) == (reason, status)


def test_the_newest_pod_that_has_ended_explains_the_end() -> None:
    first = pod("Failed", terminated(143), created="2026-11-28T01:00:00Z", conditions=DISRUPTED)
    second = pod("Running", {"running": {"startedAt": "2026-11-28T01:00:09Z"}}, created="2026-11-28T01:00:08Z")
    pods = group_pods([second, first])["w"]
    assert pods == [first, second]
    end = end_of(job(), pods)
    assert end is not None
    assert end.detail == "PreemptionByScheduler"


def test_a_deadline_is_read_from_the_job_because_its_pods_are_deleted() -> None:
    assert end_of(ended_job("Failed", "DeadlineExceeded", "too long"), []) == WorkerEnd("deadline", None, "too long")


def test_a_job_without_pods_explains_its_end_itself() -> None:
    assert end_of(ended_job("Failed", "BackoffLimitExceeded", "m"), []) == WorkerEnd(
        "failed", None, "BackoffLimitExceeded: m"
    )
    assert end_of(ended_job("Complete", "CompletionsReached"), []) == WorkerEnd("finished", 0)
    assert end_of(job(), []) is None
    assert end_of(None, []) is None


def test_each_index_is_a_worker_with_its_own_state() -> None:
    whole = job(completions=6, completedIndexes="0,3-4", failedIndexes="1")
    running = pod("Running", {"running": {"startedAt": "2026-11-28T01:02:03Z"}}, index=2)
    found = {worker.name: worker for worker in launched_workers([whole], [running])}
    states = {name: worker.state for name, worker in found.items()}
    assert states == {
        "w-0": "ended",
        "w-1": "ended",
        "w-2": "running",
        "w-3": "ended",
        "w-4": "ended",
        "w-5": "starting",
    }
    assert found["w-2"].labels == {"site": "lyon"}
    assert str(found["w-2"].started_at) == "2026-11-28 01:02:03+00:00"
    assert has_ended(whole, "w-3")
    assert not has_ended(whole, "w-5")


def test_a_pod_that_cannot_start_says_why() -> None:
    unscheduled = [{"type": "PodScheduled", "status": "False", "reason": "Unschedulable", "message": "no GPU is free"}]
    assert blocked_reason(pod("Pending", conditions=unscheduled)) == "Unschedulable: no GPU is free"
    waiting = {"waiting": {"reason": "ImagePullBackOff", "message": "not found"}}
    assert blocked_reason(pod("Pending", waiting)) == "ImagePullBackOff: not found"
    assert blocked_reason(pod("Pending", {"waiting": {"reason": "ContainerCreating"}})) is None
    assert blocked_reason(pod("Running", {"running": {}})) is None
