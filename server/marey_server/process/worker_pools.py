"""Settings of the pools of workers that a server starts with a launcher."""

from __future__ import annotations

from typing import Annotated, Any, Self

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator

from marey_schemas.sizes import MIB

SHORTEST_DEADLINE_S = 600


class WorkerPool(BaseModel):
    """Workers with the same labels and resources."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    name: str = Field(
        pattern=r"^[a-z]([a-z0-9-]{0,18}[a-z0-9])?$",
        description="Name of the pool; the names of its workers begin with it.",
    )
    labels: dict[str, str] = Field(default_factory=dict, max_length=6, description="Labels of the workers.")
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
    gpus: int = Field(0, ge=0, le=64, description="Graphics processors of a worker.")
    deadline_s: int | None = Field(
        None,
        ge=SHORTEST_DEADLINE_S,
        le=30 * 86400,
        description="Seconds after which the engine ends a worker; much more than the longest job takes, because a "
        "job that runs at this time starts again. Absent: as the engine decides.",
    )
    idle_s: float = Field(
        300.0, ge=1, description="Seconds for which a worker must be superfluous before it is stopped."
    )
    options: dict[str, Any] = Field(
        default_factory=dict, description="Options of the launcher for this pool, in addition to launcher_options."
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


def _with_different_names(pools: tuple[WorkerPool, ...]) -> tuple[WorkerPool, ...]:
    names = [pool.name for pool in pools]
    for number, name in enumerate(names):
        if name in names[:number]:
            raise ValueError(f"several pools have the name {name!r}; each pool needs a name of its own")
    return pools


WorkerPools = Annotated[tuple[WorkerPool, ...], Field(max_length=50), AfterValidator(_with_different_names)]
"""Pools of a server; each has a name of its own."""
