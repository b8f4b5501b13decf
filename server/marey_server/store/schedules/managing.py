"""Schedules as resources of a project: members create, list, change and delete them."""

from __future__ import annotations

from typing import Any

from sqlalchemy import Row, Select, delete, select

from marey_schemas.access import Role
from marey_schemas.items import Page
from marey_schemas.problems import FieldError
from marey_schemas.queue.jobs import JobCreate
from marey_schemas.queue.schedules import Schedule, ScheduleChange, ScheduleCreate
from marey_server.access import roles
from marey_server.errors import (
    ConflictProblem,
    ForbiddenProblem,
    InvalidProblem,
    NotFoundProblem,
)
from marey_server.store import listing, projects
from marey_server.store.database.clock import datetime_of
from marey_server.store.ids import new_id
from marey_server.store.jobs.inputs import late_inputs
from marey_server.store.jobs.submission import check_request
from marey_server.store.projects import ProjectRow
from marey_server.store.quotas import counting
from marey_server.store.revs import ExpectedRev, change_row, is_expected, moved_on
from marey_server.store.schedules.times import next_time_us
from marey_server.store.tables import schedule, user
from marey_server.store.transaction import Transaction


def list_schedules(tx: Transaction, project: str, *, cursor: str | None, limit: int) -> Page:
    """List the schedules of a project by name."""
    row = projects.require(tx, project)
    order = listing.parse_order("name", {"name": schedule.c.name, "id": schedule.c.id})
    rows, following = listing.read_page(tx, _rows(row), order, ["schedules", row.id], cursor, limit)
    return Page(items=tuple(_shown(project, one) for one in rows), next_cursor=following)


def read_schedule(tx: Transaction, project: str, name: str) -> Schedule:
    """Return a schedule. Raises `NotFoundProblem` if it does not exist."""
    return _shown(project, _find(tx, projects.require(tx, project), name))


def create_schedule(tx: Transaction, project: str, request: ScheduleCreate) -> Schedule:
    """Create a schedule that submits jobs as the caller.

    Raises `ConflictProblem` if the name is taken, `QuotaExceededProblem` if the project has too many schedules, and
    `InvalidProblem` if a field, or the job, is not valid now.
    """
    row = projects.require(tx, project)
    _check_job(tx, row, request.job)
    due_us = next_time_us(request.cron, request.timezone, tx.now_us)
    counting.require_place(tx, row.id, schedule)
    schedule_id = new_id("schedule")
    values = {
        "id": schedule_id, "project_id": row.id, "name": request.name, "cron": request.cron,
        "timezone": request.timezone, "job": request.job.model_dump(mode="json", exclude_unset=True),
        "overlapping": request.overlapping, "description": request.description,
        "due_us": None if request.paused else due_us, "created_us": tx.now_us, "updated_us": tx.now_us, "rev": 1,
        **_author(tx),
    }  # fmt: skip
    made = tx.execute(tx.insert_or_ignore(schedule, values).returning(schedule.c.id)).first()
    if made is None:
        raise ConflictProblem(
            f"The project has a schedule {request.name!r} already; choose another name.", code="schedule-exists"
        )
    tx.audit("schedule.created", schedule_id, about=request.name, project_id=row.id)
    return _shown(project, _find(tx, row, request.name))


