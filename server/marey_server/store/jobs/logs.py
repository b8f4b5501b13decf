"""Logs of attempts: appended by offset during the attempt, closed at its end, and read as one text per job."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from sqlalchemy import Row, insert, select, update

from marey_schemas.queue.jobs import JobState
from marey_schemas.queue.worker_protocol import LogAnswer
from marey_server.errors import ConflictProblem
from marey_server.store.jobs.fencing import lock_held_job, require_attempt
from marey_server.store.jobs.policy import DEFAULT_POLICY, QueuePolicy
from marey_server.store.tables import attempt, job_log
from marey_server.store.transaction import Transaction

CAPPED = b"\n[the log is full; what follows is not kept]\n"
MOST_READ_BYTES = 2**20


class LogOffset(ConflictProblem):
    """The data was sent for an offset that is not the end of the log."""

    code = "log-offset"


def append_log(
    tx: Transaction, job_id: str, fence: int, offset: int, data: bytes, policy: QueuePolicy = DEFAULT_POLICY
) -> LogAnswer:
    """Append `data` at `offset`, which must be the end of the attempt's log; a repeated append changes nothing.

    A log that reaches the limit of the policy is closed with a note, and ignores further data (`capped`). Raises
    `LogOffset`, with the end of the log, for any other offset, and `LeaseLostProblem` if the attempt no longer holds
    the job.
    """
    require_attempt(tx.principal, job_id, fence)
    lock_held_job(tx, job_id, fence)
    of_attempt = (attempt.c.job_id == job_id) & (attempt.c.fence == fence)
    length: int = tx.execute(select(attempt.c.log_bytes).where(of_attempt)).scalar_one()
    if length >= policy.log_limit_bytes:
        return LogAnswer(offset=length, capped=True)
    if offset != length:
        if _is_repeated(tx, job_id, fence, offset, data):
            return LogAnswer(offset=length)
        detail = f"The log has {length} bytes; the next piece must begin there, not at {offset}."
        raise LogOffset(detail, context={"offset": length})
    if not data:
        return LogAnswer(offset=length)
    capped = length + len(data) >= policy.log_limit_bytes
    if capped:
        data = data[: policy.log_limit_bytes - length] + CAPPED
    tx.execute(insert(job_log).values(job_id=job_id, fence=fence, offset=offset, data=data))
    tx.execute(update(attempt).where(of_attempt).values(log_bytes=length + len(data)))
    return LogAnswer(offset=length + len(data), capped=capped)


def _is_repeated(tx: Transaction, job_id: str, fence: int, offset: int, data: bytes) -> bool:
    statement = select(job_log.c.data).where(
        job_log.c.job_id == job_id, job_log.c.fence == fence, job_log.c.offset == offset
    )
    said: bytes | None = tx.execute(statement).scalar_one_or_none()
    return said is not None and bytes(said) == data


@dataclass(frozen=True, slots=True)
class LogPage:
    """Page of a job's log, which is the output of all attempts, one after the other."""

    data: bytes
    offset: int
    """Offset in bytes at which the next page begins."""
    sealed: bool
    """Whether the log is complete and this page reaches its end."""


class _Span(NamedTuple):
    fence: int
    start: int
    stop: int


def read_log(tx: Transaction, job_row: Row[tuple[str, str]], offset: int, limit: int = MOST_READ_BYTES) -> LogPage:
    """Return up to `limit` bytes of the log of a job from `offset` on; `job_row` has the columns `id` and `state`.

    The log of an attempt does not grow after the next attempt has begun, so offsets into the joined log stay valid.
    """
    spans = _spans(tx, job_row.id)
    total = spans[-1].stop if spans else 0
    offset = min(max(offset, 0), total)
    stop = min(offset + max(limit, 1), total)
    data = b"".join(
        _read(tx, job_row.id, span.fence, max(offset, span.start) - span.start, min(stop, span.stop) - span.start)
        for span in spans
        if span.start < stop and span.stop > offset
    )
    return LogPage(data, stop, JobState(job_row.state).terminal and stop == total)


def _spans(tx: Transaction, job_id: str) -> list[_Span]:
    spans: list[_Span] = []
    start = 0
    statement = select(attempt.c.fence, attempt.c.log_bytes).where(attempt.c.job_id == job_id)
    for row in tx.execute(statement.order_by(attempt.c.fence)):
        spans.append(_Span(row.fence, start, start + row.log_bytes))
        start += row.log_bytes
    return spans


def _read(tx: Transaction, job_id: str, fence: int, start: int, stop: int) -> bytes:
    of_attempt = (job_log.c.job_id == job_id, job_log.c.fence == fence)
    first = (
        select(job_log.c.offset)
        .where(*of_attempt, job_log.c.offset <= start)
        .order_by(job_log.c.offset.desc())
        .limit(1)
        .scalar_subquery()
    )
    statement = select(job_log.c.offset, job_log.c.data).where(
        *of_attempt, job_log.c.offset >= first, job_log.c.offset < stop
    )
    pieces = tx.execute(statement.order_by(job_log.c.offset)).all()
    joined = b"".join(bytes(piece.data) for piece in pieces)
    return joined[start - pieces[0].offset : stop - pieces[0].offset]
