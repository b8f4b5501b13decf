"""Documents of the Jobs of a cluster: each Job runs one job of the queue, or one of its tasks in each pod."""

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
    """Start of pods for a job: the `number` of the start, and the number of claims of the job until then.

    With `size`, the job is a parent job, and each of its tasks has a pod; at most `parallel` of them run at once.
    `project` is the id of the job's project.
    """

    job: str
    number: int
    fence: int = 0
    size: int | None = None
    parallel: int = 1
    project: str = ""

    def name(self, options: ClusterOptions) -> str:
        """Return the name of the Job; a repetition of this start gives the same name."""
        return f"{options.instance}-{self.job.replace('_', '-')}-{self.number}"


@dataclass(frozen=True)
class PodPlace:
    """A job, or a task of a parent job, that a pod runs."""

    job: str
    position: int | None = None


def own_pod_labels(options: ClusterOptions) -> dict[str, str]:
    """Return the labels of all Jobs that run one job of the queue."""
    return job_labels(OWN_PODS, options)


def own_pod_job(
    pool: Pool, dispatch: Dispatch, *, time_limit_s: int, environment: Mapping[str, str] | None = None
) -> Manifest:
    """Return the Job that runs a job of the queue.

    Each pod knows the id of its job and a token that can only claim this job. A pod whose worker is refused by the
    server ends the Job (of its index) at once; a pod that the cluster ended is replaced, and counts as no failure.

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
    """Return the id of the job of the queue that a Job runs."""
    return str(job["metadata"]["labels"][JOB_ID_LABEL])


def dispatch_of(job: Mapping[str, Any]) -> tuple[int, int]:
    """Return the number of the start that created a Job, and the number of claims of its job until this start."""
    stored = _dispatch(job)
    return int(stored.get("number", 0)), int(stored.get("fence", 0))


def project_of(job: Mapping[str, Any]) -> str:
    """Return the id of the project of a Job; it is empty if an older server started the Job."""
    return str(_dispatch(job).get("project", ""))


def _dispatch(job: Mapping[str, Any]) -> dict[str, Any]:
    stored: dict[str, Any] = json.loads(job["metadata"].get("annotations", {}).get(DISPATCH_ANNOTATION, "{}"))
    return stored


def places_of(job: Mapping[str, Any]) -> Iterator[PodPlace]:
    """Yield the job or the tasks that the pods of a Job still run or will run."""
    if is_over(job):
        return
    size, ended = _size_of(job), ended_indexes(job)
    if size is None:
        yield PodPlace(job_of(job))
    else:
        yield from (PodPlace(job_of(job), index) for index in range(size) if index not in ended)


def pods_of(job: Mapping[str, Any]) -> int:
    """Return the greatest number of pods that a Job can still run at once."""
    left = sum(1 for _ in places_of(job))
    return min(left, int(job["spec"].get("parallelism", 1)))


def is_split(job: Mapping[str, Any]) -> bool:
    """Return whether each pod of a Job runs a task."""
    return _size_of(job) is not None


def _size_of(job: Mapping[str, Any]) -> int | None:
    return job["spec"]["completions"] if job["spec"].get("completionMode") == "Indexed" else None
