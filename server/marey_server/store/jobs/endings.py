"""Ends of jobs and attempts. A job that has ended never changes its state again."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from sqlalchemy import ColumnElement, Row, bindparam, update

from marey_schemas.queue.jobs import FailureReason, JobFailure
from marey_schemas.queue.worker_protocol import LONGEST_DETAIL
from marey_server.store.database.prepared import Prepared
from marey_server.store.tables import attempt, job
from marey_server.store.transaction import Transaction


@dataclass(frozen=True, slots=True)
class Ended:
    """Job that has ended in this transaction."""

    id: str
    project_id: str
    state: str
    parent_id: str | None
    failure: dict[str, Any] | None = None
    commit: str | None = None
    """Commit that has the outputs of the job."""
    shareable: bool = True
    """Whether jobs that wait for the result of this job may use the result."""

    @property
    def succeeded(self) -> bool:
        """Whether the job succeeded, so that it has results."""
        return self.state == "succeeded"


ENDED_COLUMNS = (job.c.id, job.c.project_id, job.c.state, job.c.parent_id, job.c.failure, job.c.committed)


def as_ended(row: Row[Any]) -> Ended:
    """Convert a database row with the columns `ENDED_COLUMNS` to an ended job."""
    return Ended(row.id, row.project_id, row.state, row.parent_id, row.failure, row.committed)


def failure_document(reason: FailureReason, code: str, detail: str) -> dict[str, Any]:
    """Return the document of a job's failure, in the form in which the database stores it."""
    return JobFailure(reason=reason, code=code, detail=detail[:LONGEST_DETAIL]).model_dump(mode="json")


def dependency_failure(cause: str, state: str) -> dict[str, Any]:
    """Return the failure of a job that depends on the job `cause`, which ended in `state` without success."""
    detail = f"This job needs {cause} to succeed, but {cause} is {state}."
    return failure_document(FailureReason.DEPENDENCY_FAILED, "dependency-failed", detail)


def end_jobs(tx: Transaction, condition: ColumnElement[bool], state: str, **values: Any) -> list[Ended]:
    """Set the final `state` of the jobs that meet `condition`, and return these jobs.

    For a job that a worker runs, `condition` must require that no later attempt has claimed the job (`same_fence`).
    """
    statement = (
        update(job)
        .where(condition)
        .values(state=state, finished_us=tx.now_us, lease_expires_us=None, rev=job.c.rev + 1, **values)
        .returning(*ENDED_COLUMNS)
    )
    return [as_ended(row) for row in tx.execute(statement)]


@dataclass(frozen=True, slots=True)
class AttemptEnd:
    """End of one attempt: its outcome, and the answer that a repeated request with the same `write_id` gets."""

    job_id: str
    fence: int
    outcome: str
    detail: str | None = None
    signature: str | None = None
    write_id: str | None = None
    answer: dict[str, Any] | None = None


_END_ATTEMPT = Prepared(
    update(attempt)
    .where(
        attempt.c.job_id == bindparam("of_job"),
        attempt.c.fence == bindparam("of_fence"),
        attempt.c.ended_us.is_(None),
    )
    .values(
        ended_us=bindparam("now"),
        outcome=bindparam("its_outcome"),
        detail=bindparam("its_detail"),
        signature=bindparam("its_signature"),
        write_id=bindparam("its_write_id"),
        answer=bindparam("its_answer"),
    )
)


def end_attempts(tx: Transaction, ends: Sequence[AttemptEnd]) -> None:
    """Record the ends of attempts; an attempt that has already ended is unchanged."""
    if not ends:
        return
    tx.run_each(
        _END_ATTEMPT,
        [
            {
                "of_job": end.job_id,
                "of_fence": end.fence,
                "its_outcome": end.outcome,
                "its_detail": end.detail,
                "its_signature": end.signature,
                "its_write_id": end.write_id,
                "its_answer": end.answer,
                "now": tx.now_us,
            }
            for end in ends
        ],
    )
