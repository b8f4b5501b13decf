"""The fence: what an attempt must still hold for anything it writes to count.

A claim raises the job's fence; whoever worked under an older one has lost the job without knowing it. Every write of an
attempt repeats this predicate in the transaction of the write, since a check of its own would be outrun.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

from sqlalchemy import ColumnElement, Row, and_, bindparam, case, literal_column, select, tuple_

from marey_server.access.principal import Principal
from marey_server.errors import LeaseLostProblem, NotFoundProblem
from marey_server.store.tables import attempt, job
from marey_server.store.transaction import Transaction

# Literals, not parameters: SQLite uses a partial index only where it can see that the condition is met.
RUNNING: ColumnElement[str] = literal_column("'running'")
QUEUED: ColumnElement[str] = literal_column("'queued'")
WAITING: ColumnElement[str] = literal_column("'waiting'")


def same_fence(fence: int) -> ColumnElement[bool]:
    """Nobody has claimed the job since this attempt did."""
    return job.c.fence == fence


def held(job_id: str, fence: int) -> ColumnElement[bool]:
    """The attempt still holds its job: the predicate of every write of a worker."""
    return and_(job.c.id == job_id, job.c.state == RUNNING, same_fence(fence))


HELD = and_(
    job.c.id.in_(bindparam("held_ids", expanding=True)),
    job.c.state == RUNNING,
    tuple_(job.c.id, job.c.fence).in_(bindparam("held_attempts", expanding=True)),
)
"""The same of several attempts, for statements that are built once; `held_parameters` gives the attempts."""


def held_parameters(attempts: Collection[tuple[str, int]]) -> dict[str, Any]:
    """The parameters of `HELD`."""
    return {"held_ids": [job_id for job_id, _ in attempts], "held_attempts": list(attempts)}


def require_attempt(principal: Principal, job_id: str, fence: int) -> None:
    """The credential must be that of this very attempt.

    Raises `NotFoundProblem` for a credential that is no attempt's of this job, `LeaseLostProblem` for another attempt
    of it.
    """
    if principal.kind == "system":
        return
    if principal.kind != "attempt" or principal.job_id != job_id:
        raise NotFoundProblem(f"There is no attempt {fence} of {job_id} that this credential may write to.")
    if principal.fence != fence:
        raise lease_lost(job_id, fence)


def hold(tx: Transaction, job_id: str, fence: int, *columns: ColumnElement[Any]) -> Row[Any]:
    """Keep the job from changing hands until the transaction ends, and read `columns` of it.

    Raises `LeaseLostProblem` if the attempt does not hold it any more.
    """
    statement = select(job.c.project_id, *columns).where(held(job_id, fence)).with_for_update()
    row = tx.execute(statement).one_or_none()
    if row is None:
        raise lease_lost(job_id, fence)
    return row


def lease_lost(job_id: str, fence: int) -> LeaseLostProblem:
    """The error that tells a worker to stop."""
    return LeaseLostProblem(f"Attempt {fence} does not hold {job_id} any more. Stop working on it.")


def earlier_answer(tx: Transaction, job_id: str, fence: int, write_id: str) -> dict[str, Any] | None:
    """What the attempt's last word with this `write_id` was answered; `None` if it has not been said."""
    statement = select(attempt.c.answer).where(
        attempt.c.job_id == job_id, attempt.c.fence == fence, attempt.c.write_id == write_id
    )
    answer: dict[str, Any] | None = tx.execute(statement).scalar_one_or_none()
    return answer


def earlier(first: Any, second: Any) -> ColumnElement[int]:
    """The smaller of two times in SQL; both databases have a function for it, under different names."""
    return case((first < second, first), else_=second)
