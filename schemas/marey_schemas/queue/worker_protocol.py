"""Messages between workers and the server: claims, leases, heartbeats, staged results, and the ends of attempts."""

from __future__ import annotations

from typing import Any, Literal, Self

from pydantic import Field, model_validator

from marey_schemas.base import Answer, Request
from marey_schemas.documents.references import RevisionRef
from marey_schemas.kinds import Kind
from marey_schemas.names import MOST_TAGS, CollectionPath, ItemName, ShownText, Tag
from marey_schemas.queue.facets import MOST_MEASURED, ItemFacets
from marey_schemas.queue.jobs import ItemInput, JobOutput, JobState, Progress, Resources

FAULT_VARIABLE = "MAREY_FAULT"
"""Environment variable with which tests make a server or worker fail at a named point."""

INTERRUPTED_STATUS = 143
"""Exit status of a worker that ended because it was asked to stop, and returned a job to the queue."""

LONGEST_CODE = 128
LONGEST_DETAIL = 20_000
LONGEST_SIGNATURE = 255
"""Greatest numbers of characters of the texts of a `FailRequest`."""

PROTOCOL_VERSION = 1
"""Version of the worker protocol; sent with every claim."""


class ClaimRequest(Request):
    """Request of a worker to claim jobs."""

    worker: ShownText = Field(max_length=255, description="Name of the worker, shown to people.")
    kinds: tuple[ShownText, ...] = Field(min_length=1, max_length=256)
    labels: dict[str, str] = Field(default_factory=dict)
    max: int = Field(1, ge=1, le=256)
    wait_s: float = Field(0, ge=0, le=30)
    protocol: int = PROTOCOL_VERSION
    version: ShownText | None = Field(
        None, max_length=64, description="Version of Marey that the worker runs, shown to administrators."
    )
    job: str | None = Field(None, description="Id of the only job that the worker claims; absent: any job.")
    task: int | None = Field(
        None,
        ge=0,
        le=1_000_000,
        description="Index, from 0, of the only task of `job` that the worker claims; "
        "absent: any task, or the job itself.",
    )
    claim_id: str | None = Field(
        None,
        min_length=16,
        max_length=64,
        description="Random id of the claim. A repeated request with the same id and the same token renews and "
        "returns those leases of the first request that have not ended; it is refused if all of them "
        "have ended.",
    )


class PinnedInput(Answer):
    """Input of a job at a fixed revision."""

    item: str
    revision: int
    kind: Kind
    name: str
    collection: str
    below: str | None = Field(
        None,
        description="Collection of the input relative to the `into` of the job that created it; null if the input was "
        "not given as an output of a job.",
    )

    commit: str | None = Field(
        None,
        description="Digest of the commit of a dataset from which the input was "
        "taken; null: it was not taken from a dataset.",
    )
    consent_ended: str | None = Field(
        None,
        description="Last day of the performer's consent. Set only if this day has passed, by the clock of the "
        "server in UTC, and the job would write the input to a file.",
    )

    @property
    def folder(self) -> str:
        """The path, relative to the job's `into`, of the folder in which results of this input are stored.

        It equals the path of the input's folder in the project or, if the input was given as an output of another job,
        the path of the input's folder relative to the `into` of that job.
        """
        return self.collection if self.below is None else self.below

    @property
    def path(self) -> str:
        """The collection and name of the input."""
        return f"{self.collection}/{self.name}".lstrip("/")

    @property
    def ref(self) -> RevisionRef:
        """The input as a reference in documents."""
        return RevisionRef(item=self.item, revision=self.revision)

    def as_input(self) -> ItemInput:
        """Return the input as an `ItemInput`, the form in which the origin of a result is recorded."""
        return ItemInput(item=self.item, revision=self.revision)


class JobTrace(Answer):
    """Trace of the request that submitted a job, if it was recorded; spans of the job are added to it."""

    traceparent: str = Field(
        description="Span of the request that submitted the job, in the form of W3C Trace Context."
    )
    waited_s: float = Field(description="Seconds for which the job was ready to run before it was claimed.")


class Lease(Answer):
    """Right to work on a job until the lease ends."""

    job: str
    project: str
    kind: str
    params: dict[str, Any]
    inputs: dict[str, tuple[PinnedInput, ...]]
    into: str
    seed: int
    position: int | None = Field(
        None, description="Index of the task among the tasks of its parent job, from 0; null if the job is not a task."
    )
    size: int | None = Field(
        None,
        description="Number of tasks of the parent job, for its tasks and for the job that combines their "
        "results; otherwise null.",
    )
    resources: Resources
    fence: int
    attempt: int
    attempt_token: str
    lease_ttl_s: float
    heartbeat_s: float
    trace: JobTrace | None = Field(None, description="Trace to which the job belongs; null without one.")


class LeaseList(Answer):
    """Leases granted by a claim; empty if there was no work."""

    leases: tuple[Lease, ...] = ()
    state: JobState | None = Field(
        None,
        description="State of the job that the claim names, if the claim gets no lease; null if the job does "
        "not exist, or if the claim names no job.",
    )


class Heartbeat(Request):
    """Renewal of a worker's lease of a job, with the job's progress."""

    progress: Progress | None = None


