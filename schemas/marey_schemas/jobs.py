"""Job kinds, jobs, and what workers and the server say to each other."""

from __future__ import annotations

from datetime import datetime
from enum import StrEnum
from typing import Any, Literal

from pydantic import Field

from marey_schemas.base import Answer, Request
from marey_schemas.kinds import Kind
from marey_schemas.names import CollectionPath, Message


class JobState(StrEnum):
    """waiting -> queued -> running -> succeeded, failed or cancelled; the last three never change."""

    WAITING = "waiting"
    QUEUED = "queued"
    RUNNING = "running"
    SUCCEEDED = "succeeded"
    FAILED = "failed"
    CANCELLED = "cancelled"

    @property
    def terminal(self) -> bool:
        """Whether the state is final."""
        return self in (JobState.SUCCEEDED, JobState.FAILED, JobState.CANCELLED)


class FailureReason(StrEnum):
    """Why a job failed for good."""

    ERROR = "error"
    TIMEOUT = "timeout"
    ATTEMPTS_EXHAUSTED = "attempts_exhausted"
    POISON = "poison"
    DEPENDENCY_FAILED = "dependency_failed"


class InputSpec(Answer):
    """One named input of a kind."""

    kind: Kind
    many: bool = False
    required: bool = True
    parts: tuple[str, ...] = Field(
        (), description="Parts that are read, where the result depends on no others; none: all of them."
    )
    description: str = ""


class JobKind(Answer):
    """Inputs, parameters and outputs of a kind of job."""

    name: str
    description: str
    params_schema: dict[str, Any]
    inputs: dict[str, InputSpec]
    outputs: dict[str, Kind | Literal["file"]]
    fan_out: str | None = Field(None, description="The input whose items are spread over many workers.")
    batch_size: int = Field(1, description="Items a single task of a fan-out takes.")
    gathers: bool = Field(False, description="The parameters say how many tasks there are; a worker gathers them.")
    deterministic: bool = Field(
        True, description="Same inputs, parameters and seed give the same bytes: results may be cached."
    )


class ItemInput(Request):
    """An item, pinned to a revision; without one, its newest at the moment of submission."""

    item: str
    revision: int | None = Field(None, ge=1)


class CollectionInput(Request):
    """Every item of the input's kind in a collection and below it, pinned at the moment of submission."""

    collection: CollectionPath


class JobOutputsInput(Request):
    """Everything of the input's kind that another job of the project makes, pinned when that job has succeeded.

    The job waits for the other one, as for those in `after`.
    """

    job: str = Field(min_length=1, max_length=40)


JobInput = ItemInput | CollectionInput | JobOutputsInput
"""What can stand for an input of a job."""


class Resources(Request):
    """Limits of one attempt."""

    time_limit_s: int = Field(3600, ge=1, le=7 * 86400)
    memory_limit_mb: int = Field(4096, ge=64, le=1_048_576)


class JobCreate(Request):
    """Submit a job."""

    kind: str = Field(min_length=1, max_length=64)
    inputs: dict[str, JobInput | tuple[JobInput, ...]] = Field(default_factory=dict)
    params: dict[str, Any] = Field(default_factory=dict)
    into: CollectionPath = Field("", description="The collection the results go to.")
    priority: int = Field(0, ge=-100, le=100, description="Jobs of higher priority run first.")
    after: tuple[str, ...] = Field((), max_length=1000, description="Jobs that must succeed first.")
    on_failure: Literal["fail", "skip"] = Field(
        "fail", description="What to do when a job in `after` does not succeed."
    )
    concurrency_key: str | None = Field(
        None, max_length=255, description="At most one job of a project runs with this key."
    )
    cache: Literal["use", "refresh", "off"] = Field(
        "use",
        description="use: take over the result of an identical job; refresh: compute it again and keep it for later "
        "jobs; off: compute it again for this job alone.",
    )
    seed: int = Field(0, ge=0, lt=2**63, description="Seed of all random numbers: the same seed, the same result.")
    max_attempts: int = Field(3, ge=1, le=20)
    labels: dict[str, str] = Field(default_factory=dict, description="A worker must carry all of them.")
    resources: Resources = Resources()
    message: Message = ""


class Progress(Request):
    """Progress of an attempt."""

    done: float = Field(ge=0)
    total: float | None = Field(None, gt=0)
    note: str = Field("", max_length=500)


class JobFailure(Answer):
    """Why a job failed, for the person who reads it."""

    reason: FailureReason
    code: str
    detail: str


class JobOutput(Answer):
    """A revision that a job made."""

    name: str
    item: str
    kind: Kind
    revision: int
    created: bool = Field(description="False where the same content stood there before.")


class Job(Answer):
    """A job and how it stands."""

    id: str
    project: str
    kind: str
    state: JobState
    params: dict[str, Any]
    inputs: dict[str, Any] = Field(
        description="What each input is: items at their revisions, or `{job}` for what that job has yet to make."
    )
    after: tuple[str, ...] = Field((), description="Jobs that had, or have, to succeed first.")
    into: str
    priority: int
    seed: int
    attempt: int
    fence: int
    max_attempts: int
    interruptions: int = 0
    parent: str | None = None
    position: int | None = Field(None, description="Of a task: which of its fan-out it is, from 0.")
    size: int | None = Field(None, description="Tasks of a fan-out.")
    children: dict[str, int] = Field(default_factory=dict, description="Tasks by state.")
    retry_of: str | None = None
    cached_from: str | None = Field(None, description="The job whose result this one shares.")
    progress: Progress | None = None
    failure: JobFailure | None = None
    result: dict[str, Any] | None = None
    cancel_requested: bool = False
    publish_conflict: dict[str, Any] | None = None
    author: str | None
    created_at: datetime
    run_at: datetime
    started_at: datetime | None = None
    finished_at: datetime | None = None
    rev: int


class TaskResult(Answer):
    """Result of one task of a fan-out; None until the task has ended."""

    job: str
    position: int
    state: JobState
    result: dict[str, Any] | None


class Attempt(Answer):
    """One try at a job."""

    job: str
    fence: int
    worker: str
    started_at: datetime
    ended_at: datetime | None
    outcome: str | None = Field(None, description="succeeded, failed, interrupted, lost, cancelled or timeout.")
    detail: str | None = None


class JobBatch(Request):
    """Submit many jobs, all or none."""

    jobs: tuple[JobCreate, ...] = Field(min_length=1, max_length=1000)


class JobList(Answer):
    """Jobs in the order submitted."""

    jobs: tuple[Job, ...]
