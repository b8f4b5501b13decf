"""Documents of jobs, built from rows."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from types import SimpleNamespace
from typing import Any

from sqlalchemy import Row, Select, bindparam, func, select

from marey_schemas.queue.jobs import Job, JobState, Progress
from marey_server.access.labels import labels_of
from marey_server.store.database.clock import datetime_of
from marey_server.store.database.prepared import Prepared
from marey_server.store.jobs.commits import shown_commit
from marey_server.store.tables import job, job_dependency, project, user
from marey_server.store.transaction import Transaction, in_lists


def select_jobs() -> Select[*tuple[Any, ...]]:
    """Return a SELECT of all jobs, each with the columns `project_name` and `author_name`."""
    return (
        select(job, project.c.name.label("project_name"), user.c.name.label("author_name"))
        .join(project, project.c.id == job.c.project_id)
        .outerjoin(user, user.c.id == job.c.author_id)
    )


_JOBS_BY_ID = Prepared(select_jobs().where(job.c.id.in_(bindparam("ids", expanding=True))))


def job_documents(tx: Transaction, ids: Sequence[str]) -> list[Job]:
    """Return the documents of the given jobs, in the same order."""
    found: dict[str, Job] = {}
    for some in in_lists(ids):
        rows = tx.run(_JOBS_BY_ID, {"ids": some})
        found |= {document.id: document for document in as_documents(tx, rows)}
    return [found[one] for one in ids]


_DEFAULTS = {column.key: getattr(column.default, "arg", None) for column in job.c}
"""Initial values of columns, for those columns that `new_row` omits."""


def document_of_new(tx: Transaction, project_name: str, row: Mapping[str, Any], after: Collection[str]) -> Job:
    """Return the document of a job that this transaction has inserted for the caller, without reading the database.

    `row` is the row as it was inserted, and `after` contains the ids of the jobs on which the job depends. The job must
    not have tasks. The result equals that of `job_documents`.
    """
    names = {"project_name": project_name, "author_name": tx.principal.user_name}
    return _document(SimpleNamespace(**{**_DEFAULTS, **row, **names}), tuple(sorted(after)), {}, None)


def as_documents(tx: Transaction, rows: Sequence[Row[Any]]) -> list[Job]:
    """Return documents for rows of `select_jobs`; the document of a parent job contains the states of its tasks."""
    gathering = [row for row in rows if row.size is not None]
    children = _children(tx, [row.id for row in gathering])
    at_work = [row for row in gathering if row.state == JobState.RUNNING and row.lease_expires_us is None]
    progress = _progress_of_tasks(tx, at_work, children)
    after = _after(tx, rows)
    return [_document(row, after.get(row.id, ()), children.get(row.id, {}), progress.get(row.id)) for row in rows]


_DEPENDENCIES = Prepared(
    select(job_dependency.c.job_id, job_dependency.c.on_job_id)
    .where(job_dependency.c.job_id.in_(bindparam("ids", expanding=True)))
    .order_by(job_dependency.c.on_job_id)
)


def _after(tx: Transaction, rows: Sequence[Row[Any]]) -> dict[str, tuple[str, ...]]:
    """Return the ids of the jobs on which each job depends, by job; jobs without dependencies are left out.

    A job can also wait for an equal job, to take over its result (`cached_from`); that job is not counted.
    """
    shared = {row.id: row.cached_from for row in rows}
    found: dict[str, tuple[str, ...]] = {}
    for row in tx.run(_DEPENDENCIES, {"ids": list(shared)}):
        if row.on_job_id != shared[row.job_id]:
            found[row.job_id] = (*found.get(row.job_id, ()), row.on_job_id)
    return found


def _children(tx: Transaction, parents: Sequence[str]) -> dict[str, dict[str, int]]:
    if not parents:
        return {}
    statement = (
        select(job.c.parent_id, job.c.state, func.count().label("count"))
        .where(job.c.parent_id.in_(parents))
        .group_by(job.c.parent_id, job.c.state)
    )
    counts: dict[str, dict[str, int]] = {}
    for row in tx.execute(statement):
        counts.setdefault(row.parent_id, {})[row.state] = row._mapping["count"]
    return counts


def _progress_of_tasks(
    tx: Transaction, heads: Sequence[Row[Any]], children: Mapping[str, dict[str, int]]
) -> dict[str, Progress]:
    """Return the progress of parent jobs as a number of tasks.

    Each task that has ended counts as one, and each running task as the share of its work that is done.
    """
    if not heads:
        return {}
    running: dict[str, list[Progress]] = {}
    statement = (
        select(job.c.parent_id, job.c.progress)
        .where(job.c.parent_id.in_([head.id for head in heads]), job.c.state == "running")
        .order_by(job.c.parent_id, job.c.position)
    )
    for row in tx.execute(statement):
        if row.progress is not None:
            running.setdefault(row.parent_id, []).append(Progress.model_validate(row.progress))
    progress: dict[str, Progress] = {}
    for head in heads:
        ended = sum(count for state, count in children.get(head.id, {}).items() if JobState(state).terminal)
        at_work = running.get(head.id, [])
        shares = sum(min(1.0, one.done / one.total) for one in at_work if one.total)
        progress[head.id] = Progress(done=ended + shares, total=head.size, note=at_work[0].note if at_work else "")
    return progress


def _document(row: Any, after: tuple[str, ...], children: dict[str, int], at_work: Progress | None) -> Job:
    return Job(
        id=row.id,
        project=row.project_name,
        kind=row.kind,
        state=row.state,
        params=row.params,
        inputs=row.inputs,
        after=after,
        labels=labels_of(row.labels_key),
        into=row.into_path,
        priority=row.priority,
        seed=row.seed,
        attempt=row.attempt + (row.state == "running" and row.counted_fence < row.fence),
        fence=row.fence,
        max_attempts=row.max_attempts,
        interruptions=row.interruptions,
        parent=row.parent_id,
        position=row.position,
        size=row.size,
        children=children,
        retry_of=row.retry_of,
        cached_from=row.cached_from,
        progress=at_work or row.progress,
        failure=row.failure,
        result=row.result,
        cancel_requested=row.cancel_requested_us is not None,
        publish_conflict=row.publish_conflict,
        commit=shown_commit(row),
        author=row.author_name,
        created_at=datetime_of(row.created_us),
        run_at=datetime_of(row.run_at_us),
        started_at=None if row.started_us is None else datetime_of(row.started_us),
        finished_at=None if row.finished_us is None else datetime_of(row.finished_us),
        rev=row.rev,
    )