class HeartbeatAnswer(Answer):
    """Remaining time of the lease, and whether the worker must stop the job."""

    lease_ttl_s: float
    cancel_requested: bool
    deadline_s: float | None = Field(None, description="Seconds that remain of the job's time limit.")


class StagedOutput(Request):
    """Result of an attempt that is staged: it becomes visible when the attempt completes."""

    name: str = Field(
        min_length=1, max_length=1500, description="Name that is unique within the attempt; other outputs refer to it."
    )
    kind: Kind
    item_name: ItemName
    collection: CollectionPath = Field("", description="Collection of the result, relative to the job's `into`.")
    tags: tuple[Tag, ...] = Field((), max_length=MOST_TAGS)
    parts: dict[str, Any] = Field(min_length=1)
    sources: dict[str, tuple[ItemInput, ...]] = Field(
        default_factory=dict, description="Inputs that this result was made from, by input name."
    )
    reuse: Literal["by_name", "by_content"] = Field(
        "by_name",
        description="Choice of an existing item for the result. by_name: the item with the same kind, name and "
        "collection gets a new revision if its content differs; by_content: an item with equal parts, anywhere in the "
        "project, is used unchanged. If there is no such item, a new one is created.",
    )
    same_skeleton: bool = Field(
        False,
        description="Publish neither this output nor its skeleton if the existing item has another skeleton. If both "
        "skeletons are the same rig, the output is published, and the item keeps its skeleton.",
    )


class StageRequest(Request):
    """Request to stage results (they stay invisible until the attempt completes), and facets (numbers about inputs)."""

    outputs: tuple[StagedOutput, ...] = Field((), max_length=256)
    facets: tuple[ItemFacets, ...] = Field(
        (),
        max_length=MOST_MEASURED,
        description="Numbers about inputs of the job, and about clips of evaluations among the inputs. They replace "
        "the numbers of an earlier request.",
    )

    @model_validator(mode="after")
    def _require_content(self) -> Self:
        if not self.outputs and not self.facets:
            raise ValueError("the request contains neither outputs nor facets; send at least one of them")
        return self


class CompleteRequest(Request):
    """Request to publish the staged outputs and end the job; requests with the same `write_id` get the same answer."""

    write_id: str = Field(min_length=8, max_length=64)
    result: dict[str, Any] = Field(default_factory=dict)
    code_version: str | None = Field(
        None,
        max_length=255,
        description="Kind and version of the code that computed the result, such as `retarget@3`. Identical jobs share "
        "the result only if the server has the same version of the kind.",
    )
    environment: dict[str, str] = Field(default_factory=dict)
    shareable: bool = Field(
        True,
        description="Whether identical jobs may share the result. False if the result depends on more than the kind, "
        "parameters, seed and inputs of the job, for example on a file that could not be read.",
    )


class FailRequest(Request):
    """Report of a worker that its attempt has failed, with the reason."""

    write_id: str = Field(min_length=8, max_length=64)
    code: str = Field(min_length=1, max_length=LONGEST_CODE)
    detail: str = Field("", max_length=LONGEST_DETAIL)
    signature: str | None = Field(
        None,
        max_length=LONGEST_SIGNATURE,
        description="Text that equal failures have in common, such as the place of an exception; a job is not "
        "retried after two attempts with the same signature. Absent: none.",
    )
    retryable: bool = True
    interrupted: bool = Field(
        False,
        description="Whether the attempt ended because the worker was stopped. Such an attempt does not count "
        "against the number of attempts.",
    )


class BatchCompletion(CompleteRequest):
    """Completion of one job in a request that completes many."""

    job: str
    fence: int


class BatchCompleteRequest(Request):
    """Request to complete many jobs without staging further outputs."""

    completions: tuple[BatchCompletion, ...] = Field(min_length=1, max_length=256)


class CompleteAnswer(Answer):
    """Answer to the completion of a job: the published results."""

    job: str
    state: JobState
    outputs: tuple[JobOutput, ...] = ()
    commit: str | None = Field(
        None, description="Digest of the commit that the job made of its outputs; null: it made none."
    )


class FailAnswer(Answer):
    """Answer to the report of a failed attempt: the state of the job now, and the wait before the next attempt."""

    job: str
    state: JobState
    retry_in_s: float | None = Field(
        None, description="Seconds until the next attempt; null if the job is not queued again."
    )


class BatchCompletionResult(Answer):
    """Result of one completion in a batch: an answer, or the reason for its refusal."""

    job: str
    fence: int
    answer: CompleteAnswer | None = None
    code: str | None = None
    detail: str | None = None


class BatchCompleteAnswer(Answer):
    """Results of the completions in a batch, in the order of the request."""

    results: tuple[BatchCompletionResult, ...]


class StageAnswer(Answer):
    """Answer to a request to stage results: the number of results that the attempt has staged so far."""

    staged: int


class LogAnswer(Answer):
    """Answer to a piece of a log: the length of the attempt's log so far."""

    offset: int = Field(description="Number of bytes received, which is where the next piece starts.")
    capped: bool = Field(default=False, description="Whether the log is full, so that further output is dropped.")
