"""How jobs come to be: checked, pinned, split, and put where they belong, many in one transaction."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from pydantic import ValidationError
from sqlalchemy import insert, select

from marey_schemas.access import Role
from marey_schemas.job_kinds import MOST_TASKS, KindDeclaration, UnknownKindError, find_kind
from marey_schemas.jobs import Job, JobCreate, JobState
from marey_schemas.problems import FieldError
from marey_server import faults
from marey_server.errors import Invalid
from marey_server.store import job_cache, staging
from marey_server.store.ids import new_id
from marey_server.store.job_documents import job_documents
from marey_server.store.job_ends import Ended, dependency_failure
from marey_server.store.job_events import emit_job_events, wake_workers
from marey_server.store.job_inputs import FoundItem, PinnedInputs, find_items, pin_inputs
from marey_server.store.labels import labels_key
from marey_server.store.projects import ProjectRow, require
from marey_server.store.settling import settle
from marey_server.store.tables import job, job_dependency
from marey_server.store.transaction import Transaction

IN_LIST = 1000


@dataclass(frozen=True)
class Submission:
    """A job that was checked, before it has a row."""

    kind: KindDeclaration
    request: JobCreate
    params: Mapping[str, Any]
    pins: PinnedInputs
    task_count: int
    labels_key: str
    retry_of: str | None = None
    pointer: str = ""


@dataclass
class _NewJob:
    """A row to be."""

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
        """Whether a result that is there may serve."""
        return self.submission.request.cache

    def end(self) -> Ended:
        """The end of a job that ends before it begins, because one it needs did not succeed."""
        return Ended(self.id, self.project_id, self.state, self.parent_id, self.failure)


def submit(tx: Transaction, project: str, requests: Sequence[JobCreate]) -> list[Job]:
    """Submit jobs to a project, all or none; the answer is in the order asked.

    Raises `Invalid` with a pointer for each thing that makes no sense, and what `require` raises.
    """
    row = require(tx, project, Role.CONTRIBUTOR, "jobs")
    many = len(requests) > 1
    known = find_items(tx, row, requests)
    checked = [_check(tx, row, one, known, f"/jobs/{index}" if many else "") for index, one in enumerate(requests)]
    return submit_checked(tx, row, checked)


def submit_checked(tx: Transaction, project: ProjectRow, submissions: Sequence[Submission]) -> list[Job]:
    """Write the rows of checked jobs and let each go as far as it can."""
    upstream = _lock_upstream(tx, project, submissions)
    heads = [_head(project, one, upstream) for one in submissions]
    gathering = [one for one in heads if one.submission.kind.gathering is not None]
    sources = _find_results(tx, gathering)
    tasks = [task for one in heads if one.id not in sources for task in _spread(one)]
    everything = [*heads, *tasks]
    sources |= _find_results(tx, [one for one in everything if one.size is None and one.cache_key is None])
    ready = [one for one in everything if one.state == "queued" or one.id in sources]
    for start in range(0, len(everything), IN_LIST):
        tx.execute(insert(job), [_row(tx, one) for one in everything[start : start + IN_LIST]])
    _insert_dependencies(tx, heads, upstream)
    for one in heads:
        staging.keep_named_blobs(tx, one.id, set(staging.named_blobs(one.submission.params)))
    events = [(one.project_id, one.id, {"kind": one.submission.kind.name}) for one in heads]
    emit_job_events(tx, "job.submitted", events)
    wake_workers(tx, {one.submission.kind.name for one in ready if one.state == "queued"})
    ended = [one.end() for one in everything if one.state in ("failed", "cancelled")]
    ended += job_cache.join(tx, [(one, sources[one.id]) for one in ready if one.id in sources])
    settle(tx, ended)
    faults.point("submit.before_commit")
    tx.after_commit(lambda: faults.point("submit.after_commit"))
    return job_documents(tx, [one.id for one in heads])


# -- checking ---------------------------------------------------------------------------------------------------------


def _check(
    tx: Transaction, project: ProjectRow, request: JobCreate, known: dict[str, FoundItem], at: str
) -> Submission:
    try:
        kind = find_kind(request.kind)
    except UnknownKindError as error:
        raise _invalid(f"{at}/kind", "unknown-kind", f"{error}.") from error
    try:
        params = kind.params.model_validate(request.params)
    except ValidationError as error:
        found = [
            FieldError(pointer=f"{at}/params/" + "/".join(map(str, one["loc"])), code=one["type"], detail=one["msg"])
            for one in error.errors(include_url=False, include_context=False, include_input=False)[:100]
        ]
        detail = f"These are no parameters of {kind.name}: {found[0].pointer}: {found[0].detail}"
        raise Invalid(detail, errors=found) from error
    pins = pin_inputs(tx, project, kind, request, known, at)
    tasks, plain = _count_tasks(kind, params, at), params.model_dump(mode="json")
    return Submission(kind, request, plain, pins, tasks, labels_key(request.labels), pointer=at)


def _count_tasks(kind: KindDeclaration, params: Any, at: str) -> int:
    count = 1 if kind.task_count is None else kind.task_count(params)
    if not 1 <= count <= MOST_TASKS:
        detail = f"These parameters make {count} tasks; {kind.name} takes 1 to {MOST_TASKS}."
        raise _invalid(f"{at}/params", "too-many-tasks", detail)
    return count


def _invalid(pointer: str, code: str, detail: str) -> Invalid:
    return Invalid(detail, errors=[FieldError(pointer=pointer, code=code, detail=detail)])


def _lock_upstream(tx: Transaction, project: ProjectRow, submissions: Sequence[Submission]) -> dict[str, str]:
    """State by id of every job that is waited for, locked so that none ends before the waiting is written down.

    Only jobs that exist can be waited for, so that none can wait for itself.
    """
    wanted = sorted({one for submission in submissions for one in submission.request.after})
    states: dict[str, str] = {}
    for start in range(0, len(wanted), IN_LIST):
        statement = (
            select(job.c.id, job.c.state)
            .where(job.c.id.in_(wanted[start : start + IN_LIST]), job.c.project_id == project.id)
            .order_by(job.c.id)
            .with_for_update(read=True)
        )
        states |= {row.id: row.state for row in tx.execute(statement)}
    for submission in submissions:
        for index, one in enumerate(submission.request.after):
            if one not in states:
                place = f"{submission.pointer}/after/{index}"
                raise _invalid(place, "unknown-job", f"There is no job {one!r} in the project.")
    return states


# -- rows -------------------------------------------------------------------------------------------------------------


def _head(project: ProjectRow, submission: Submission, upstream: Mapping[str, str]) -> _NewJob:
    head = _NewJob(new_id("job"), project.id, submission, submission.pins)
    _set_state(head, upstream)
    return head


def _find_results(tx: Transaction, jobs: Sequence[_NewJob]) -> dict[str, job_cache.Source]:
    """Give jobs their cache keys; those whose result is there or under way wait for it instead of being queued."""
    _set_cache_keys(tx, jobs)
    sources = job_cache.decide(tx, [one for one in jobs if one.state == "queued"])
    for one in jobs:
        if one.id in sources:
            one.state = "waiting"
    return sources


def _set_state(head: _NewJob, upstream: Mapping[str, str]) -> None:
    request = head.submission.request
    after = {one: JobState(upstream[one]) for one in request.after}
    unfinished = [one for one, state in after.items() if not state.terminal]
    missed = [one for one, state in after.items() if state.terminal and state != JobState.SUCCEEDED]
    if missed and request.on_failure == "skip":
        head.state = "cancelled"
    elif missed:
        head.state = "failed"
        head.failure = dependency_failure(missed[0], after[missed[0]])
    elif unfinished:
        head.state, head.dependencies_left = "waiting", len(unfinished)


def _spread(head: _NewJob) -> list[_NewJob]:
    """The tasks of a job that has several, which makes it a gathering job; they start when it does."""
    shares = _shares(head.submission)
    if len(shares) < 2:
        return []
    kind = head.submission.kind
    head.size, head.gathers = len(shares), kind.gathering is not None
    if kind.fan_out is not None:
        head.pins = {**head.pins, kind.fan_out: {"count": len(head.pins[kind.fan_out])}}
    if head.state == "queued":
        head.state, head.dependencies_left = "running", len(shares)
    state = {"running": "queued", "failed": "cancelled"}.get(head.state, head.state)
    return [
        _NewJob(new_id("job"), head.project_id, head.submission, pins, state, parent_id=head.id, position=position)
        for position, pins in enumerate(shares)
    ]


def _shares(submission: Submission) -> list[PinnedInputs]:
    """The inputs of each task: some items of the input that is spread, or everything where tasks are counted."""
    fanned = submission.kind.fan_out
    if fanned is None:
        return [submission.pins] * submission.task_count
    pins, size = submission.pins.get(fanned, []), submission.kind.batch_size
    return [{**submission.pins, fanned: pins[start : start + size]} for start in range(0, len(pins), size)]


def _set_cache_keys(tx: Transaction, jobs: Sequence[_NewJob]) -> None:
    cached = [one for one in jobs if one.submission.kind.deterministic and one.cache_mode != "off"]
    parts = job_cache.part_digests(tx, {id(one.submission): one.submission.pins for one in cached}.values())
    for one in cached:
        submission = one.submission
        contents = job_cache.input_contents(one.pins, parts)
        task = None if one.parent_id is None or submission.kind.fan_out else (one.position, submission.task_count)
        one.cache_key = job_cache.cache_key(submission.kind, submission.params, submission.request.seed, contents, task)


def _row(tx: Transaction, one: _NewJob) -> dict[str, Any]:
    submission, request = one.submission, one.submission.request
    return {
        "id": one.id,
        "project_id": one.project_id,
        "kind": submission.kind.name,
        "state": one.state,
        "params": submission.params,
        "inputs": one.pins,
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
        "size": one.size,
        "gathers": one.gathers,
        "dependencies_left": one.dependencies_left,
        "on_failure": request.on_failure,
        "concurrency_key": None if one.size is not None else request.concurrency_key,
        "cache_mode": request.cache,
        "cache_key": one.cache_key,
        "retry_of": submission.retry_of if one.parent_id is None else None,
        "author_id": tx.principal.user_id,
        "message": request.message,
        "created_us": tx.now_us,
        "started_us": tx.now_us if one.state == "running" else None,
        "finished_us": tx.now_us if one.state in ("failed", "cancelled") else None,
    }


def _insert_dependencies(tx: Transaction, heads: Sequence[_NewJob], upstream: Mapping[str, str]) -> None:
    rows = [
        {"job_id": one.id, "on_job_id": other, "satisfied": JobState(upstream[other]).terminal}
        for one in heads
        for other in dict.fromkeys(one.submission.request.after)
    ]
    for start in range(0, len(rows), IN_LIST):
        tx.execute(insert(job_dependency), rows[start : start + IN_LIST])
