"""Decides whether a job is retried, fails or is cancelled after an unsuccessful attempt, and applies the decision."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

from sqlalchemy import ColumnElement, Row, and_, not_, select, update

from marey_schemas.queue.jobs import FailureReason
from marey_schemas.queue.worker_protocol import FailRequest
from marey_server.errors import AUTHOR_LOST
from marey_server.store.jobs import staging
from marey_server.store.jobs.endings import AttemptEnd, end_attempts, end_jobs, failure_document
from marey_server.store.jobs.events import emit_job_events, wake_workers
from marey_server.store.jobs.fencing import AUTHOR_MAY_RUN, held, lease_lost
from marey_server.store.jobs.policy import QueuePolicy
from marey_server.store.jobs.propagation import propagate_ends
from marey_server.store.purge_lock import hold_off_purges_of_jobs
from marey_server.store.tables import job
from marey_server.store.transaction import Transaction

TIME_LIMIT = "time-limit"
"""Code that a worker reports after it stopped a job at its time limit."""

ENDING_COLUMNS = (
    job.c.id,
    job.c.kind,
    job.c.fence,
    job.c.counted_fence,
    job.c.unstarted,
    job.c.attempt,
    job.c.max_attempts,
    job.c.interruptions,
    job.c.cancel_requested_us,
    job.c.deadline_us,
    job.c.lease_expires_us,
    job.c.time_limit_s,
    AUTHOR_MAY_RUN.label("author_may_run"),
)


@dataclass(frozen=True, slots=True)
class AttemptOutcome:
    """Decision about a job after an attempt: the next state of the job, and the outcome of the attempt.

    `rest_us` is the wait before a retry in microseconds; it is None if the job is not retried.
    """

    state: str
    attempt_outcome: str
    rest_us: int | None = None
    failure: dict[str, Any] | None = None
    counts_as: Literal["attempt", "interruption", "unstarted"] = "attempt"
    """Limit towards which the attempt counts: `max_attempts` of the job ("attempt"), or a limit of `QueuePolicy`."""


def decide_outcome(row: Row[Any], request: FailRequest, policy: QueuePolicy, *, poisoned: bool) -> AttemptOutcome:
    """Decide what happens after an attempt that the worker reports as failed.

    `row` has the columns `ENDING_COLUMNS`. With `poisoned`, an earlier attempt failed with the same signature, so the
    job is not retried.
    """
    if row.cancel_requested_us is not None:
        return AttemptOutcome("cancelled", "cancelled")
    if not row.author_may_run:
        return _of_lost_author()
    if request.interrupted:
        return _interrupted(row, policy)
    if request.code == TIME_LIMIT:
        return _over_time(row)
    if poisoned:
        detail = f"Two attempts ended in the same way: {request.detail or request.code}"
        return _failed(FailureReason.POISON, request.code, detail)
    if not request.retryable:
        return _failed(FailureReason.ERROR, request.code, request.detail)
    if row.attempt >= row.max_attempts:
        detail = f"{row.attempt} attempts failed; the last: {request.detail or request.code}"
        return _failed(FailureReason.ATTEMPTS_EXHAUSTED, request.code, detail)
    return AttemptOutcome("queued", "failed", policy.backoff_us(row.attempt))


def decide_expired_outcome(row: Row[Any], policy: QueuePolicy) -> AttemptOutcome:
    """Decide what happens after an attempt whose lease has expired. A retry is queued without delay.

    An attempt that has written nothing does not count as a try, because the answer to its claim may have been lost. If
    the lease was renewed until the deadline of the job, the worker was alive and did not stop in time, so the job
    fails. If the lease expired earlier, the worker is lost, even if the server notices this only after the deadline.
    """
    if row.cancel_requested_us is not None:
        return AttemptOutcome("cancelled", "cancelled")
    if not row.author_may_run:
        return _of_lost_author()
    if row.counted_fence < row.fence:
        return _unstarted(row, policy)
    if row.lease_expires_us >= row.deadline_us + policy.end_grace_us:
        return _over_time(row)
    if row.attempt >= row.max_attempts:
        detail = f"{row.attempt} attempts were made; the last worker stopped sending heartbeats."
        return _failed(FailureReason.ATTEMPTS_EXHAUSTED, "worker-lost", detail, attempt_outcome="lost")
    return AttemptOutcome("queued", "lost", 0)


def _of_lost_author() -> AttemptOutcome:
    detail = "The author of the job is disabled or no longer has the role that the job needs."
    return _failed(FailureReason.ERROR, AUTHOR_LOST, detail)


def _interrupted(row: Row[Any], policy: QueuePolicy) -> AttemptOutcome:
    if row.interruptions >= policy.max_interruptions:
        detail = f"The job's workers were stopped {row.interruptions + 1} times."
        return _failed(FailureReason.ATTEMPTS_EXHAUSTED, "interrupted", detail, attempt_outcome="interrupted")
    return AttemptOutcome("queued", "interrupted", 0, counts_as="interruption")


def _unstarted(row: Row[Any], policy: QueuePolicy) -> AttemptOutcome:
    if row.unstarted >= policy.max_unstarted:
        detail = f"{row.unstarted + 1} workers claimed the job and sent no heartbeat."
        return _failed(FailureReason.ATTEMPTS_EXHAUSTED, "worker-lost", detail, attempt_outcome="lost")
    return AttemptOutcome("queued", "lost", 0, counts_as="unstarted")


def _over_time(row: Row[Any]) -> AttemptOutcome:
    detail = f"The attempt took longer than its limit of {row.time_limit_s} s."
    return _failed(FailureReason.TIMEOUT, TIME_LIMIT, detail, attempt_outcome="timeout")


def _failed(reason: FailureReason, code: str, detail: str, attempt_outcome: str = "failed") -> AttemptOutcome:
    return AttemptOutcome("failed", attempt_outcome, failure=failure_document(reason, code, detail))


def apply_outcome(
    tx: Transaction,
    row: Row[Any],
    condition: ColumnElement[bool],
    outcome: AttemptOutcome,
    end: AttemptEnd,
    **values: Any,
) -> None:
    """Set the next state of the job if `condition` still holds, end the attempt, and propagate the end of the job.

    Raises `LeaseLostProblem` if the condition does not hold.
    """
    if outcome.rest_us is None:
        failure = {} if outcome.failure is None else {"failure": outcome.failure}
        ended = end_jobs(tx, condition, outcome.state, **failure, **values)
        moved = bool(ended)
    else:
        ended = []
        moved = _queue_again(tx, row, condition, outcome, values)
    if not moved:
        raise lease_lost(end.job_id, end.fence)
    if outcome.rest_us is not None:
        tx.after_commit(lambda: tx.observer.count_requeued(outcome.attempt_outcome))
    end_attempts(tx, [end])
    staging.drop_staged(tx, [(end.job_id, end.fence)])
    propagate_ends(tx, ended)


def end_for_lost_author(tx: Transaction, job_id: str, fence: int) -> None:
    """End a job whose author may no longer run it; do nothing if the attempt no longer holds the job."""
    hold_off_purges_of_jobs(tx, [job_id])
    condition = and_(held(job_id, fence), not_(AUTHOR_MAY_RUN))
    row = tx.execute(select(*ENDING_COLUMNS).where(condition).with_for_update()).one_or_none()
    if row is not None:
        outcome = _of_lost_author()
        apply_outcome(tx, row, condition, outcome, AttemptEnd(job_id, fence, outcome.attempt_outcome, AUTHOR_LOST))


_COUNTS: dict[str, dict[str, Any]] = {
    "attempt": {},
    "interruption": {"attempt": job.c.attempt - 1, "interruptions": job.c.interruptions + 1},
    "unstarted": {"unstarted": job.c.unstarted + 1},
}


def _queue_again(
    tx: Transaction, row: Row[Any], condition: ColumnElement[bool], outcome: AttemptOutcome, values: dict[str, Any]
) -> bool:
    queued = tx.execute(
        update(job)
        .where(condition)
        .values(
            state="queued",
            run_at_us=tx.now_us + (outcome.rest_us or 0),
            lease_expires_us=None,
            deadline_us=None,
            progress=None,
            rev=job.c.rev + 1,
            **_COUNTS[outcome.counts_as],
            **values,
        )
        .returning(job.c.project_id)
    ).scalar_one_or_none()
    if queued is None:
        return False
    emit_job_events(tx, "job.requeued", [(queued, row.id, {"fence": row.fence, "outcome": outcome.attempt_outcome})])
    wake_workers(tx, [row.kind])
    return True