def change_schedule(
    tx: Transaction, project: str, name: str, request: ScheduleChange, *, expected_rev: ExpectedRev
) -> Schedule:
    """Change, pause or resume a schedule.

    After any change except a pause or a new description, the caller is the author of the schedule, as whom its jobs are
    submitted. So nobody can make other users submit jobs that they have not chosen. Raises `ForbiddenProblem` if the
    caller is neither the author of the schedule nor a maintainer of the project. Raises `InvalidProblem` as
    `create_schedule` does.
    """
    row = projects.require(tx, project)
    before = _require_rights(tx, row, name)
    if not is_expected(before.rev, expected_rev):
        raise moved_on(before.rev)
    values = request.model_dump(mode="json", exclude_none=True, exclude={"paused", "job"})
    if request.job is not None:
        _check_job(tx, row, request.job)
        values["job"] = request.job.model_dump(mode="json", exclude_unset=True)
    if request.model_dump(exclude_none=True, exclude={"description", "paused"}) or request.paused is False:
        values |= _author(tx) | {"problem": None}
    paused = before.due_us is None if request.paused is None else request.paused
    due_us = next_time_us(values.get("cron", before.cron), values.get("timezone", before.timezone), tx.now_us)
    values |= {"due_us": None if paused else due_us, "updated_us": tx.now_us}
    which = (schedule.c.id == before.id,)
    change_row(tx, schedule, which, values, expected_rev=before.rev, absent=_no_schedule(name))
    fields = sorted(request.model_dump(exclude_none=True))
    tx.audit("schedule.changed", before.id, about=name, project_id=row.id, fields=fields)
    return _shown(project, _find(tx, row, name))


def delete_schedule(tx: Transaction, project: str, name: str, *, expected_rev: ExpectedRev) -> None:
    """Delete a schedule; its jobs stay.

    Raises `ForbiddenProblem` if the caller is neither the author of the schedule nor a maintainer of the project.
    """
    row = projects.require(tx, project)
    before = _require_rights(tx, row, name)
    if not is_expected(before.rev, expected_rev):
        raise moved_on(before.rev)
    tx.execute(delete(schedule).where(schedule.c.id == before.id))
    tx.audit("schedule.deleted", before.id, about=name, project_id=row.id)


def _author(tx: Transaction) -> dict[str, Any]:
    """Return the columns of a schedule that make the caller its author: the user and the scopes of the token."""
    return {"author_id": tx.principal.user_id, "scopes": sorted(tx.principal.scopes)}


def _check_job(tx: Transaction, row: ProjectRow, job: JobCreate) -> None:
    """Raise `InvalidProblem`, with pointers into the request, if the job could not be submitted now."""
    for place in ["/job/after"] * bool(job.after) + [place for place, _, _ in late_inputs(job, "/job")]:
        detail = "The job of a schedule cannot wait for other jobs: leave out `after` and outputs of other jobs."
        raise InvalidProblem(detail, errors=[FieldError(pointer=place, code="not-allowed", detail=detail)])
    check_request(tx, row, job, "/job")


def _require_rights(tx: Transaction, row: ProjectRow, name: str) -> Row[Any]:
    """Lock a schedule and return its row.

    Raises `ForbiddenProblem` if the caller is neither its author nor a maintainer of the project.
    """
    found = _find(tx, row, name, lock=True)
    if found.author_id != tx.principal.user_id and not roles.includes(row.role, Role.MAINTAINER):
        raise ForbiddenProblem(
            "Only the author of a schedule and maintainers of the project may change or delete it.", code="not-author"
        )
    return found


def _find(tx: Transaction, row: ProjectRow, name: str, *, lock: bool = False) -> Row[Any]:
    named = _rows(row).where(schedule.c.name == name)
    found = tx.execute(named.with_for_update(of=schedule) if lock else named).first()
    if found is None:
        raise _no_schedule(name)
    return found


def _no_schedule(name: str) -> NotFoundProblem:
    return NotFoundProblem(f"The project has no schedule {name!r}.", code="no-schedule")


def _rows(row: ProjectRow) -> Select[*tuple[Any, ...]]:
    return (
        select(*schedule.c, user.c.name.label("author"))
        .select_from(schedule.outerjoin(user, user.c.id == schedule.c.author_id))
        .where(schedule.c.project_id == row.id)
    )


def _shown(project: str, row: Row[Any]) -> Schedule:
    return Schedule(
        name=row.name, project=project, cron=row.cron, timezone=row.timezone, job=row.job,
        overlapping=row.overlapping, paused=row.due_us is None, description=row.description, author=row.author,
        created_at=datetime_of(row.created_us), updated_at=datetime_of(row.updated_us),
        next_at=datetime_of(row.due_us) if row.due_us else None,
        last_at=None if row.fired_us is None else datetime_of(row.fired_us),
        last_job=row.last_job_id, problem=row.problem, rev=row.rev,
    )  # fmt: skip
