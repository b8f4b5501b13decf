"""Submission of the jobs of due schedules.

The transaction that submits a job also moves the due time of the schedule, and no two transactions can do this at the
same time. So each due time submits at most one job, however many servers try, and wherever a process dies.
"""

from __future__ import annotations

import logging
from typing import Any

from pydantic import ValidationError
from sqlalchemy import Row, select, update

from marey_schemas.access import Role
from marey_schemas.queue.jobs import JobCreate
from marey_schemas.validation.reasons import first_reason
from marey_server.access import scopes
from marey_server.access.principal import SYSTEM, Principal
from marey_server.access.roles import RequiredRole
from marey_server.errors import ApiProblem, ForbiddenProblem, InvalidProblem, UnavailableProblem
from marey_server.store.database.clock import datetime_of
from marey_server.store.database.connections import Database
from marey_server.store.jobs.reading import UNFINISHED
from marey_server.store.jobs.submission import submit
from marey_server.store.schedules.times import next_time_us
from marey_server.store.tables import job, project, schedule, user
from marey_server.store.transaction import Transaction

log = logging.getLogger(__name__)

DUE_AT_ONCE = 100
"""Greatest number of due schedules that one call of `submit_due` handles."""
MAX_PROBLEM_LENGTH = 500
SKIPPED = "Skipped, because the previous job"
"""Beginning of the field `problem` of a schedule that skipped a time because its previous job had not ended.

Such a problem does not count as a refusal.
"""

_SUBMITS = RequiredRole(Role.CONTRIBUTOR, "jobs", guests=False, in_folders=True)
"""Role and scope that the author of a schedule needs whenever a job is submitted."""


def submit_due(database: Database) -> int:
    """Submit the jobs of the schedules that are due, each in its own transaction; return how many were handled.

    After an unexpected error, the other schedules are still handled; the failed schedule records that it has failed,
    and continues at its next time. While the database is unavailable, a schedule stays due and is not counted.
    """
    due = database.read(SYSTEM, _find_due)
    done = len(due)
    for schedule_id in due:
        try:
            database.submit_write(SYSTEM, submit_if_due, schedule_id).result()
        except UnavailableProblem as problem:
            log.warning("the schedule %s is tried again later: %s", schedule_id, problem.detail)
            done -= 1
        except Exception:
            log.exception("the schedule %s failed", schedule_id)
            database.submit_write(SYSTEM, _skip_after_fault, schedule_id).result()
    return done


def _find_due(tx: Transaction) -> list[str]:
    """Return the ids of at most `DUE_AT_ONCE` due schedules, the longest due first."""
    statement = (
        select(schedule.c.id)
        .join(project, project.c.id == schedule.c.project_id)
        .where(schedule.c.due_us <= tx.now_us, project.c.deleted_us.is_(None))
        .order_by(schedule.c.due_us)
        .limit(DUE_AT_ONCE)
    )
    return list(tx.execute(statement).scalars())


def submit_if_due(tx: Transaction, schedule_id: str) -> None:
    """Submit the job of a schedule if it is due, and move its due time to the next time after now.

    If several times have passed since, as after an interruption of the server, one job is submitted for all of them. If
    the submission is refused, the schedule records the reason, and an event reports the first refusal in a row.
    """
    statement = (
        select(schedule, project.c.name.label("project"))
        .join(project, project.c.id == schedule.c.project_id)
        .where(schedule.c.id == schedule_id, schedule.c.due_us <= tx.now_us, project.c.deleted_us.is_(None))
        .with_for_update(of=schedule)
    )
    row = tx.execute(statement).first()
    if row is None:
        return
    values: dict[str, Any] = {"rev": schedule.c.rev + 1}
    if row.due_us:  # 0: the clock of the database was corrected, so nothing is due
        values |= {"fired_us": tx.now_us} | _submit(tx, row)
    values |= _next_time(tx, row)
    tx.execute(update(schedule).where(schedule.c.id == row.id).values(**values))


def _skip_after_fault(tx: Transaction, schedule_id: str) -> None:
    """Record that a fault of the server prevented the submission, and move the due time of the schedule.

    Otherwise the server would repeat the fault every few seconds.
    """
    row = tx.execute(select(schedule).where(schedule.c.id == schedule_id).with_for_update()).first()
    if row is not None and row.due_us is not None:
        values = _next_time(tx, row) | {"fired_us": tx.now_us, "rev": schedule.c.rev + 1}
        values.setdefault("problem", "Failed because of a fault of the server; its log gives the reason.")
        tx.execute(update(schedule).where(schedule.c.id == schedule_id).values(**values))


def _next_time(tx: Transaction, row: Row[Any]) -> dict[str, Any]:
    """Return the columns that set the next due time of a schedule, or pause it if it has no time in the future."""
    try:
        return {"due_us": next_time_us(row.cron, row.timezone, tx.now_us)}
    except InvalidProblem as problem:
        return {"due_us": None, "problem": problem.detail[:MAX_PROBLEM_LENGTH]}


def _submit(tx: Transaction, row: Row[Any]) -> dict[str, Any]:
    """Submit the job of a due schedule; return the new values of `last_job_id` and `problem`."""
    if not row.overlapping and _is_unfinished(tx, row.last_job_id):
        return {"problem": f"{SKIPPED} {row.last_job_id} has not ended."}
    author = tx.execute(select(user).where(user.c.id == row.author_id)).one()
    own = tx.beside(Principal("user", author.id, author.name, author.administrator, tuple(row.scopes)))
    own.required_role = _SUBMITS
    try:
        if author.disabled:
            raise ForbiddenProblem("The user is disabled.")
        with tx.connection.begin_nested():
            (made,) = submit(own, row.project, (JobCreate.model_validate(row.job),))
    except UnavailableProblem:
        raise
    except (ApiProblem, ValidationError) as error:
        reason = _reason(error, may_read=scopes.allows(row.scopes, "read", row.project))
        if row.problem is None or row.problem.startswith(SKIPPED):
            tx.emit("schedule.refused", row.id, project_id=row.project_id, name=row.name)
        return {"problem": f"Refused for the user {author.name}: {reason}"[:MAX_PROBLEM_LENGTH]}
    tx.after_commit(own.run_after_commit)
    due_at = datetime_of(row.due_us).isoformat()
    tx.emit("schedule.submitted", row.id, project_id=row.project_id, name=row.name, job=made.id, due_at=due_at)
    return {"last_job_id": made.id, "problem": None}


def _reason(error: ApiProblem | ValidationError, *, may_read: bool) -> str:
    """Return the reason of a refusal, without names if the token that made the schedule may not read the project."""
    if isinstance(error, ApiProblem):
        return error.detail if may_read else error.unnamed or error.detail
    return f"The job is no longer valid: {first_reason(error)}"


def _is_unfinished(tx: Transaction, job_id: str | None) -> bool:
    unfinished = (job.c.id == job_id, job.c.state.in_(UNFINISHED))
    return job_id is not None and tx.execute(select(job.c.id).where(*unfinished)).first() is not None
