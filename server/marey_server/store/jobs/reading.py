"""Reading, listing and cancelling of jobs by users."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from pydantic import ValidationError
from sqlalchemy import ColumnElement, Row, Select, and_, case, func, select, update

from marey_schemas.access import Role
from marey_schemas.documents.reports import StoredFile
from marey_schemas.items import EventFeed, Page
from marey_schemas.queue.jobs import Attempt, Job, JobOutput, JobState, TaskResult
from marey_server.access import roles
from marey_server.errors import ConflictProblem, ForbiddenProblem, NotFoundProblem
from marey_server.store import events, listing, projects
from marey_server.store.database.clock import datetime_of
from marey_server.store.jobs.documents import as_documents, job_documents, select_jobs
from marey_server.store.jobs.endings import ENDED_COLUMNS, as_ended
from marey_server.store.jobs.events import emit_job_events
from marey_server.store.jobs.fencing import RUNNING, earlier
from marey_server.store.jobs.logs import MOST_READ_BYTES, LogPage, read_log
from marey_server.store.jobs.policy import DEFAULT_POLICY, QueuePolicy
from marey_server.store.jobs.propagation import propagate_ends
from marey_server.store.projects import ProjectRow
from marey_server.store.purge_lock import hold_off_purges
from marey_server.store.tables import NOT_SUCCEEDED, attempt, job, user
from marey_server.store.transaction import Transaction

SORT_KEYS: dict[str, ColumnElement[Any]] = {
    "id": job.c.id,
    "created_at": job.c.created_us,
    "priority": job.c.priority,
}

UNNAMED_WORKER = "a worker"
"""Text shown instead of a worker's name, which is often the name of its host, to callers who may not know it."""

UNFINISHED = tuple(state.value for state in JobState if not state.terminal)


@dataclass(frozen=True, slots=True)
class JobFilters:
    """Filters of a list of jobs; empty filters match every job."""

    states: tuple[JobState, ...] = ()
    kinds: tuple[str, ...] = ()
    parent: str | None = None
    """Id of the parent job whose tasks are listed; without it, tasks are omitted."""
    author: str | None = None


# -- reading -----------------------------------------------------------------------------------------------------------


def read_job(tx: Transaction, job_id: str) -> Job:
    """Return a job with its state and progress. Raises `NotFoundProblem` if it does not exist."""
    row, _ = find_job(tx, job_id)
    return as_documents(tx, [row])[0]


def list_jobs(
    tx: Transaction,
    project: str,
    filters: JobFilters = JobFilters(),
    *,
    sort: str = "-created_at",
    cursor: str | None = None,
    limit: int = listing.DEFAULT_LIMIT,
    count: bool = False,
) -> Page:
    """Return one page of a project's jobs; tasks are included only if the filters name their parent job."""
    project_row = projects.require(tx, project)
    order = listing.parse_order(sort, SORT_KEYS)
    identity = [project_row.id, asdict(filters)]
    conditions = _conditions(project_row.id, filters)
    total = None
    if count:
        total = tx.execute(select(func.count()).select_from(job).where(*conditions)).scalar_one()
    parts = _parts(project_row.id, filters, order)
    rows, next_cursor = listing.read_page(tx, select_jobs(), order, identity, cursor, limit, parts)
    return Page(items=tuple(as_documents(tx, rows)), next_cursor=next_cursor, count=total)


def read_result_file(tx: Transaction, project: str, job_id: str, name: str) -> tuple[StoredFile, Job]:
    """Return the reference to a file of a job's result, and the job.

    `name` is the member of the result that names the file. Raises `NotFoundProblem` if the project has no such job, or
    if the result has no such file.
    """
    row, project_row = find_job(tx, job_id)
    found = as_documents(tx, [row])[0]
    entry = found.result or {}
    if project_row.name == project:
        try:
            return StoredFile.model_validate(entry.get(name)), found
        except ValidationError:
            names = sorted(other for other, value in entry.items() if isinstance(value, dict) and "blob" in value)
            files = ", ".join(names)  # sorted, because Postgres stores no order of members
            raise NotFoundProblem(
                f"The result of the job has no file {name!r}; it has {files or 'none'}.", code="no-file"
            ) from None
    raise NotFoundProblem(f"There is no job {job_id!r} in this project that you may see.", code="no-job")


