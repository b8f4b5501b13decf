"""Coverage streams: frames are sent during a recording, and each answer shows which motions are still missing.

Each stream is one row, updated by compare-and-swap. The row holds the whole state of the stream, and the answer to the
last request. So a sender who did not receive this answer gets it by repeating the request.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

from sqlalchemy import ColumnElement, Row, delete, func, insert, select, update

from marey_schemas.coverage_streams import MOST_STREAMS, CoverageStream
from marey_schemas.items import Page
from marey_server.errors import ConflictProblem, NotFoundProblem
from marey_server.store import listing, projects
from marey_server.store.database.clock import DAY_US, datetime_of
from marey_server.store.ids import new_id
from marey_server.store.tables import coverage_stream
from marey_server.store.transaction import Transaction

LIFETIME_US = DAY_US
"""Time without new frames after which a stream is deleted."""

Tree = dict[str, Any]


class CoverageOffset(ConflictProblem):
    """Frames were sent for an offset that is not the current offset of the stream."""

    code = "coverage-offset"


@dataclass(frozen=True, slots=True)
class NewStream:
    """Initial state of a coverage stream.

    `settings` are the fields of `CoverageStream` that never change. `rig` is the encoded skeleton of the stream's
    poses with its joint mapping, or None without a skeleton. `state` is the encoded state.
    """

    settings: Tree
    rig: bytes | None
    state: bytes


@dataclass(frozen=True, slots=True)
class Stream:
    """Row of a coverage stream in the database.

    `offset` is the number of frames that were received. `said` is the digest of the last request, and `answer` is the
    answer to this request; both are None before the first request.
    """

    id: str
    settings: Tree
    rig: bytes | None
    state: bytes
    offset: int
    said: str | None
    answer: Tree | None
    created_us: int
    updated_us: int
    rev: int

    def shown(self) -> Tree:
        """Return the stream as the fields of a `CoverageStream`."""
        return {
            **self.settings,
            "id": self.id,
            "offset": self.offset,
            "created_at": datetime_of(self.created_us),
            "updated_at": datetime_of(self.updated_us),
            "expires_at": datetime_of(self.updated_us + LIFETIME_US),
            "rev": self.rev,
        }


@dataclass(frozen=True, slots=True)
class StreamStep:
    """Update of a stream: the digest of the request (`said`), the answer, and the new state of the stream."""

    said: str
    answer: Tree
    offset: int
    state: bytes


def create_stream(tx: Transaction, project: str, new: NewStream) -> Stream:
    """Create a stream. Raises `ConflictProblem` if the project has too many streams."""
    project_row = projects.require(tx, project)
    tx.lock(f"coverage:{project_row.id}")
    count = select(func.count()).where(coverage_stream.c.project_id == project_row.id, ~is_old(tx))
    if tx.execute(count).scalar_one() >= MOST_STREAMS:
        raise ConflictProblem(
            f"The project already has {MOST_STREAMS} coverage streams, the most that are allowed; delete "
            "those that are no longer used.",
            code="too-many-streams",
        )
    made = Stream(new_id("coverage"), new.settings, new.rig, new.state, 0, None, None, tx.now_us, tx.now_us, 1)
    row = {field.name: getattr(made, field.name) for field in fields(made)}
    tx.execute(insert(coverage_stream), {**row, "project_id": project_row.id, "author_id": tx.principal.user_id})
    return made


def list_streams(
    tx: Transaction, project: str, *, cursor: str | None = None, limit: int = listing.DEFAULT_LIMIT
) -> Page:
    """List the streams of a project, newest first."""
    project_row = projects.require(tx, project)
    statement = select(*_LISTED).where(coverage_stream.c.project_id == project_row.id, ~is_old(tx))
    order = listing.parse_order("-id", {"id": coverage_stream.c.id})
    rows, next_cursor = listing.read_page(tx, statement, order, ["coverage", project_row.id], cursor, limit)
    return Page(items=tuple(CoverageStream(**_listed(row)) for row in rows), next_cursor=next_cursor)


def read_stream(tx: Transaction, project: str, stream_id: str) -> Stream:
    """Return a stream to a caller who may read it. Raises `NotFoundProblem` if it does not exist."""
    return _find(tx, projects.require(tx, project).id, stream_id)


def read_to_advance(tx: Transaction, project: str, stream_id: str) -> Stream:
    """Return a stream to a caller who may send frames to it. Raises `NotFoundProblem` if it does not exist."""
    return _find(tx, projects.require(tx, project).id, stream_id)


def advance_stream(tx: Transaction, project: str, held: Stream, step: StreamStep) -> Tree:
    """Store the next state of a stream if no other request has changed the stream since `held` was read.

    Returns the answer. A repetition of the stream's last request changes nothing and gets the stored answer. Raises
    `CoverageOffset` with the current offset if another request has changed the stream, and `NotFoundProblem` if the
    stream was deleted.
    """
    project_row = projects.require(tx, project)
    where = coverage_stream.c.id == held.id, coverage_stream.c.rev == held.rev
    kept = {"state": step.state, "offset": step.offset, "said": step.said, "answer": step.answer}
    moved = update(coverage_stream).where(*where).values(**kept, updated_us=tx.now_us, rev=held.rev + 1)
    if tx.execute(moved).rowcount == 1:
        return step.answer
    now = _find(tx, project_row.id, held.id)
    answer = answered_before(now, step.said)
    if answer is None:
        raise _elsewhere(now)
    return answer


def answered_before(stream: Stream, said: str) -> Tree | None:
    """Return the stored answer if the request with the digest `said` repeats the stream's last request, else None."""
    return stream.answer if stream.said == said else None


def require_offset(stream: Stream, offset: int) -> None:
    """Raise `CoverageOffset`, with the current offset of the stream, if `offset` is not the current offset."""
    if stream.offset != offset:
        raise _elsewhere(stream)


def _elsewhere(stream: Stream) -> CoverageOffset:
    detail = f"The stream has {stream.offset} frames; send the next frames at the offset {stream.offset}."
    return CoverageOffset(detail, context={"offset": stream.offset})


def delete_stream(tx: Transaction, project: str, stream_id: str) -> None:
    """Delete a stream. Raises `NotFoundProblem` if it does not exist."""
    project_row = projects.require(tx, project)
    found = _find(tx, project_row.id, stream_id)
    tx.execute(delete(coverage_stream).where(coverage_stream.c.id == found.id))


_LISTED = [coverage_stream.c[name] for name in ("id", "settings", "offset", "created_us", "updated_us", "rev")]


def _listed(row: Row[Any]) -> Tree:
    no_state: Tree = {"rig": None, "state": b"", "said": None, "answer": None}
    return Stream(**row._asdict(), **no_state).shown()


def is_old(tx: Transaction) -> ColumnElement[bool]:
    return coverage_stream.c.updated_us < tx.now_us - LIFETIME_US


def _find(tx: Transaction, project_id: str, stream_id: str) -> Stream:
    statement = select(coverage_stream).where(
        coverage_stream.c.id == stream_id, coverage_stream.c.project_id == project_id, ~is_old(tx)
    )
    row = tx.execute(statement).first()
    if row is None:
        raise NotFoundProblem(
            f"The project has no coverage stream {stream_id!r}; a stream is deleted when it has received no "
            "frames for a day.",
            code="no-stream",
        )
    return Stream(**{field.name: row._mapping[field.name] for field in fields(Stream)})
