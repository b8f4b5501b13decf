"""Options of the launcher `kubernetes`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, StringConstraints

from marey_schemas.names import form
from marey_schemas.queue.own_pods import Image

_NAME = form(
    r"^[a-z0-9]([a-z0-9-]*[a-z0-9])?$",
    "have only lower-case letters, digits and -, and begin and end with a letter or a digit",
)
Name = Annotated[str, StringConstraints(pattern=_NAME, max_length=63)]
"""Name of an object in Kubernetes."""


class ClusterOptions(BaseModel):
    """Place and properties of the pods that run workers."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    image: Image = Field(description="Image of the workers, named by its digest.")
    namespace: Name = Field("marey", description="Namespace of the workers.")
    instance: Annotated[Name, StringConstraints(max_length=16)] = Field(
        "marey",
        description="First part of the names of workers; servers with different databases in one namespace need "
        "different ones.",
    )
    kubeconfig: Path | None = Field(
        None,
        description="File with the access to the cluster. Absent: the server itself runs in a pod, whose service "
        "account it uses.",
    )
    context: str | None = Field(None, description="Context in kubeconfig. Absent: its current context.")
    queue: Name | None = Field(
        None, description="LocalQueue of Kueue that admits the workers. Absent: Kueue is not used."
    )
    cpus: int = Field(1, ge=1, le=1024, description="Processors of a worker if its pool does not set `cpus`.")
    memory_mb: int = Field(2048, ge=256, description="Memory of a worker in MiB if its pool does not set it.")
    cache_mb: int = Field(2048, ge=16, description="Space of a worker in MiB for cached inputs.")
    scratch_mb: int = Field(4096, ge=256, description="Space of a worker in MiB for temporary files.")
    gpu_resource: str = Field(
        "nvidia.com/gpu",
        description="Name of the cluster's resource for graphics processors. Each worker gets as many as its pool sets "
        "in `gpus`.",
    )
    node_selector: dict[str, str] = Field(
        default_factory=dict, description="Labels that nodes must have to run workers."
    )
    tolerations: tuple[dict[str, str], ...] = Field((), description="Tolerations of the workers for taints of nodes.")
    pull_secrets: tuple[Name, ...] = Field((), description="Names of Secrets for a private registry.")
    ended_s: int = Field(3600, ge=0, description="Seconds for which the cluster keeps ended workers, with their logs.")
    indexed: bool = Field(
        False,
        description="Combine workers that are started together in one Indexed Job, which Kueue admits as a whole. A "
        "single worker of this Job can be stopped only after it has a pod.",
    )
    relist_s: int = Field(30, ge=1, le=600, description="Seconds between two complete lists of the workers.")
    timeout_s: float = Field(10.0, gt=0, le=300, description="Seconds that the cluster has to answer a request.")
