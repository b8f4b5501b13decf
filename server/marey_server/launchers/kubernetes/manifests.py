"""Manifests of the objects that run workers: a Job, the Secret with its token, and a Deployment of a fixed pool."""

from __future__ import annotations

import base64
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from marey_schemas.processes.environment import thread_limits
from marey_schemas.sizes import MIB
from marey_server.launchers.kubernetes.options import ClusterOptions
from marey_server.launchers.launcher import WorkerRequest

Manifest = dict[str, Any]

CONTAINER = "worker"
LABELS_ANNOTATION = "marey-worker-labels"
"""Annotation with the labels that a worker announces, as JSON; labels of Kubernetes allow fewer characters."""
POOL_LABEL = "marey-pool"
INDEX_LABEL = "batch.kubernetes.io/job-completion-index"
JOB_LABEL = "batch.kubernetes.io/job-name"
QUEUE_LABEL = "kueue.x-k8s.io/queue-name"

TOKEN_FOLDER = "/run/marey-token"  # noqa: S105 - the name of a folder
TOKEN_FILE = "worker.token"  # noqa: S105 - the name of a file
DATA_FOLDER = "/var/lib/marey"
USER = 10001
"""User and group of the images, see `deploy/containers/Containerfile`."""
STOP_S = 45
"""Seconds that a worker has to return its jobs before it is killed."""


@dataclass(frozen=True)
class Pool:
    """Workers with the same properties, and the facts that they need: address of the server, and form of their log."""

    name: str
    url: str
    options: ClusterOptions
    request: WorkerRequest = field(default_factory=WorkerRequest)
    log_form: str = "json"
    log_level: str = "info"

    @property
    def cpus(self) -> int:
        return self.request.cpus or self.options.cpus

    @property
    def memory_bytes(self) -> int:
        return self.request.memory_bytes or self.options.memory_mb * MIB


def job_labels(pool: str, options: ClusterOptions) -> dict[str, str]:
    """Return the labels of the Jobs of a pool, and of their pods; no other Jobs or pods have all of them."""
    return {
        "app.kubernetes.io/name": "marey",
        "app.kubernetes.io/instance": options.instance,
        "app.kubernetes.io/component": "worker",
        "app.kubernetes.io/managed-by": "marey",
        POOL_LABEL: pool,
    }


def worker_job(pool: Pool, name: str, *, count: int | None = None) -> Manifest:
    """Return a Job that runs the worker `name`.

    With `count`, the Job is an Indexed Job that runs the workers `name-0`, `name-1` and so on.
    """
    options = pool.options
    labels = job_labels(pool.name, options)
    of_job = labels | ({QUEUE_LABEL: options.queue} if options.queue else {})
    disrupted = {"type": "DisruptionTarget", "status": "True"}
    spec: Manifest = {
        "ttlSecondsAfterFinished": options.ended_s,
        # A pod that the cluster itself ended is replaced, but only after it has ended. Another death ends the worker.
        "podReplacementPolicy": "Failed",
        "podFailurePolicy": {"rules": [{"action": "Ignore", "onPodConditions": [disrupted]}]},
    }
    if pool.request.deadline_s is not None:
        spec["activeDeadlineSeconds"] = pool.request.deadline_s
    if options.queue:
        spec["suspend"] = True  # until Kueue admits the Job
    if count is None:
        spec["backoffLimit"] = 0
        worker_name = name
    else:
        spec |= {"completionMode": "Indexed", "completions": count, "parallelism": count, "backoffLimitPerIndex": 0}
        worker_name = f"{name}-$(JOB_COMPLETION_INDEX)"
    pod = _pod_spec(pool, worker_name, secret=name) | {"restartPolicy": "Never"}
    spec["template"] = {"metadata": {"labels": labels}, "spec": pod}
    annotations = {LABELS_ANNOTATION: json.dumps(dict(pool.request.labels), sort_keys=True)}
    metadata = {"name": name, "namespace": options.namespace, "labels": of_job, "annotations": annotations}
    return {"apiVersion": "batch/v1", "kind": "Job", "metadata": metadata, "spec": spec}


def token_secret(job: Manifest, token: str) -> Manifest:
    """Return the Secret with the token of a Job's workers; the cluster deletes it together with the Job."""
    metadata = job["metadata"]
    owner = {"apiVersion": "batch/v1", "kind": "Job", "name": metadata["name"], "uid": metadata["uid"]}
    return {
        "apiVersion": "v1",
        "kind": "Secret",
        "metadata": {
            "name": metadata["name"],
            "namespace": metadata["namespace"],
            "labels": {name: text for name, text in metadata["labels"].items() if name != QUEUE_LABEL},
            "ownerReferences": [owner],
        },
        "type": "Opaque",
        "immutable": True,
        "data": {TOKEN_FILE: base64.b64encode(token.encode()).decode()},
    }


