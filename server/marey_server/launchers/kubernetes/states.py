"""States and ends of workers, read from the Jobs and pods of a cluster."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from datetime import datetime
from typing import Any, TypeVar

from marey_server.launchers.kubernetes.manifests import CONTAINER, INDEX_LABEL, JOB_LABEL, LABELS_ANNOTATION
from marey_server.launchers.launcher import EndReason, LaunchedWorker, WorkerEnd, WorkerState

Document = Mapping[str, Any]
T = TypeVar("T", bound=Document)

DISRUPTED = "DisruptionTarget"
_DISRUPTIONS = frozenset({"Evicted", "Preempting", "Preempted", "NodeLost", "NodeShutdown", "Terminated", "Shutdown"})
"""Reasons in the status of a pod that the cluster ended for its own purposes."""
_SIGNALS_FROM = 128
"""Exit statuses above this number are signals."""


def worker_names(job: Document) -> list[str]:
    """Return the names of the workers that a Job runs: one, or for an Indexed Job one for each index."""
    name: str = job["metadata"]["name"]
    if job["spec"].get("completionMode") != "Indexed":
        return [name]
    return [f"{name}-{index}" for index in range(job["spec"]["completions"])]


def worker_of(pod: Document) -> str | None:
    """Return the name of the worker that a pod of a Job runs; None if the pod belongs to no Job."""
    labels = pod["metadata"].get("labels") or {}
    job, index = labels.get(JOB_LABEL), labels.get(INDEX_LABEL)
    return job if job is None or index is None else f"{job}-{index}"


def launched_workers(jobs: Iterable[Document], pods: Iterable[Document]) -> Iterator[LaunchedWorker]:
    """Yield the workers that Jobs run, with their states according to `pods`."""
    pods_of = group_pods(pods)
    for job in jobs:
        labels = json.loads((job["metadata"].get("annotations") or {}).get(LABELS_ANNOTATION, "{}"))
        for name in worker_names(job):
            state, started_at = _state(job, name, pods_of.get(name, []))
            yield LaunchedWorker(name, state, labels, started_at)


def group_pods(pods: Iterable[T]) -> dict[str, list[T]]:
    """Return the pods by the names of their workers, the newest pod of each worker last."""
    found: dict[str, list[T]] = {}
    for pod in sorted(pods, key=lambda one: one["metadata"].get("creationTimestamp") or ""):
        if (name := worker_of(pod)) is not None:
            found.setdefault(name, []).append(pod)
    return found


def _state(job: Document, name: str, pods: Sequence[Document]) -> tuple[WorkerState, datetime | None]:
    """Return the state of a worker, and the time at which it started to run; None if it has not started."""
    started_at = next((at for pod in reversed(pods) if (at := _started(pod)) is not None), None)
    if has_ended(job, name):
        return "ended", started_at
    if any(pod.get("status", {}).get("phase") == "Running" for pod in pods):
        return "running", started_at
    return "starting", None


def has_ended(job: Document, worker: str) -> bool:
    """Return whether a worker of a Job has ended and will not be started again."""
    if is_over(job):
        return True
    index = worker.removeprefix(job["metadata"]["name"]).lstrip("-")
    return bool(index) and int(index) in ended_indexes(job)


def is_over(job: Document) -> bool:
    """Return whether a Job has completed or failed."""
    return _condition(job, "Complete") is not None or _condition(job, "Failed") is not None


def ended_indexes(job: Document) -> set[int]:
    """Return the indexes of an Indexed Job whose workers have ended; the status lists them as in `0,3-5`."""
    status = job.get("status") or {}
    text = f"{status.get('completedIndexes') or ''},{status.get('failedIndexes') or ''}"
    ranges = [part.partition("-") for part in text.split(",") if part]
    return {number for first, _, last in ranges for number in range(int(first), int(last or first) + 1)}


def end_of(job: Document | None, pods: Sequence[Document]) -> WorkerEnd | None:
    """Return why a worker ended most recently, or None if none of its pods has ended and its Job has not ended.

    Parameters
    ----------
    job : Job of the worker; None if it was deleted
    pods : pods of the worker, the newest last
    """
    failed = _condition(job, "Failed") if job is not None else None
    if failed is not None and failed.get("reason") == "DeadlineExceeded":
        return WorkerEnd("deadline", _last_status(pods), failed.get("message") or "the deadline has passed")
    ended = list(filter(has_terminated, pods))
    if ended:
        return _end_of_pod(ended[-1])
    if failed is not None:
        return WorkerEnd("failed", None, f"{failed.get('reason')}: {failed.get('message')}")
    if job is not None and _condition(job, "Complete") is not None:
        return WorkerEnd("finished", 0)
    return None


def has_terminated(pod: Document) -> bool:
    """Return whether a pod has ended: its container has terminated, or its phase is `Failed`."""
    return _terminated(pod) is not None or pod.get("status", {}).get("phase") == "Failed"


def _end_of_pod(pod: Document) -> WorkerEnd:
    ended = _terminated(pod) or {}
    status = ended.get("exitCode")
    signal = ended.get("signal") or (status - _SIGNALS_FROM if status is not None and status > _SIGNALS_FROM else 0)
    reason, detail = _reason(pod, ended, signal)
    return WorkerEnd(reason, -signal if signal else status, detail)


def _reason(pod: Document, ended: Document, signal: int) -> tuple[EndReason, str]:
    of_pod = pod.get("status") or {}
    disrupted = _condition(pod, DISRUPTED)
    if ended.get("reason") == "OOMKilled":
        return "out-of-memory", "the container used more memory than its limit"
    if of_pod.get("reason") == "DeadlineExceeded":
        return "deadline", of_pod.get("message") or "the deadline has passed"
    if disrupted is not None or of_pod.get("reason") in _DISRUPTIONS:
        told = [text for text in (of_pod.get("reason"), (disrupted or {}).get("reason"), of_pod.get("message")) if text]
        return "preempted", ": ".join(told)
    if not ended:
        return "failed", ": ".join(filter(None, (of_pod.get("reason"), of_pod.get("message"))))
    if signal:
        return "killed", f"signal {signal}"
    if ended.get("exitCode") == 0:
        return "finished", ""
    return "failed", str(ended.get("message") or f"exit status {ended.get('exitCode')}")


def blocked_reason(pod: Document) -> str | None:
    """Return the reason why a pod cannot start, such as a missing image or no suitable node; None if it can start."""
    waiting = (_container_status(pod).get("state") or {}).get("waiting") or {}
    conditions = pod.get("status", {}).get("conditions") or ()
    unscheduled = (one for one in conditions if one["type"] == "PodScheduled" and one["status"] == "False")
    found = next(unscheduled, waiting)
    if found.get("reason") in (None, "ContainerCreating", "PodInitializing"):
        return None
    text: str = ": ".join(filter(None, (found["reason"], found.get("message"))))
    return text


def stuck_jobs(jobs: Mapping[str, Document], pods: Iterable[Document]) -> dict[str, str]:
    """Return the reason for each Job that no node runs, by the name of the Job.

    The reason is that the pods of the Job are blocked, or have not been created.
    """
    pods_of = group_pods(pods)
    found: dict[str, str] = {}
    for name, job in jobs.items():
        of_job = [pod for worker in worker_names(job) for pod in pods_of.get(worker, ()) if not has_terminated(pod)]
        reasons = list(map(blocked_reason, of_job))
        if not is_over(job) and None not in reasons:
            found[name] = next(filter(None, reasons), "the cluster has not created the pod")
    return found


def _container_status(pod: Document) -> Document:
    every = pod.get("status", {}).get("containerStatuses") or ()
    return next((one for one in every if one["name"] == CONTAINER), {})


def _terminated(pod: Document) -> Document | None:
    return (_container_status(pod).get("state") or {}).get("terminated")


def _last_status(pods: Sequence[Document]) -> int | None:
    ends = [ended.get("exitCode") for pod in pods if (ended := _terminated(pod)) is not None]
    return ends[-1] if ends else None


def _started(pod: Document) -> datetime | None:
    state = _container_status(pod).get("state") or {}
    text = (state.get("running") or state.get("terminated") or {}).get("startedAt")
    return None if text is None else datetime.fromisoformat(text.replace("Z", "+00:00"))


def _condition(document: Document, kind: str) -> Document | None:
    every = (document.get("status") or {}).get("conditions") or ()
    return next((one for one in every if one["type"] == kind and one["status"] == "True"), None)
