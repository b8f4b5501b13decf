"""Fencing: the condition under which writes of an attempt are accepted.

Every job has a number, its fence, which each claim increases. A worker with an older fence has lost the job, perhaps
without having noticed. Every write of an attempt includes the condition that the fence is unchanged. A separate check
would not suffice, because another worker could claim the job between the check and the write.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

from sqlalchemy import (
    ColumnElement,
    Row,
    and_,
    bindparam,
    case,
    exists,
    literal_column,
    or_,
    select,
    tuple_,
    update,
)

from marey_schemas.access import Role
from marey_server.access.principal import Principal
from marey_server.errors import AUTHOR_LOST, LeaseLostProblem, NotFoundProblem
from marey_server.store.projects import WRITERS, has_role_in_folders
from marey_server.store.tables import attempt, job, member, user
from marey_server.store.transaction import Transaction

# Literals, not parameters: SQLite uses a partial index only where it can see that the condition is met.
RUNNING: ColumnElement[str] = literal_column("'running'")
QUEUED: ColumnElement[str] = literal_column("'queued'")
WAITING: ColumnElement[str] = literal_column("'waiting'")


def same_fence(fence: int) -> ColumnElement[bool]:
    """Return the SQL condition that no later attempt has claimed the job."""
    return job.c.fence == fence


def held(job_id: str, fence: int) -> ColumnElement[bool]:
    """Return the SQL condition, included in every write of a worker, that the attempt still holds its job."""
    return and_(job.c.id == job_id, job.c.state == RUNNING, same_fence(fence))


HELD = and_(
    job.c.id.in_(bindparam("held_ids", expanding=True)),
    job.c.state == RUNNING,
    tuple_(job.c.id, job.c.fence).in_(bindparam("held_attempts", expanding=True)),
)
"""SQL condition for the jobs that are still held by one of several attempts, for prepared statements.

`held_parameters` returns the parameters that name the attempts. For a single attempt, see `held`.
"""


def held_parameters(attempts: Collection[tuple[str, int]]) -> dict[str, Any]:
    """Return the parameters of the condition `HELD` for attempts, each given by the id of its job and its fence."""
    return {"held_ids": [job_id for job_id, _ in attempts], "held_attempts": list(attempts)}


UNCOUNTED: ColumnElement[int] = case((job.c.counted_fence < job.c.fence, 1), else_=0)
"""SQL expression: 1 if the attempt that holds the job was not counted yet, because it has written nothing; else 0."""

COUNT_ATTEMPT: dict[str, Any] = {"attempt": job.c.attempt + UNCOUNTED, "counted_fence": job.c.fence}
"""Values that every write of an attempt sets in its job, so that the first write counts the attempt.

The claim does not count the attempt, because its answer may have been lost.
"""

_MAY_WRITE = or_(
    user.c.administrator.is_(True),
    exists().where(
        member.c.project_id == job.c.project_id,
        member.c.user_id == user.c.id,
        or_(member.c.role.in_(WRITERS), has_role_in_folders(job.c.project_id, user.c.id, Role.CONTRIBUTOR)),
    ),
)
AUTHOR_MAY_RUN: ColumnElement[bool] = or_(
    job.c.author_id.is_(None), exists().where(user.c.id == job.c.author_id, user.c.disabled.is_(False), _MAY_WRITE)
)
"""SQL condition that a job has no author, or that its author is not disabled and may still submit jobs in the project.

The author must be an administrator, or have a role that may submit jobs. A role in one folder suffices; the transaction
that publishes results checks the role in the folders of the results.
"""


def require_attempt(principal: Principal, job_id: str, fence: int) -> None:
    """Check that the caller's credential belongs to this attempt.

    Raises `LeaseLostProblem` if the credential belongs to another attempt of the job, and `NotFoundProblem` if it
    belongs to no attempt of the job.
    """
    if principal.kind == "system":
        return
    if principal.kind != "attempt" or principal.job_id != job_id:
        raise NotFoundProblem(f"The job {job_id} has no attempt {fence} that your token may write to.")
    if principal.fence != fence:
        raise lease_lost(job_id, fence)


def lock_held_job(tx: Transaction, job_id: str, fence: int, *columns: ColumnElement[Any]) -> Row[Any]:
    """Lock the job of an attempt until the transaction ends, and return `columns` of the job's row.

    If this is the first write of the attempt, the attempt is counted towards `max_attempts`. Raises `LeaseLostProblem`
    if the attempt no longer holds the job.
    """
    holding = held(job_id, fence)
    statement = select(job.c.project_id, UNCOUNTED.label("uncounted"), *columns).where(holding).with_for_update()
    row = tx.execute(statement).one_or_none()
    if row is None:
        raise lease_lost(job_id, fence)
    if row.uncounted:
        tx.execute(update(job).where(holding).values(**COUNT_ATTEMPT))
        return tx.execute(statement).one()
    return row


def lease_lost(job_id: str, fence: int) -> LeaseLostProblem:
    """Return the error for an attempt that no longer holds the lease of its job.

    The error makes the worker stop the attempt.
    """
    return LeaseLostProblem(f"Attempt {fence} has lost its lease of {job_id}. Stop working on it.")


def author_lost(job_id: str, fence: int) -> LeaseLostProblem:
    """Return the error for an attempt that holds a job whose author may no longer run jobs in the project.

    The error makes the worker stop the attempt, and the server end the job.
    """
    lost = LeaseLostProblem(
        f"The author of {job_id} is disabled or no longer has the role that the job needs. Stop working on it.",
        context={"reason": AUTHOR_LOST},
    )
    lost.attempt_to_end = job_id, fence
    return lost


def stored_answer(tx: Transaction, job_id: str, fence: int, write_id: str) -> dict[str, Any] | None:
    """Return the answer that an earlier request of the attempt with this `write_id` got, or None."""
    statement = select(attempt.c.answer).where(
        attempt.c.job_id == job_id, attempt.c.fence == fence, attempt.c.write_id == write_id
    )
    answer: dict[str, Any] | None = tx.execute(statement).scalar_one_or_none()
    return answer


def earlier(first: Any, second: Any) -> ColumnElement[int]:
    """Return the SQL expression for the earlier of two times; SQLite and Postgres have different functions for it."""
    return case((first < second, first), else_=second)
