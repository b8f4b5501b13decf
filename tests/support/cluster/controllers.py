"""Controllers of the stub cluster: Jobs, Deployments, deletion of ended Jobs, and a simple substitute for Kueue."""

from __future__ import annotations

import datetime
import time
from dataclasses import dataclass, field
from typing import Any

from tests.support.cluster.objects import Document, Objects, condition, now, set_condition

JOB_LABEL = "batch.kubernetes.io/job-name"
INDEX_LABEL = "batch.kubernetes.io/job-completion-index"
QUEUE_LABEL = "kueue.x-k8s.io/queue-name"


@dataclass
class Controllers:
    """Controllers that bring the objects of the cluster into the state that their specifications describe."""

    objects: Objects
    duplicates: bool = False
    """Whether each worker of a Job gets two pods at once, as may happen when a node is lost and comes back."""
    quota: int = 0
    """Number of Jobs that Kueue admits at the same time."""
    _ended_at: dict[str, float] = field(default_factory=dict)
    _counted: set[str] = field(default_factory=set)
    """Pods whose failure was ignored or counted."""
    _suspended: set[str] = field(default_factory=set)
    """Pods that ended because their Job was suspended, which is neither a success nor a failure."""
    _failures: dict[tuple[str, str], int] = field(default_factory=dict)
    _succeeded: set[tuple[str, str]] = field(default_factory=set)
    _duplicated: set[tuple[str, str]] = field(default_factory=set)

    def step(self) -> None:
        """Compare all objects with their specifications once."""
        self.objects.delete_orphans()
        self._admit_queued()
        for job in self.objects.select("jobs"):
            if condition(job, "Complete") or condition(job, "Failed"):
                self._delete_when_old(job)
            else:
                self._drive_job(job)
        for deployment in self.objects.select("deployments"):
            self._drive_deployment(deployment)

    def preempt(self, job: str) -> None:
        """Suspend a Job, as Kueue does when a Job of a higher priority needs its quota."""
        self.quota -= 1
        self.objects.change("jobs", job, lambda one: one["spec"].update({"suspend": True}))

    def _admit_queued(self) -> None:
        """Resume suspended Jobs of a queue while the quota allows it."""
        unfinished = [job for job in self.objects.select("jobs") if QUEUE_LABEL in job["metadata"]["labels"]
                      and not condition(job, "Complete") and not condition(job, "Failed")]  # fmt: skip
        admitted = sum(not job["spec"].get("suspend") for job in unfinished)
        for job in unfinished:
            if job["spec"].get("suspend") and admitted < self.quota:
                admitted += 1
                name = job["metadata"]["name"]
                self.objects.change("jobs", name, lambda one: one["spec"].update({"suspend": False}))

    def _drive_job(self, job: Document) -> None:
        name, spec = job["metadata"]["name"], job["spec"]
        pods = [document for kind, document in self.objects.owned_by(job) if kind == "pods"]
        if spec.get("suspend"):
            self._end_pods(pods)
            self._suspended |= {pod["metadata"]["uid"] for pod in pods}
            self._change_status(name, lambda status: status.pop("startTime", None))
            return
        self._change_status(name, lambda status: status.setdefault("startTime", now()))
        if _overdue(self.objects.read("jobs", name)):
            self._end_pods(pods)
            self._fail(name, "DeadlineExceeded", "Job was active longer than specified deadline")
            return
        indexes = [str(index) for index in range(spec["completions"])] if _indexed(job) else [""]
        room = [spec.get("parallelism", len(indexes))]
        states = {index: self._drive_index(job, index, pods, room) for index in indexes}
        succeeded = [index for index, state in states.items() if state == "succeeded"]
        failed = [index for index, state in states.items() if state == "failed"]
        self._change_status(name, lambda status: status.update(_counts(job, states, succeeded, failed)))
        if failed and not _indexed(job):
            self._end_pods(pods)
            self._fail(name, "BackoffLimitExceeded", "Job has reached the specified backoff limit")
        elif len(succeeded) + len(failed) == len(indexes):
            if failed:
                self._fail(name, "FailedIndexes", "Job has failed indexes")
            else:
                self._end(name, "Complete", "CompletionsReached", "Reached expected number of succeeded pods")

    def _drive_index(self, job: Document, index: str, pods: list[Document], room: list[int]) -> str:
        """Return the state of an index after the missing pods were created.

        `room` contains the number of further indexes that may have pods now.
        """
        present = [pod for pod in pods if pod["metadata"]["uid"] not in self._suspended]
        own = [pod for pod in present if pod["metadata"]["labels"].get(INDEX_LABEL, "") == index]
        limit = job["spec"].get("backoffLimitPerIndex", job["spec"].get("backoffLimit", 6))
        key = (job["metadata"]["uid"], index)
        for pod in own:
            uid, phase = pod["metadata"]["uid"], pod["status"]["phase"]
            over = phase == "Failed" or ("deletionTimestamp" in pod["metadata"] and phase == "Pending")
            if over and uid not in self._counted:
                self._counted.add(uid)
                self._failures[key] = self._failures.get(key, 0) + (not _ignored(job, pod))
        if any(pod["status"]["phase"] == "Succeeded" for pod in own):
            self._succeeded.add(key)
        if key in self._succeeded:
            return "succeeded"
        if self._failures.get(key, 0) > limit or any(_fails_at_once(job, pod) for pod in own):
            return "failed"
        room[0] -= 1
        if room[0] < 0:
            return "waiting"
        active = [pod for pod in own if pod["status"]["phase"] in ("Pending", "Running")]
        if not active:
            self._create_pod(job, index)
            if self.duplicates and key not in self._duplicated:
                self._duplicated.add(key)
                self._create_pod(job, index)
        return "active"

    def _create_pod(self, job: Document, index: str) -> None:
        name = job["metadata"]["name"]
        labels = {JOB_LABEL: name} | ({INDEX_LABEL: index} if index else {})
        pod = _pod(job, f"{name}-{index}-" if index else f"{name}-", labels)
        if index:
            pod["spec"]["containers"][0].setdefault("env", []).append({"name": "JOB_COMPLETION_INDEX", "value": index})
        self.objects.create("pods", pod)

    def _drive_deployment(self, deployment: Document) -> None:
        pods = [document for kind, document in self.objects.owned_by(deployment) if kind == "pods"]
        alive = [pod for pod in pods if "deletionTimestamp" not in pod["metadata"]]
        for _ in range(deployment["spec"]["replicas"] - len(alive)):
            self.objects.create("pods", _pod(deployment, f"{deployment['metadata']['name']}-", {}))
        self._end_pods(alive[deployment["spec"]["replicas"] :])

    def _end_pods(self, pods: list[Document]) -> None:
        for pod in pods:
            if pod["status"]["phase"] in ("Pending", "Running"):
                self.objects.mark_deleted("pods", pod["metadata"]["name"])

    def _fail(self, job: str, reason: str, message: str) -> None:
        self._end(job, "Failed", reason, message)

    def _end(self, job: str, kind: str, reason: str, message: str) -> None:
        self.objects.change("jobs", job, lambda one: set_condition(one, kind, True, reason, message))

    def _change_status(self, job: str, change: Any) -> None:
        self.objects.change("jobs", job, lambda one: change(one.setdefault("status", {})))

    def _delete_when_old(self, job: Document) -> None:
        """Delete an ended Job after `ttlSecondsAfterFinished`."""
        ended_at = self._ended_at.setdefault(job["metadata"]["uid"], time.monotonic())
        if time.monotonic() - ended_at >= job["spec"].get("ttlSecondsAfterFinished", float("inf")):
            self.objects.delete("jobs", job["metadata"]["name"])


