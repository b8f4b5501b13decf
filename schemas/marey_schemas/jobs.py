"""Job kinds, jobs, and what workers and the server say to each other."""

from datetime import datetime
from enum import StrEnum
from typing import Any, Literal

from pydantic import Field

from marey_schemas.base import Answer, Request
from marey_schemas.imports import ImportFile, ImportOptions
from marey_schemas.kinds import Kind
from marey_schemas.names import CollectionPath, ItemName, Message, NameSuffix, Tag
from marey_schemas.references import RevisionRef

PROTOCOL_VERSION = 1
"""Version of the worker protocol; sent with every claim."""


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


# --- parameters and declarations of the built-in kinds ---------------------------------------------------------------


class ImportParams(ImportOptions):
    """Parameters of `import`."""

    files: tuple[ImportFile, ...] = Field(min_length=1, max_length=10_000, description="Names and digests.")


class RetargetParams(Request):
    """Parameters of `retarget`."""

    scale: float | None = Field(None, gt=0, lt=1000, description="Root scale; absent: ratio of the hip heights.")
    suffix: NameSuffix = Field("", description="Appended to the names of the results.")
    tags: tuple[Tag, ...] = Field((), max_length=64, description="Tags of the results.")


class ExportParams(Request):
    """Parameters of `export`: one archive of files."""

    format: Literal["bvh", "npz", "predecessor", "json", "original"] = Field("bvh", description="Format of the files.")
    unit: Literal["m", "cm"] = Field("cm", description="Unit of length where the format leaves it open.")


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
    """What a kind of job takes and makes."""

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


# --- jobs as users see them ------------------------------------------------------------------------------------------


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
    priority: int = Field(0, ge=-100, le=100)
    after: tuple[str, ...] = Field((), max_length=1000, description="Jobs that must succeed first.")
    on_failure: Literal["fail", "skip"] = Field(
        "fail", description="What to do when a job in `after` does not succeed."
    )
    concurrency_key: str | None = Field(
        None, max_length=255, description="At most one job of a project runs with this key."
    )
    cache: Literal["use", "refresh", "off"] = "use"
    seed: int = Field(0, ge=0, lt=2**63)
    max_attempts: int = Field(3, ge=1, le=20)
    labels: dict[str, str] = Field(default_factory=dict, description="A worker must carry all of them.")
    resources: Resources = Resources()
    message: Message = ""


class Progress(Request):
    """How far an attempt is."""

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
    """What one task of a fan-out brought, as far as it has ended."""

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


# --- worker protocol -------------------------------------------------------------------------------------------------


class ClaimRequest(Request):
    """A worker asks for work."""

    worker: str = Field(min_length=1, max_length=255, description="Name of the worker, for people.")
    kinds: tuple[str, ...] = Field(min_length=1, max_length=256)
    labels: dict[str, str] = Field(default_factory=dict)
    max: int = Field(1, ge=1, le=256)
    wait_s: float = Field(0, ge=0, le=30)
    protocol: int = PROTOCOL_VERSION
    job: str | None = Field(None, description="Only this job.")


class PinnedInput(Answer):
    """An input as the worker reads it."""

    item: str
    revision: int
    kind: Kind
    name: str
    collection: str
    below: str | None = Field(None, description="Of what another job made: its collection below that job's `into`.")

    @property
    def folder(self) -> str:
        """Where below the job's `into` results go that keep the place of this input."""
        return self.collection if self.below is None else self.below

    @property
    def path(self) -> str:
        """Collection and name."""
        return f"{self.collection}/{self.name}".lstrip("/")

    @property
    def ref(self) -> RevisionRef:
        """As documents refer to it."""
        return RevisionRef(item=self.item, revision=self.revision)

    def as_input(self) -> ItemInput:
        """As results name what they were made of."""
        return ItemInput(item=self.item, revision=self.revision)


