"""Job kinds, jobs, and their inputs and results."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import datetime
from enum import StrEnum
from typing import Any, Literal

from pydantic import Field

from marey_schemas.base import Answer, Request
from marey_schemas.datasets.naming import MAIN, DatasetName, Version
from marey_schemas.kinds import Kind
from marey_schemas.names import CollectionPath, Message, ReceivingPath
from marey_schemas.queue.commits import CommitConflict, JobCommit, OutputsCommit
from marey_schemas.queue.own_pods import GPUS_LABEL, MOST_GPUS
from marey_schemas.sizes import SEEDS


class JobState(StrEnum):
    """State of a job: waiting -> queued -> running -> succeeded, failed or cancelled; the last three never change."""

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
    """Reason why a job has failed and is not retried."""

    ERROR = "error"
    TIMEOUT = "timeout"
    ATTEMPTS_EXHAUSTED = "attempts_exhausted"
    POISON = "poison"
    DEPENDENCY_FAILED = "dependency_failed"


NOTHING_DONE = "nothing-done"
"""Code of the failure of a job that refused all of its inputs."""


def nothing_done(result: Mapping[str, Any]) -> bool:
    """Return whether a job refused inputs and produced nothing: no outputs, and no inputs that it lists as `empty`.

    In `result`, `outputs` is the number of outputs, and `empty` lists inputs that the job could use, but in which it
    found nothing.
    """
    return bool(result.get("refused")) and not result.get("outputs") and not result.get("empty")


class InputSpec(Answer):
    """Declaration of a named input of a job kind."""

    kind: Kind
    many: bool = False
    required: bool = True
    parts: tuple[str, ...] = Field(
        (), description="Parts of the items that the result of the job depends on; empty: all parts."
    )
    description: str = ""


class JobKind(Answer):
    """Inputs, parameters and outputs of a kind of job."""

    name: str
    description: str
    params_schema: dict[str, Any]
    inputs: dict[str, InputSpec]
    outputs: dict[str, Kind | Literal["file"]]
    facets: dict[str, str] = Field(
        default_factory=dict,
        description="Numbers that the job publishes about its inputs, and their meanings, by name.",
    )
    fan_out: str | None = Field(
        None,
        description="The input whose items are distributed over the tasks of a "
        "job; null: the items are not distributed.",
    )
    batch_size: int = Field(1, description="Number of items of the input `fan_out` that each task gets.")
    gathers: bool = Field(
        False,
        description="Whether the parameters determine the number of tasks, whose results a worker combines at the end.",
    )
    deterministic: bool = Field(
        True,
        description="Whether the same inputs, parameters and seed give the same bytes, so that results may be cached.",
    )


class ItemInput(Request):
    """Item as an input, at the given revision; without a revision, at the newest one when the job is submitted."""

    item: str
    revision: int | None = Field(None, ge=1)


class CollectionInput(Request):
    """All items of the input's kind in a collection and below it, at the revisions that are newest at submission."""

    collection: CollectionPath


class DatasetInput(Request):
    """All entries of the input's kind in a version of a dataset, each as a revision of an item with the same content.

    The version is resolved at submission, so that later commits do not change the inputs. Entries with the same content
    count as one input.
    """

    dataset: DatasetName
    version: Version = MAIN
    path: CollectionPath = Field("", description="Entry, or folder whose entries are taken; empty: all entries.")


class JobOutputsInput(Request):
    """Outputs of another job of the project: all items whose kind the input accepts.

    The job with this input waits for the other job, as for the jobs in `after`. The revisions of the outputs are fixed
    when the other job has succeeded.
    """

    job: str = Field(min_length=1, max_length=40)


ExistingInput = ItemInput | CollectionInput | DatasetInput
"""Input of a job that exists when the job is submitted."""

JobInput = ExistingInput | JobOutputsInput
"""Input of a job, in any of its forms."""


class Resources(Request):
    """Time and memory that one attempt to run a job may use, and graphics processors that it needs."""

    time_limit_s: int = Field(3600, ge=1, le=7 * 86400)
    memory_limit_mb: int = Field(4096, ge=64, le=1_048_576)
    gpus: int = Field(
        0,
        ge=0,
        le=MOST_GPUS,
        description=f"Number of graphics processors; the job then has the label `{GPUS_LABEL}`.",
    )
    expected_s: int | None = Field(
        None,
        ge=1,
        le=7 * 86400,
        description="Expected duration of the job in seconds; null: unknown. With the server's setting "
        "`own_pods`, a long job runs in a separate pod.",
    )


CacheMode = Literal["use", "refresh", "off"]
"""Whether the results of identical jobs are reused."""


