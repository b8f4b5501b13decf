"""Settings of the pools of workers that a server starts with a launcher."""

from __future__ import annotations

from typing import Annotated, Any, Self

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator

from marey_schemas.names import form
from marey_schemas.queue.own_pods import GPUS_LABEL, MOST_GPUS
from marey_schemas.sizes import MIB
from marey_server.access.labels import MOST_LABELS
from marey_server.access.own_pods import PodRules

SHORTEST_DEADLINE_S = 600

LabelName = Annotated[
    str, Field(pattern=form(r"^[^=\x00-\x20]{1,100}$", "have 1 to 100 characters without = and spaces"))
]
LabelValue = Annotated[
    str, Field(pattern=form(r"^[^\x00-\x1f]{0,100}$", "have at most 100 characters without line breaks"))
]
"""Parts of labels, which are given to workers as arguments of the form name=value."""


class WorkerPool(BaseModel):
    """Workers with the same labels and resources."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    name: str = Field(
        pattern=form(
            r"^[a-z]([a-z0-9-]{0,18}[a-z0-9])?$",
            "have at most 20 lower-case letters, digits and -, begin with a letter, and not end with -",
        ),
        description="Name of the pool; the names of its workers begin with it.",
    )
    labels: dict[LabelName, LabelValue] = Field(
        default_factory=dict, max_length=MOST_LABELS, description="Labels of the workers."
    )
    kinds: tuple[str, ...] = Field(
        (), max_length=256, description="Kinds of jobs that the workers run; empty: all kinds."
    )
    least: int = Field(0, ge=0, le=1000, description="Smallest number of workers.")
    most: int = Field(ge=1, le=1000, description="Greatest number of workers.")
    slots: int = Field(1, ge=1, le=64, description="Number of jobs that a worker runs at the same time.")
    cpus: int | None = Field(None, ge=1, le=1024, description="Processors of a worker. Absent: as the engine decides.")
    memory_mb: int | None = Field(
        None, ge=64, le=4_194_304, description="Memory of a worker in MiB. Absent: as the engine decides."
    )
    gpus: int = Field(0, ge=0, le=MOST_GPUS, description="Graphics processors of a worker.")
    deadline_s: int | None = Field(
        None,
        ge=SHORTEST_DEADLINE_S,
        le=30 * 86400,
        description="Seconds after which the engine ends a worker. Choose much more than the longest job takes, "
        "because a job that is running then starts again. Absent: as the engine decides.",
    )
    idle_s: float = Field(
        300.0, ge=1, description="Seconds for which a worker must be superfluous before it is stopped."
    )
    options: dict[str, Any] = Field(
        default_factory=dict,
        description="Options of the launcher for this pool; each replaces the same option in launcher_options.",
    )

    @property
    def memory_bytes(self) -> int | None:
        """Memory of a worker in bytes, or None if the engine decides."""
        return None if self.memory_mb is None else self.memory_mb * MIB

    @model_validator(mode="after")
    def _check_numbers(self) -> Self:
        if self.least > self.most:
            raise ValueError(f"least is {self.least}, but must not be greater than most, which is {self.most}")
        return self


class OwnPods(BaseModel):
    """Settings of pods that run one job each."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    most: int = Field(20, ge=1, le=1000, description="Greatest number of pods at the same time.")
    most_of_project: int | None = Field(
        None,
        ge=1,
        le=1000,
        description="Greatest number of pods of one project at the same time. Absent: the same number as in `most`.",
    )
    patience_s: int = Field(
        600,
        ge=1,
        le=86_400,
        description="Seconds after which a pod that no node runs is deleted if other jobs wait for a pod. Its job then "
        "waits for the same number of seconds.",
    )
    memory_mb: int = Field(
        4096, ge=64, description="Memory in MiB; a job with a greater memory limit gets a pod of its own."
    )
    expected_s: int = Field(60, ge=0, description="Seconds; a job that is expected to take longer gets its own pod.")
    labels: dict[str, dict[str, str]] = Field(
        default_factory=dict,
        max_length=100,
        description="Labels of jobs, as name=value, each with the labels that nodes must have to run these jobs, such "
        f'as {{"gpu=a100": {{"accelerator": "a100"}}}}. A job with other labels, except {GPUS_LABEL}, gets no pod of '
        "its own.",
    )
    images: tuple[str, ...] = Field(
        (),
        max_length=1000,
        description="Images that scripts may name: an image with its digest, the name of a repository of images, or a "
        "prefix that ends in /. Empty: none.",
    )
    cpus: int | None = Field(None, ge=1, le=1024, description="Processors of a pod. Absent: cpus of the launcher.")
    options: dict[str, Any] = Field(
        default_factory=dict,
        description="Options of the launcher for these pods; each replaces the same option in launcher_options.",
    )

    @property
    def rules(self) -> PodRules:
        """The rules that decide whether a job gets a pod of its own."""
        return PodRules(self.memory_mb, self.expected_s, frozenset(self.labels), self.images)


def _with_different_names(pools: tuple[WorkerPool, ...]) -> tuple[WorkerPool, ...]:
    names = [pool.name for pool in pools]
    for number, name in enumerate(names):
        if name in names[:number]:
            raise ValueError(f"several pools have the name {name!r}; each pool needs a name of its own")
    return pools


WorkerPools = Annotated[tuple[WorkerPool, ...], Field(max_length=50), AfterValidator(_with_different_names)]
"""Pools of a server; each has a name of its own."""
