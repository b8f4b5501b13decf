"""Kubernetes Jobs that run one job of the queue: in one pod, or, for a parent job, one task in each pod."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from marey_schemas.queue.own_pods import REFUSED_STATUS
from marey_server.launchers.kubernetes.manifests import CONTAINER, STOP_S, Manifest, Pool, job_labels, worker_job
from marey_server.launchers.kubernetes.options import ClusterOptions
from marey_server.launchers.kubernetes.states import ended_indexes, is_over

OWN_PODS = "OWN-PODS"
"""Value of the label for the pool; names of pools have no capital letters, so no pool has this name."""
JOB_ID_LABEL = "marey-job"
DISPATCH_ANNOTATION = "marey-dispatch"
PULL_S = 1800
"""Seconds that a pod may take to fetch its image, and to start and end its worker, in addition to the job's limit."""


@dataclass(frozen=True)
class Dispatch:
    """Start of pods for a job of the queue.

    Parameters
    ----------
    job : id of the job
    number : number of the start, counted for each job
    fence : number of claims of the job until this start
    size : number of tasks of a parent job, each of which has a pod; None for a single job
    parallel : greatest number of the tasks' pods that run at once
    project : id of the job's project
    """

    job: str
    number: int
    fence: int = 0
    size: int | None = None
    parallel: int = 1
    project: str = ""

    def name(self, options: ClusterOptions) -> str:
        """Return the name of the Kubernetes Job of this start; if the start is repeated, the name is the same."""
        return f"{options.instance}-{self.job.replace('_', '-')}-{self.number}"


@dataclass(frozen=True)
class PodPlace:
    """Job that a pod runs: the job `job`, or, with `position`, the task with this position of the parent job `job`."""

    job: str
    position: int | None = None


def own_pod_labels(options: ClusterOptions) -> dict[str, str]:
    """Return the labels of all Kubernetes Jobs that run one job of the queue."""
    return job_labels(OWN_PODS, options)


def own_pod_job(
    pool: Pool, dispatch: Dispatch, *, time_limit_s: int, environment: Mapping[str, str] | None = None
) -> Manifest:
    """Return the Kubernetes Job that runs a job of the queue.

    Each pod knows the id of its job and a token that can only claim this job. If the server refuses a pod's worker, the
    Kubernetes Job, or its index for this pod, fails at once. If the cluster ends a pod, the pod is replaced, and this
    does not count as a failure.

    Parameters
    ----------
    pool : properties of the pod
    time_limit_s : time limit of one attempt in seconds; the cluster ends the pod some time after this limit
    environment : further variables of the worker
    """
    job = worker_job(pool, dispatch.name(pool.options), count=dispatch.size)
    metadata, spec = job["metadata"], job["spec"]
    own = {JOB_ID_LABEL: dispatch.job}
    metadata["labels"] |= own
    metadata["annotations"][DISPATCH_ANNOTATION] = json.dumps(
        {"number": dispatch.number, "fence": dispatch.fence, "project": dispatch.project}
    )
    refused = {"containerName": CONTAINER, "operator": "In", "values": [REFUSED_STATUS]}
    action = "FailJob" if dispatch.size is None else "FailIndex"
    spec["podFailurePolicy"]["rules"].append({"action": action, "onExitCodes": refused})
    words = ["--job", dispatch.job]
    if dispatch.size is not None:
        spec["parallelism"] = min(dispatch.parallel, dispatch.size)
        words += ["--task", "$(JOB_COMPLETION_INDEX)"]
    spec["template"]["metadata"]["labels"] = spec["template"]["metadata"]["labels"] | own
    # Of the pod, not of the Job: the time for which a pod waits for a suitable node does not count.
    spec["template"]["spec"]["activeDeadlineSeconds"] = time_limit_s + PULL_S + STOP_S
    (container,) = spec["template"]["spec"]["containers"]
    container["args"] += words
    container["env"] += [{"name": name, "value": text} for name, text in (environment or {}).items()]
    return job


def job_of(job: Mapping[str, Any]) -> str:
    """Return the id of the queue job that a Kubernetes Job runs."""
    return str(job["metadata"]["labels"][JOB_ID_LABEL])


def dispatch_of(job: Mapping[str, Any]) -> tuple[int, int]:
    """Return `number` and `fence` of the `Dispatch` for which a Kubernetes Job was created."""
    stored = _dispatch(job)
    return int(stored.get("number", 0)), int(stored.get("fence", 0))


def project_of(job: Mapping[str, Any]) -> str:
    """Return the id of the project to which a Kubernetes Job belongs; empty if an older server started the Job."""
    return str(_dispatch(job).get("project", ""))


def _dispatch(job: Mapping[str, Any]) -> dict[str, Any]:
    stored: dict[str, Any] = json.loads(job["metadata"].get("annotations", {}).get(DISPATCH_ANNOTATION, "{}"))
    return stored


def places_of(job: Mapping[str, Any]) -> Iterator[PodPlace]:
    """Yield the job or the tasks that the pods of a Kubernetes Job still run or will run."""
    if is_over(job):
        return
    size, ended = _size_of(job), ended_indexes(job)
    if size is None:
        yield PodPlace(job_of(job))
    else:
        yield from (PodPlace(job_of(job), index) for index in range(size) if index not in ended)


def pods_of(job: Mapping[str, Any]) -> int:
    """Return the greatest number of pods that a Kubernetes Job can still run at the same time."""
    left = sum(1 for _ in places_of(job))
    return min(left, int(job["spec"].get("parallelism", 1)))


def is_split(job: Mapping[str, Any]) -> bool:
    """Return whether a Kubernetes Job runs a parent job, one task in each pod."""
    return _size_of(job) is not None


def _size_of(job: Mapping[str, Any]) -> int | None:
    return job["spec"]["completions"] if job["spec"].get("completionMode") == "Indexed" else None