class Lease(Answer):
    """The right to work on a job until the lease ends."""

    job: str
    project: str
    kind: str
    params: dict[str, Any]
    inputs: dict[str, tuple[PinnedInput, ...]]
    into: str
    seed: int
    position: int | None = Field(None, description="Of a task: which of its fan-out it is, from 0.")
    size: int | None = Field(None, description="Tasks of the fan-out, for its tasks and for the job that gathers them.")
    resources: Resources
    fence: int
    attempt: int
    attempt_token: str
    lease_ttl_s: float
    heartbeat_s: float


class LeaseList(Answer):
    """The leases a claim got; empty if there was no work."""

    leases: tuple[Lease, ...] = ()


class Heartbeat(Request):
    """The worker is alive."""

    progress: Progress | None = None


class HeartbeatAnswer(Answer):
    """How long the lease lasts now, and whether to stop."""

    lease_ttl_s: float
    cancel_requested: bool
    deadline_s: float | None = Field(None, description="Seconds left of the job's time limit.")


class StagedOutput(Request):
    """One result, staged: invisible until the attempt completes."""

    name: str = Field(
        min_length=1, max_length=1500, description="Unique within the attempt; other outputs refer to it."
    )
    kind: Kind
    item_name: ItemName
    collection: CollectionPath = Field("", description="Below the job's `into`.")
    tags: tuple[Tag, ...] = Field((), max_length=64)
    parts: dict[str, Any] = Field(min_length=1)
    sources: dict[str, tuple[ItemInput, ...]] = Field(
        default_factory=dict, description="Inputs this result was made from, by input name."
    )
    reuse: Literal["by_name", "by_content"] = Field(
        "by_name", description="by_content: an item of the project with equal parts serves instead of a new one."
    )


class StageRequest(Request):
    """Stage results."""

    outputs: tuple[StagedOutput, ...] = Field(min_length=1, max_length=256)


class CompleteRequest(Request):
    """Publish what is staged and end the job. The same `write_id` again gives the same answer."""

    write_id: str = Field(min_length=8, max_length=64)
    result: dict[str, Any] = Field(default_factory=dict)
    code_version: str | None = Field(None, max_length=255)
    environment: dict[str, str] = Field(default_factory=dict)


class FailRequest(Request):
    """The attempt did not succeed."""

    write_id: str = Field(min_length=8, max_length=64)
    code: str = Field(min_length=1, max_length=128)
    detail: str = Field("", max_length=20_000)
    signature: str | None = Field(None, max_length=255, description="Two attempts with the same signature are poison.")
    retryable: bool = True
    interrupted: bool = Field(False, description="The worker was stopped; counts as no attempt.")


class BatchCompletion(CompleteRequest):
    """One completion of a batch."""

    job: str
    fence: int


class BatchCompleteRequest(Request):
    """Complete many jobs that stage no outputs beyond those staged already."""

    completions: tuple[BatchCompletion, ...] = Field(min_length=1, max_length=256)


class CompleteAnswer(Answer):
    """The job has succeeded, and this is what it published."""

    job: str
    state: JobState
    outputs: tuple[JobOutput, ...] = ()


class FailAnswer(Answer):
    """What becomes of the job after the failed attempt."""

    job: str
    state: JobState
    retry_in_s: float | None = Field(None, description="Set when the job is queued again.")


class BatchCompletionResult(Answer):
    """What became of one completion of a batch: an answer, or the reason why there is none."""

    job: str
    fence: int
    answer: CompleteAnswer | None = None
    code: str | None = None
    detail: str | None = None


class BatchCompleteAnswer(Answer):
    """One result per completion, in the order sent."""

    results: tuple[BatchCompletionResult, ...]


class StageAnswer(Answer):
    """How many results the attempt has staged."""

    staged: int


class LogAnswer(Answer):
    """How long the attempt's log is now."""

    offset: int = Field(description="Where the next piece goes.")
    capped: bool = Field(default=False, description="The log is full; nothing more is kept.")


class JobBatch(Request):
    """Submit many jobs, all or none."""

    jobs: tuple[JobCreate, ...] = Field(min_length=1, max_length=1000)


class JobList(Answer):
    """Jobs in the order submitted."""

    jobs: tuple[Job, ...]