def _pod(owner: Document, prefix: str, labels: Document) -> Document:
    template = owner["spec"]["template"]
    reference = {"apiVersion": owner["apiVersion"], "kind": owner["kind"], "name": owner["metadata"]["name"],
                 "uid": owner["metadata"]["uid"], "controller": True}  # fmt: skip
    metadata = {"generateName": prefix, "labels": {**template["metadata"]["labels"], **labels}}
    return {"apiVersion": "v1", "kind": "Pod", "metadata": metadata | {"ownerReferences": [reference]},
            "spec": template["spec"], "status": {"phase": "Pending"}}  # fmt: skip


def _indexed(job: Document) -> bool:
    return job["spec"].get("completionMode") == "Indexed"


def _ignored(job: Document, pod: Document) -> bool:
    """Return whether the failure policy of a Job ignores that a pod failed."""
    for rule in job["spec"].get("podFailurePolicy", {}).get("rules", ()):
        if any(condition(pod, one["type"]) for one in rule.get("onPodConditions", ())):
            return bool(rule["action"] == "Ignore")
    return False


def _fails_at_once(job: Document, pod: Document) -> bool:
    """Return whether the failure policy of a Job ends the Job, or its index, because of the exit status of a pod."""
    every = pod["status"].get("containerStatuses", ())
    codes = {one["name"]: one["state"].get("terminated", {}).get("exitCode") for one in every}
    for rule in job["spec"].get("podFailurePolicy", {}).get("rules", ()):
        wanted = rule.get("onExitCodes", {})
        if wanted and wanted["operator"] == "In" and codes.get(wanted["containerName"]) in wanted["values"]:
            return rule["action"] in ("FailJob", "FailIndex")
    return False


def _overdue(job: Document) -> bool:
    limit = job["spec"].get("activeDeadlineSeconds")
    if limit is None:
        return False
    started = datetime.datetime.fromisoformat(job["status"]["startTime"].replace("Z", "+00:00"))
    return (datetime.datetime.now(datetime.UTC) - started).total_seconds() >= limit


def _counts(job: Document, states: dict[str, str], succeeded: list[str], failed: list[str]) -> Document:
    found: Document = {"active": list(states.values()).count("active"), "succeeded": len(succeeded)}
    found["failed"] = len(failed)
    if _indexed(job):
        found |= {"completedIndexes": ",".join(succeeded), "failedIndexes": ",".join(failed)}
    return found
