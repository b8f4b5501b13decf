"""Rows for checked submissions: one job, or a parent job with its tasks; and the cache keys of jobs.

Jobs with the same cache key are identical: kind, version of the kind, parameters, seed and inputs are equal. Inputs are
equal if four things are equal: the item, its name, its path, and the content of the documents that the kind reads. The
item, its name and its path count, because results refer to inputs and are named after them. A kind can require that
further values are equal: the collection of the results, or the newest revision of an item that the parameters name.
Jobs whose result depends on data that is read while they run have no cache key.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from sqlalchemy import Row, select

from marey_schemas.encoding.canonical import canonical_json
from marey_schemas.encoding.digests import digest_of
from marey_schemas.queue.jobs import JobCreate, Resources, commits_of
from marey_schemas.queue.kind_declaration import KindDeclaration
from marey_schemas.sizes import batched
from marey_schemas.tracing.context import HEADER
from marey_server.store.ids import new_id
from marey_server.store.jobs import result_cache
from marey_server.store.jobs.commits import Target
from marey_server.store.jobs.endings import Ended
from marey_server.store.jobs.inputs import NamingJob, Pin, PinnedInputs, items_by_id
from marey_server.store.tables import revision_part
from marey_server.store.transaction import Transaction, in_lists


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
    """Ids of the jobs that must succeed before this job runs, including those that produce its inputs."""
    unbound: bool = False
    """Whether some inputs are outputs of jobs that have not succeeded yet."""
    id: str = field(default_factory=lambda: new_id("job"))
    retry_of: str | None = None
    commit_to: Target | None = None


@dataclass
class NewJob:
    """Job whose row is about to be written: a single job, a parent job (`size` tasks) or a task (`position`).

    The row is inserted; only for a job that has waited for late inputs, the existing row is updated.
    """

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
        """Setting of the request: use a cached result ("use"), replace it ("refresh"), or use no cache ("off")."""
        return self.submission.request.cache

    @property
    def labels_key(self) -> str:
        """Labels that a worker must have, as one sorted text."""
        return self.submission.labels_key

    @property
    def priority(self) -> int:
        """The priority of the job in the queue."""
        return self.submission.request.priority

    @property
    def concurrency_key(self) -> str | None:
        """Concurrency key of the request, or None. Only one job of a project with the same key runs at a time."""
        return self.submission.request.concurrency_key

    @property
    def unbound(self) -> bool:
        """Whether some inputs are outputs of jobs that have not succeeded yet."""
        return self.submission.unbound

    def as_ended(self) -> Ended:
        """Return this job as an ended job, for a job that never starts because one of its dependencies failed."""
        return Ended(self.id, self.project_id, self.state, self.parent_id, self.failure)


def request_of(row: Row[Any]) -> JobCreate:
    """Return the request with which a job was submitted, without inputs, labels, dependencies and `commit`."""
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
    """Split jobs with known inputs into tasks, and set the cache keys of the jobs and tasks.

    Returns two values: the tasks, and the results that are shared. The second value maps the id of a job or task to the
    job that has computed its result, or is computing it.
    """
    gathering = [one for one in heads if one.submission.kind.gathering is not None]
    sources = _let_share(tx, gathering)
    tasks = [task for one in heads if one.id not in sources for task in _spread(one)]
    single = [one for one in (*heads, *tasks) if one.size is None and one.cache_key is None]
    return tasks, sources | _let_share(tx, single)


def _let_share(tx: Transaction, jobs: Sequence[NewJob]) -> dict[str, result_cache.SharedResult]:
    """Set the cache keys of jobs; jobs whose results other jobs have computed or are computing become waiting jobs.

    Returns, by the id of each waiting job, the job whose result it will share.
    """
    _set_cache_keys(tx, jobs)
    sources = result_cache.decide(tx, [one for one in jobs if one.state == "queued"])
    for one in jobs:
        if one.id in sources:
            one.state = "waiting"
    return sources


def count_tasks(submission: Submission) -> int:
    """Return the number of tasks into which a job is split; 0 for a job that is not split."""
    count = len(_shares(submission))
    return count if count > 1 else 0


def count_inputs(submission: Submission) -> int:
    """Return the number of inputs that the rows of a job and of its tasks contain."""
    tasks = 0 if submission.unbound else count_tasks(submission)
    count = sum(map(len, submission.pins.values()))
    split = len(submission.pins.get(submission.kind.fan_out or "", ())) if tasks else 0
    return split + (count - split) * (tasks + 1)


def _spread(head: NewJob) -> list[NewJob]:
    """Split a job into tasks, which makes it a parent job, and return the tasks.

    The tasks are queued if the job was queued, wait if it waits, and are cancelled if it has failed. A job without
    tasks (`count_tasks`) is unchanged, and the result is empty.
    """
    if not count_tasks(head.submission):
        return []
    shares = _shares(head.submission)
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
    """Return the inputs of each task.

    If the job kind splits an input, each task gets a share of this input, and the whole of every other input.
    Otherwise, each task gets all inputs.
    """
    fanned = submission.kind.fan_out
    if fanned is None:
        return [submission.pins] * submission.task_count
    pins, size = submission.pins.get(fanned, []), submission.kind.batch_size
    return [{**submission.pins, fanned: some} for some in batched(pins, size)]


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
        "environment": place_in_trace(tx),
        "created_us": tx.now_us,
        "finished_us": tx.now_us if one.state in ("failed", "cancelled") else None,
        **layout_columns(tx, one),
    }


def place_in_trace(tx: Transaction) -> dict[str, str] | None:
    """Return the initial value of the column `environment` of a job: its trace header, or None without a trace."""
    header = tx.trace_of_jobs(tx.principal)
    return None if header is None else {HEADER: header}


def trace_header(environment: Mapping[str, str] | None) -> str | None:
    """Return the trace header in the column `environment` of a job that has not ended, or None."""
    return (environment or {}).get(HEADER)


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


# -- cache keys -------------------------------------------------------------------------------------------------------


def _set_cache_keys(tx: Transaction, jobs: Sequence[NewJob]) -> None:
    cached = [one for one in jobs if one.cache_mode != "off" and _has_key(one.submission)]
    parts = _part_digests(tx, {id(one.submission): one.submission.pins for one in cached}.values())
    newest = _newest_revisions(tx, cached)
    for one in cached:
        one.cache_key = _cache_key(one, parts, newest)


def _has_key(submission: Submission) -> bool:
    """Return whether a job gets a cache key.

    It does if its result depends only on the values from which the key is computed.
    """
    kind, params = submission.kind, submission.params
    given = {name for name, pins in submission.pins.items() if pins}
    in_place = kind.in_place is not None and params.get(kind.in_place)
    by_names = not set(kind.never_cached_without) <= given
    if kind.never_cached_for is not None:
        by_names = by_names or kind.never_cached_for(params)
    return kind.deterministic and not in_place and not by_names


def _cache_key(one: NewJob, parts: Mapping[tuple[str, int], dict[str, str]], newest: Mapping[str, int]) -> str:
    """Return the digest that is equal for all jobs that must compute the same result.

    `parts` is the result of `_part_digests`; `newest` is the result of `_newest_revisions`.
    """
    submission, kind, params = one.submission, one.submission.kind, one.submission.params
    inputs = _input_contents(kind, one.pins, parts)
    tree: dict[str, Any] = {
        "kind": kind.code_version,
        "params": params,
        "seed": submission.request.seed,
        "inputs": inputs,
    }
    if one.parent_id is not None and kind.fan_out is None:
        tree["task"] = (one.position, submission.task_count)
    if kind.place_counts:
        tree["into"] = submission.request.into
    if kind.newest_of:
        tree["newest"] = [[item, newest.get(item)] for item in _named_items(kind, params)]
    return digest_of(canonical_json(tree))


def _newest_revisions(tx: Transaction, jobs: Sequence[NewJob]) -> dict[str, int]:
    """Return, by item id, the number of the newest revision of each item that parameters of jobs name.

    Items that are not in the project are omitted.
    """
    wanted: dict[str, set[str]] = {}
    for one in jobs:
        named = _named_items(one.submission.kind, one.submission.params)
        wanted.setdefault(one.project_id, set()).update(named)
    found = (items_by_id(tx, project_id, ids) for project_id, ids in wanted.items())
    return {item: one.head for items in found for item, one in items.items()}


def _named_items(kind: KindDeclaration, params: Mapping[str, Any]) -> list[str]:
    """Return the ids of the items that parameters of a job name and whose newest revisions the job reads.

    The kind of the job declares these parameters (`newest_of`).
    """
    return [params[name] for name in kind.newest_of if params.get(name)]


def _part_digests(tx: Transaction, inputs: Iterable[PinnedInputs]) -> dict[tuple[str, int], dict[str, str]]:
    """Return the digests of the parts of all pinned inputs: by item and revision number, then by name of the part."""
    items = sorted({pin["item"] for pins in inputs for many in pins.values() for pin in many})
    found: dict[tuple[str, int], dict[str, str]] = {}
    for some in in_lists(items):
        statement = select(revision_part).where(revision_part.c.item_id.in_(some))
        for row in tx.execute(statement):
            found.setdefault((row.item_id, row.number), {})[row.part] = row.document_digest
    return found


def _input_contents(
    kind: KindDeclaration, pins: Mapping[str, Any], parts: Mapping[tuple[str, int], dict[str, str]]
) -> dict[str, Any]:
    """Return what the cache key contains of a job's inputs, by name; revision numbers have no influence."""
    return {
        name: [_content(pin, kind.inputs[name].parts, parts[pin["item"], pin["revision"]]) for pin in many]
        for name, many in pins.items()
    }


def _content(pin: Pin, read: Collection[str], parts: Mapping[str, str]) -> list[Any]:
    place = [pin["collection"], *([pin["below"]] if "below" in pin else ())]
    return [pin["item"], *place, pin["name"], sorted(item for item in parts.items() if not read or item[0] in read)]
