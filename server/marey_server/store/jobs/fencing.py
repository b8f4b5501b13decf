"""Fencing: the condition under which a write of an attempt counts.

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
    """Condition that nobody has claimed the job since this attempt did."""
    return job.c.fence == fence


def held(job_id: str, fence: int) -> ColumnElement[bool]:
    """Condition that the attempt still holds its job, for every write of a worker."""
    return and_(job.c.id == job_id, job.c.state == RUNNING, same_fence(fence))


HELD = and_(
    job.c.id.in_(bindparam("held_ids", expanding=True)),
    job.c.state == RUNNING,
    tuple_(job.c.id, job.c.fence).in_(bindparam("held_attempts", expanding=True)),
)
"""The condition `held` for several attempts, in prepared statements; `held_parameters` gives the attempts."""


def held_parameters(attempts: Collection[tuple[str, int]]) -> dict[str, Any]:
    """Return the parameters of `HELD`."""
    return {"held_ids": [job_id for job_id, _ in attempts], "held_attempts": list(attempts)}


def require_attempt(principal: Principal, job_id: str, fence: int) -> None:
    """Check that the credential is that of this attempt.

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
    """Lock the job for this transaction and read `columns` of it.

    Raises `LeaseLostProblem` if the attempt does not hold it any more.
    """
    statement = select(job.c.project_id, *columns).where(held(job_id, fence)).with_for_update()
    row = tx.execute(statement).one_or_none()
    if row is None:
        raise lease_lost(job_id, fence)
    return row


def lease_lost(job_id: str, fence: int) -> LeaseLostProblem:
    """Return the error on which a worker stops."""
    return LeaseLostProblem(f"Attempt {fence} does not hold {job_id} any more. Stop working on it.")


def stored_answer(tx: Transaction, job_id: str, fence: int, write_id: str) -> dict[str, Any] | None:
    """Return the stored answer for this `write_id`, or None."""
    statement = select(attempt.c.answer).where(
        attempt.c.job_id == job_id, attempt.c.fence == fence, attempt.c.write_id == write_id
    )
    answer: dict[str, Any] | None = tx.execute(statement).scalar_one_or_none()
    return answer


def earlier(first: Any, second: Any) -> ColumnElement[int]:
    """Return the smaller of two times in SQL; the databases name their functions for it differently."""
    return case((first < second, first), else_=second)