def list_attempts(tx: Transaction, job_id: str) -> Page:
    """Return the attempts of a job in the order of their start; only contributors see the names of workers."""
    _, project = find_job(tx, job_id)
    named = roles.includes(project.role, Role.CONTRIBUTOR)
    rows = tx.execute(select(attempt).where(attempt.c.job_id == job_id).order_by(attempt.c.fence))
    return Page(items=tuple(_attempt_document(row, named=named) for row in rows))


def _attempt_document(row: Row[Any], *, named: bool) -> Attempt:
    return Attempt(
        job=row.job_id,
        fence=row.fence,
        worker=row.worker if named else UNNAMED_WORKER,
        started_at=datetime_of(row.started_us),
        ended_at=None if row.ended_us is None else datetime_of(row.ended_us),
        outcome=row.outcome,
        detail=row.detail,
    )


def list_outputs(tx: Transaction, job_id: str, cursor: str | None = None, limit: int = listing.MAX_LIMIT) -> Page:
    """Return all outputs of a job, or, for a parent job, a page of the outputs of its tasks in the order of the tasks.

    `cursor` and `limit` count tasks, not outputs. If a worker combines the results of the tasks, the outputs are those
    of the parent job itself, without pages.
    """
    row, _ = find_job(tx, job_id)
    if row.size is None or row.gathers:
        return Page(items=tuple(JobOutput(**output) for output in row.outputs or ()))
    order = listing.parse_order("position", {"position": job.c.position, "id": job.c.id})
    statement = select(job.c.id, job.c.position, job.c.outputs).where(job.c.parent_id == job_id)
    tasks, next_cursor = listing.read_page(tx, statement, order, job_id, cursor, limit)
    outputs = tuple(JobOutput(**output) for task in tasks for output in task.outputs or ())
    return Page(items=outputs, next_cursor=next_cursor)


def list_results(tx: Transaction, job_id: str, cursor: str | None = None, limit: int = listing.MAX_LIMIT) -> Page:
    """Return the results of the tasks of a parent job in the order of the tasks; empty for other jobs."""
    find_job(tx, job_id)
    order = listing.parse_order("position", {"position": job.c.position, "id": job.c.id})
    statement = select(job.c.id, job.c.position, job.c.state, job.c.result).where(job.c.parent_id == job_id)
    tasks, next_cursor = listing.read_page(tx, statement, order, job_id, cursor, limit)
    results = (TaskResult(job=row.id, position=row.position, state=row.state, result=row.result) for row in tasks)
    return Page(items=tuple(results), next_cursor=next_cursor)


def list_job_events(tx: Transaction, job_id: str, after: int = 0, limit: int = 100) -> EventFeed:
    """Return the events of a job, for members of its project."""
    _, project = find_job(tx, job_id)
    page = events.list_events(tx, project.name, after=after, limit=limit, subject=job_id)
    return EventFeed(items=tuple(page.items), more=not page.complete)


def read_job_log(tx: Transaction, job_id: str, offset: int = 0, limit: int = MOST_READ_BYTES) -> LogPage:
    """Return a page of a job's log, for members of its project."""
    row, _ = find_job(tx, job_id)
    return read_log(tx, row, offset, limit)


def _conditions(project_id: str, filters: JobFilters) -> list[ColumnElement[bool]]:
    conditions = [job.c.project_id == project_id]
    if filters.parent is None:
        conditions.append(job.c.parent_id.is_(None))
    else:
        conditions.append(job.c.parent_id == filters.parent)
    if filters.states:
        conditions.append(job.c.state.in_(filters.states))
    if filters.kinds:
        conditions.append(job.c.kind.in_(filters.kinds))
    if filters.author is not None:
        conditions.append(job.c.author_id == select(user.c.id).where(user.c.name == filters.author).scalar_subquery())
    return conditions


MOST_PARTS = 100
"""Greatest number of pairs of a state and a kind for which the jobs are looked up one after another."""


def _parts(project_id: str, filters: JobFilters, order: listing.Order) -> list[Select[*tuple[Any, ...]]]:
    """Return queries for the ids of the jobs in a list; together, they select all jobs of the list.

    If possible, there is one query for each pair of a state and a kind: an index contains the jobs of each pair in the
    order of the list. Without these queries, a list of few jobs, such as waiting jobs, would read all jobs of the
    project. There is no index of succeeded jobs by state, because most jobs have succeeded.
    """
    pairs = [(state, kind) for state in filters.states or (None,) for kind in filters.kinds or (None,)]
    if filters.parent is not None or order.columns[0][0] is not SORT_KEYS["created_at"] or len(pairs) > MOST_PARTS:
        return [select(job.c.id).where(*_conditions(project_id, filters))]
    parts = []
    for state, kind in dict.fromkeys(pairs):
        one = JobFilters(() if state is None else (state,), () if kind is None else (kind,), author=filters.author)
        part = select(job.c.id).where(*_conditions(project_id, one))
        is_rare = state in UNFINISHED or not (kind or filters.author)
        by_state = state not in (None, JobState.SUCCEEDED) and is_rare
        parts.append(part.where(NOT_SUCCEEDED) if by_state else part)
    return parts


