"""Rows for checked submissions: one job, or a parent job with its tasks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from sqlalchemy import Row

from marey_schemas.queue.job_kinds import KindDeclaration
from marey_schemas.queue.jobs import JobCreate, Resources, commits_of
from marey_schemas.sizes import batched
from marey_server.store.ids import new_id
from marey_server.store.jobs import result_cache
from marey_server.store.jobs.commits import Target
from marey_server.store.jobs.endings import Ended
from marey_server.store.jobs.inputs import NamingJob, PinnedInputs, items_by_id
from marey_server.store.transaction import Transaction


@dataclass(frozen=True)
class Submission:
    """Checked submission of one job."""

    kind: KindDeclaration
    request: JobCreate
    params: Mapping[str, Any]
    pins: PinnedInputs
    task_count: int
    labels_key: str
    author_id: str | None
    after: tuple[str, ...] = ()
    """Ids of the jobs that must succeed first, including those that produce its inputs."""
    unbound: bool = False
    """Whether some inputs are outputs of jobs that have not succeeded yet."""
    id: str = field(default_factory=lambda: new_id("job"))
    retry_of: str | None = None
    commit_to: Target | None = None


@dataclass
class NewJob:
    """Job that is about to be inserted."""

    id: str
    project_id: str
    submission: Submission
    pins: Mapping[str, Any]
    state: str = "queued"
    dependencies_left: int = 0
    failure: dict[str, Any] | None = None
    parent_id: str | None = None
    position: int | None = None
    size: int | None = None
    gathers: bool = False
    cache_key: str | None = None

    @property
    def cache_mode(self) -> str:
        """The setting of the request that says whether a cached result may be used."""
        return self.submission.request.cache

    @property
    def labels_key(self) -> str:
        """The labels that a worker must have."""
        return self.submission.labels_key

    @property
    def priority(self) -> int:
        """The priority of the job in the queue."""
        return self.submission.request.priority

    @property
    def concurrency_key(self) -> str | None:
        """The key of the request; jobs with the same key run one after the other."""
        return self.submission.request.concurrency_key

    @property
    def unbound(self) -> bool:
        """Whether some inputs are outputs of jobs that have not succeeded yet."""
        return self.submission.unbound

    def end(self) -> Ended:
        """Return the end of a job that never starts because a dependency did not succeed."""
        return Ended(self.id, self.project_id, self.state, self.parent_id, self.failure)


def request_of(row: Row[Any]) -> JobCreate:
    """Return the request with which a job was submitted, without inputs, labels and dependencies."""
    return JobCreate(
        kind=row.kind,
        params=row.params,
        into=row.into_path,
        priority=row.priority,
        on_failure=row.on_failure,
        concurrency_key=row.concurrency_key,
        cache=row.cache_mode,
        seed=row.seed,
        max_attempts=row.max_attempts,
        resources=Resources(time_limit_s=row.time_limit_s, memory_limit_mb=row.memory_limit_mb),
        message=row.message,
    )


def lay_out(tx: Transaction, heads: Sequence[NewJob]) -> tuple[list[NewJob], dict[str, result_cache.SharedResult]]:
    """Split jobs with known inputs into tasks, and give them their cache keys.

    Returns the tasks, and a mapping from the ids of jobs that share a result to the jobs that have computed, or are
    computing, this result.
    """
    gathering = [one for one in heads if one.submission.kind.gathering is not None]
    sources = _find_results(tx, gathering)
    tasks = [task for one in heads if one.id not in sources for task in _spread(one)]
    single = [one for one in (*heads, *tasks) if one.size is None and one.cache_key is None]
    return tasks, sources | _find_results(tx, single)


def _find_results(tx: Transaction, jobs: Sequence[NewJob]) -> dict[str, result_cache.SharedResult]:
    """Set the cache keys of jobs, and find other jobs that have computed, or are computing, the same results.

    Each job for which another job is found changes to the state `waiting`.
    """
    _set_cache_keys(tx, jobs)
    sources = result_cache.decide(tx, [one for one in jobs if one.state == "queued"])
    for one in jobs:
        if one.id in sources:
            one.state = "waiting"
    return sources


def _spread(head: NewJob) -> list[NewJob]:
    """Make a job with several tasks a parent job, and return its tasks, which start together with it.

    A job with one task is unchanged, and the result is empty.
    """
    shares = _shares(head.submission)
    if len(shares) < 2:
        return []
    kind = head.submission.kind
    head.size, head.gathers = len(shares), kind.gathering is not None
    if kind.fan_out is not None:
        given = head.pins[kind.fan_out]
        commits = sorted(commits_of({kind.fan_out: given}))
        head.pins = {**head.pins, kind.fan_out: {"count": len(given), **({"commits": commits} if commits else {})}}
    if head.state == "queued":
        head.state, head.dependencies_left = "running", len(shares)
    state = {"running": "queued", "failed": "cancelled"}.get(head.state, head.state)
    return [
        NewJob(new_id("job"), head.project_id, head.submission, pins, state, parent_id=head.id, position=position)
        for position, pins in enumerate(shares)
    ]


def _shares(submission: Submission) -> list[PinnedInputs]:
    """Return the inputs of each task: a share of the input that is split, or all inputs if none is split."""
    fanned = submission.kind.fan_out
    if fanned is None:
        return [submission.pins] * submission.task_count
    pins, size = submission.pins.get(fanned, []), submission.kind.batch_size
    return [{**submission.pins, fanned: some} for some in batched(pins, size)]


def _set_cache_keys(tx: Transaction, jobs: Sequence[NewJob]) -> None:
    cached = [one for one in jobs if one.cache_mode != "off" and _has_key(one.submission)]
    parts = result_cache.part_digests(tx, {id(one.submission): one.submission.pins for one in cached}.values())
    newest = _newest_revisions(tx, cached)
    for one in cached:
        submission = one.submission
        contents = result_cache.input_contents(submission.kind, one.pins, parts)
        task = None if one.parent_id is None or submission.kind.fan_out else (one.position, submission.task_count)
        one.cache_key = result_cache.cache_key(
            submission.kind,
            submission.params,
            submission.request.seed,
            contents,
            task,
            into=submission.request.into,
            newest=newest,
        )


def _has_key(submission: Submission) -> bool:
    given = [name for name, pins in submission.pins.items() if pins]
    return result_cache.has_key(submission.kind, submission.params, given)


def _newest_revisions(tx: Transaction, jobs: Sequence[NewJob]) -> dict[str, int]:
    """Return, by item id, the number of the newest revision of each item that parameters of jobs name.

    Items that are not in the project are omitted.
    """
    wanted: dict[str, set[str]] = {}
    for one in jobs:
        named = result_cache.named_items(one.submission.kind, one.submission.params)
        wanted.setdefault(one.project_id, set()).update(named)
    found = (items_by_id(tx, project_id, ids) for project_id, ids in wanted.items())
    return {item: one.head for items in found for item, one in items.items()}


def new_row(tx: Transaction, one: NewJob) -> dict[str, Any]:
    """Return the row to insert for a new job."""
    submission, request = one.submission, one.submission.request
    return {
        "id": one.id,
        "project_id": one.project_id,
        "kind": submission.kind.name,
        "params": submission.params,
        "into_path": request.into,
        "priority": request.priority,
        "seed": request.seed,
        "labels_key": submission.labels_key,
        "time_limit_s": request.resources.time_limit_s,
        "memory_limit_mb": request.resources.memory_limit_mb,
        "max_attempts": request.max_attempts,
        "run_at_us": tx.now_us,
        "failure": one.failure,
        "parent_id": one.parent_id,
        "position": one.position,
        "on_failure": request.on_failure,
        "cache_mode": request.cache,
        "retry_of": submission.retry_of if one.parent_id is None else None,
        "author_id": submission.author_id,
        "message": request.message,
        "created_us": tx.now_us,
        "finished_us": tx.now_us if one.state in ("failed", "cancelled") else None,
        **layout_columns(tx, one),
    }


def layout_columns(tx: Transaction, one: NewJob) -> dict[str, Any]:
    """Return the columns of a job's row that depend on the inputs of the job."""
    return {
        "state": one.state,
        "inputs": one.pins,
        "commit_to": one.submission.commit_to,
        "unbound": one.unbound,
        "size": one.size,
        "gathers": one.gathers,
        "dependencies_left": one.dependencies_left,
        "concurrency_key": None if one.size is not None else one.submission.request.concurrency_key,
        "cache_key": one.cache_key,
        "started_us": tx.now_us if one.state == "running" else None,
    }


def naming(one: NewJob) -> NamingJob:
    """Return a new job as a `NamingJob`, with the inputs and parameters that may name items."""
    return NamingJob(one.id, one.pins, {} if one.parent_id is not None else one.submission.params)