def pool_deployment(pool: Pool, *, replicas: int, secret: str) -> Manifest:
    """Return a Deployment of `replicas` workers, which can be scaled later.

    `secret` is the name of the Secret with the token of the workers.
    """
    options = pool.options
    labels = job_labels(pool.name, options) | {"app.kubernetes.io/managed-by": "kustomize"}
    own_name = {"name": "POD_NAME", "valueFrom": {"fieldRef": {"fieldPath": "metadata.name"}}}
    pod = _pod_spec(pool, "$(POD_NAME)", secret=secret)
    pod["containers"][0]["env"].append(own_name)
    return {
        "apiVersion": "apps/v1",
        "kind": "Deployment",
        "metadata": {"name": f"{options.instance}-{pool.name}", "labels": labels},
        "spec": {
            "replicas": replicas,
            "selector": {"matchLabels": labels},
            "template": {"metadata": {"labels": labels}, "spec": pod},
        },
    }


def _pod_spec(pool: Pool, worker_name: str, *, secret: str) -> Manifest:
    options = pool.options
    spec: Manifest = {
        "automountServiceAccountToken": False,
        "enableServiceLinks": False,
        "terminationGracePeriodSeconds": STOP_S,
        "securityContext": {
            "runAsNonRoot": True,
            "runAsUser": USER,
            "runAsGroup": USER,
            "fsGroup": USER,
            "seccompProfile": {"type": "RuntimeDefault"},
        },
        "containers": [_container(pool, worker_name)],
        "volumes": [
            {"name": "token", "secret": {"secretName": secret, "defaultMode": 0o400}},
            {"name": "inputs", "emptyDir": {"sizeLimit": f"{options.cache_mb + 64}Mi"}},
            {"name": "scratch", "emptyDir": {"sizeLimit": f"{options.scratch_mb}Mi"}},
        ],
    }
    if options.node_selector:
        spec["nodeSelector"] = dict(options.node_selector)
    if options.tolerations:
        spec["tolerations"] = [dict(one) for one in options.tolerations]
    if options.pull_secrets:
        spec["imagePullSecrets"] = [{"name": name} for name in options.pull_secrets]
    return spec


def _container(pool: Pool, worker_name: str) -> Manifest:
    return {
        "name": CONTAINER,
        "image": pool.options.image,
        "args": _arguments(pool, worker_name),
        "env": [{"name": name, "value": text} for name, text in _environment(pool).items()],
        "resources": _resources(pool),
        "securityContext": {
            "allowPrivilegeEscalation": False,
            "readOnlyRootFilesystem": True,
            "capabilities": {"drop": ["ALL"]},
        },
        "volumeMounts": [
            {"name": "token", "mountPath": TOKEN_FOLDER, "readOnly": True},
            {"name": "inputs", "mountPath": DATA_FOLDER},
            {"name": "scratch", "mountPath": "/tmp"},  # noqa: S108 - of the container
        ],
    }


def _arguments(pool: Pool, worker_name: str) -> list[str]:
    request, cache_mb = pool.request, str(pool.options.cache_mb)
    words = ["--server", pool.url, "--token-file", f"{TOKEN_FOLDER}/{TOKEN_FILE}", "worker", "--name", worker_name]
    words += ["--cache", f"{DATA_FOLDER}/inputs", "--cache-mb", cache_mb, "--slots", str(request.slots)]
    for kind in request.kinds:
        words += ["--kind", kind]
    for name, text in request.labels.items():
        words += ["--label", f"{name}={text}"]
    return words


def _environment(pool: Pool) -> Mapping[str, str]:
    """Return environment variables of the container.

    Kubernetes makes the token file readable for the group `fsGroup`, which only this pod has; `CREDENTIALS_DIRECTORY`
    lets Marey accept this. The numbers of threads are limited, because numeric libraries would start a thread for each
    processor of the node.
    """
    own = {"CREDENTIALS_DIRECTORY": TOKEN_FOLDER, "MAREY_LOG_FORM": pool.log_form, "MAREY_LOG_LEVEL": pool.log_level}
    return own | thread_limits(max(1, pool.cpus // pool.request.slots))


def _resources(pool: Pool) -> Manifest:
    """Return resource requests and equal limits, so that the cluster reserves all memory that a worker may use."""
    amounts = {"cpu": str(pool.cpus), "memory": str(pool.memory_bytes)}
    if pool.request.gpus:
        amounts[pool.options.gpu_resource] = str(pool.request.gpus)
    return {"requests": amounts, "limits": dict(amounts)}