# -- cancelling --------------------------------------------------------------------------------------------------------


def cancel_job(tx: Transaction, job_id: str, policy: QueuePolicy = DEFAULT_POLICY) -> Job:
    """Cancel a job: at once if it is not running, else when its worker stops or a grace period ends.

    A parent job is cancelled with its tasks. A repeated cancellation has no effect. Raises `ConflictProblem` for a
    job that has succeeded or failed, and `ForbiddenProblem` for a job of another user, unless the caller is a
    maintainer.
    """
    row, project = find_job(tx, job_id)
    require_own(tx, row, project, "cancel")
    hold_off_purges(tx, project.id)
    of_job = job.c.parent_id == job_id
    tasks = _cancel(tx, of_job, policy) if row.size is not None else ()
    whole = _cancel(tx, job.c.id == job_id, policy)
    if row.unbound:  # it may have got its inputs, and tasks, since it was read
        tasks = _cancel(tx, of_job, policy)
    propagate_ends(tx, [as_ended(one) for one in (*tasks, *whole) if one.state != "running"])
    document = job_documents(tx, [job_id])[0]
    if not whole and document.state != JobState.CANCELLED:
        raise ConflictProblem(
            f"The job has already ended ({document.state}) and cannot be cancelled.", code="job-ended"
        )
    return document


def _cancel(tx: Transaction, which: ColumnElement[bool], policy: QueuePolicy) -> Sequence[Row[Any]]:
    """Cancel the jobs that have not ended, in one statement, and return them in their new states.

    The time limit of a running job is set to now, so that its lease cannot be extended beyond the grace period. A
    parent job has no lease while its tasks are running, and ends when all its tasks have ended.
    """
    running = job.c.state == RUNNING
    leased = and_(running, job.c.lease_expires_us.is_not(None))
    rows = tx.execute(
        update(job)
        .where(which, job.c.state.in_(UNFINISHED))
        .values(
            state=case((running, "running"), else_="cancelled"),
            cancel_requested_us=func.coalesce(job.c.cancel_requested_us, tx.now_us),
            deadline_us=case((leased, earlier(job.c.deadline_us, tx.now_us)), else_=None),
            lease_expires_us=case(
                (leased, earlier(job.c.lease_expires_us, tx.now_us + policy.end_grace_us)), else_=None
            ),
            finished_us=case((running, None), else_=tx.now_us),
            rev=job.c.rev + 1,
        )
        .returning(*ENDED_COLUMNS)
    ).all()
    still_running = [row for row in rows if row.state == "running"]
    emit_job_events(tx, "job.cancel_requested", [(row.project_id, row.id, {}) for row in still_running])
    return rows


# -- who may -----------------------------------------------------------------------------------------------------------


def find_job(tx: Transaction, job_id: str) -> tuple[Row[Any], ProjectRow]:
    """Return the row of a job, with the columns of `select_jobs`, and its project.

    Raises `NotFoundProblem` if there is no such job, if the caller may not see the project, or if the caller is an
    attempt of another job.
    """
    row = tx.execute(select_jobs().where(job.c.id == job_id)).one_or_none()
    if row is not None and (tx.principal.kind != "attempt" or tx.principal.job_id == job_id):
        try:
            return row, projects.require(tx, row.project_name)
        except NotFoundProblem:
            pass
    raise NotFoundProblem(f"There is no job {job_id!r} that you may see.", code="no-job")


def require_own(tx: Transaction, row: Row[Any], project: ProjectRow, what: str) -> None:
    """Raise `ForbiddenProblem` unless the caller is the author of the job or a maintainer of the project.

    `what` is the verb in the error text, such as "cancel".
    """
    if roles.includes(project.role, Role.MAINTAINER):
        return
    if row.author_id != tx.principal.user_id:  # who may be a contributor in some folders only
        raise ForbiddenProblem(
            f"Only maintainers of the project may {what} jobs of other users.", code="insufficient-role"
        )
