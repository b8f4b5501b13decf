"""Options of the launcher `kubernetes`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, StringConstraints, ValidationError

from marey_schemas.sizes import GIB

Name = Annotated[str, StringConstraints(pattern=r"^[a-z0-9]([a-z0-9-]*[a-z0-9])?$", max_length=63)]
"""Name of an object in Kubernetes."""


class ClusterOptions(BaseModel):
    """Place and properties of the pods that run workers.

    Without `kubeconfig`, the server itself runs in a pod, and uses the service account of this pod.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    image: str = Field(pattern=r"^[^\s@]+@sha256:[0-9a-f]{64}$")
    namespace: Name = "marey"
    instance: Annotated[Name, StringConstraints(max_length=16)] = "marey"
    """First part of the names of workers; servers with different databases in one namespace need different ones."""
    kubeconfig: Path | None = None
    context: str | None = None
    """Context in `kubeconfig`; None: its current context."""
    queue: Name | None = None
    """LocalQueue of Kueue that admits the workers; None: Kueue is not used."""
    cpus: int = Field(1, ge=1, le=1024)
    memory_bytes: int = Field(2 * GIB, ge=GIB // 4)
    """Processors and memory of a worker whose pool sets none."""
    cache_mb: int = Field(2048, ge=16)
    scratch_mb: int = Field(4096, ge=256)
    """Space of a worker for cached inputs, and for temporary files."""
    gpu_resource: str = "nvidia.com/gpu"
    node_selector: dict[str, str] = Field(default_factory=dict)
    tolerations: tuple[dict[str, str], ...] = ()
    pull_secrets: tuple[Name, ...] = ()
    ended_s: int = Field(3600, ge=0)
    """Seconds for which the cluster keeps ended workers, with their logs."""
    indexed: bool = False
    """Whether workers that are started together are one Indexed Job, which Kueue admits as a whole."""
    relist_s: int = Field(30, ge=1, le=600)
    """Seconds between two complete lists of the workers."""
    timeout_s: float = Field(10.0, gt=0, le=300)
    """Seconds that the cluster has to answer a request."""


def read_options(given: Mapping[str, Any]) -> ClusterOptions:
    """Return the options of a launcher. Raises `ValueError`, whose text names each invalid option."""
    try:
        return ClusterOptions(**given)
    except ValidationError as error:
        faults = "; ".join(f"{'.'.join(map(str, one['loc']))}: {_reason(one)}" for one in error.errors())
        raise ValueError(f"invalid options of the launcher `kubernetes`: {faults}") from None


def _reason(fault: Any) -> str:
    if fault["loc"] == ("image",) and fault["type"] != "missing":
        return "the image must be named by its digest, as in registry.example.org/marey-worker@sha256:..."
    return str(fault["msg"])