class JobCreate(Request):
    """Request to submit a job: its kind, inputs and parameters, and how it is to run."""

    kind: str = Field(min_length=1, max_length=64)
    inputs: dict[str, JobInput | tuple[JobInput, ...]] = Field(default_factory=dict)
    params: dict[str, Any] = Field(default_factory=dict)
    into: ReceivingPath = Field("", description="The collection that receives the results.")
    priority: int = Field(0, ge=-100, le=100, description="Priority; jobs of higher priority run first.")
    after: tuple[str, ...] = Field((), max_length=1000, description="Jobs that must succeed before this one starts.")
    on_failure: Literal["fail", "skip"] = Field(
        "fail",
        description="What happens to this job if a job in `after` does not succeed. fail: it fails; skip: it is "
        "cancelled.",
    )
    concurrency_key: str | None = Field(
        None,
        max_length=255,
        description="Key of a lock: of the jobs of a project with the same key, only one runs at a time. Null: "
        "no lock.",
    )
    cache: CacheMode = Field(
        "use",
        description="use: reuse the result of an identical job; refresh: compute the result again and store it for "
        "later jobs; off: compute the result again, for this job only.",
    )
    seed: int = Field(0, ge=0, lt=SEEDS, description="Seed of all random numbers; the same seed gives the same result.")
    max_attempts: int = Field(3, ge=1, le=20)
    labels: dict[str, str] = Field(default_factory=dict, description="Labels that a worker must have to run the job.")
    resources: Resources = Resources()
    message: Message = ""
    commit: OutputsCommit | None = Field(
        None,
        description="Commit of the outputs to a branch of a dataset, made when the job succeeds; null: none is made.",
    )


LONGEST_NOTE = 500
"""Greatest number of characters of a note on progress."""


class Progress(Request):
    """Progress of an attempt to run a job: amount done, total amount, and a note."""

    done: float = Field(ge=0, allow_inf_nan=False)
    total: float | None = Field(None, gt=0, allow_inf_nan=False)
    note: str = Field("", max_length=LONGEST_NOTE)


class JobFailure(Answer):
    """Failure of a job, with a code for programs and a text for people."""

    reason: FailureReason
    code: str
    detail: str


class JobOutput(Answer):
    """Output of a job: the revision of an item that the job created, or found unchanged."""

    name: str
    item: str
    kind: Kind
    revision: int
    created: bool = Field(description="Whether a revision was created. False: the item had the same content before.")
    skeleton_changed: bool = Field(
        False, description="Whether the new revision has another skeleton than the revision before."
    )
    purged: bool = Field(
        False, description="Whether the item has been deleted for good since the job made it; if so, `name` is empty."
    )
    entry: str | None = Field(
        None, description="Path at which the job commits the output to a dataset; null if the job makes no commit."
    )


def commits_of(inputs: Mapping[str, Any]) -> set[str]:
    """Return the digests of the commits from which the inputs of a job were taken; `inputs` is `Job.inputs`."""
    found: set[str] = set()
    for recorded in inputs.values():
        if isinstance(recorded, Mapping):
            found.update(recorded.get("commits", ()))
        else:
            found.update(pin["commit"] for pin in recorded if "commit" in pin)
    return found


class Job(Answer):
    """Job with its inputs, parameters, state and result."""

    id: str
    project: str
    kind: str
    state: JobState
    params: dict[str, Any]
    inputs: dict[str, Any] = Field(
        description="Inputs by name: items with their revisions, and the commits from which the items were taken. "
        "Outputs of a job that has not ended are given as `{job}`. If the items of an input were distributed over "
        "tasks, only the number of items and their commits are given. An item that has been purged since the "
        "submission has the member `purged` and no name."
    )
    after: tuple[str, ...] = Field((), description="Jobs that must succeed before this one starts.")
    labels: dict[str, str] = Field(default_factory=dict, description="Labels that a worker must have to run the job.")
    into: str
    priority: int
    seed: int
    attempt: int
    fence: int
    max_attempts: int
    interruptions: int = 0
    parent: str | None = None
    position: int | None = Field(
        None, description="Index of the task among the tasks of its parent job, from 0; null if the job is not a task."
    )
    size: int | None = Field(
        None, description="Number of tasks into which the job is split; null: it is not split, or not yet."
    )
    children: dict[str, int] = Field(default_factory=dict, description="Number of tasks in each state.")
    retry_of: str | None = None
    cached_from: str | None = Field(
        None, description="Id of the job whose cached result this job reuses; null: it computes its result."
    )
    progress: Progress | None = None
    failure: JobFailure | None = None
    result: dict[str, Any] | None = None
    cancel_requested: bool = False
    publish_conflict: CommitConflict | None = Field(
        None,
        description="Reason why the outputs are not on the branch to which the job was to commit them; "
        "null: there is no conflict.",
    )
    commit: JobCommit | None = Field(
        None, description="Commit of the outputs; null for tasks, and if the submission requested no commit."
    )
    author: str | None
    created_at: datetime
    run_at: datetime
    started_at: datetime | None = None
    finished_at: datetime | None = None
    rev: int


class TaskResult(Answer):
    """State of one task of a job, and its result, which is null until the task has ended."""

    job: str
    position: int
    state: JobState
    result: dict[str, Any] | None


class Attempt(Answer):
    """Attempt of a worker to run a job; a job may need several attempts."""

    job: str
    fence: int
    worker: str = Field(description="Name of the worker; `a worker` for callers who are not contributors.")
    started_at: datetime
    ended_at: datetime | None
    outcome: str | None = Field(
        None,
        description="How the attempt ended: succeeded, failed, interrupted, lost, cancelled or timeout; "
        "null while it runs.",
    )
    detail: str | None = None


class JobBatch(Request):
    """Request to submit many jobs, all or none."""

    jobs: tuple[JobCreate, ...] = Field(min_length=1, max_length=1000)


class JobList(Answer):
    """Jobs of one request, in the order in which they were given."""

    jobs: tuple[Job, ...]
