"""Limit on the number of jobs of a project that run at the same time."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from sqlalchemy import bindparam, func, select, update

from marey_server.store.database.prepared import Prepared
from marey_server.store.jobs.claiming.turns import Turn, count_leased
from marey_server.store.tables import queue_share
from marey_server.store.transaction import Transaction

Take = Callable[[int], list[Any]]
"""Function that claims up to a number of jobs of one project, and returns their rows."""

_NOW = Prepared(
    select(queue_share.c.most_running, count_leased(queue_share.c.project_id).label("running")).where(
        queue_share.c.project_id == bindparam("of")
    )
)


def take_within_limit(tx: Transaction, turn: Turn, most: int, take: Take, *, may_wait: bool) -> list[Any]:
    """Claim up to `most` jobs of a project, but not more than its limit allows.

    On Postgres, claims of a project with a limit run one after another: each one locks the project, and counts the
    running jobs again when it has the lock. A claim waits for such a lock only if it holds none (`may_wait`), so no two
    claims wait for each other. Otherwise, it leaves out a project that another claim has locked. SQLite has only one
    writer at a time.
    """
    if turn.most_running is None:
        return take(most)
    if not tx.is_postgres:
        return take(most if turn.places is None else min(most, turn.places))
    if not may_wait:
        locked = tx.execute(select(func.pg_try_advisory_xact_lock(_key_of(turn.project_id)))).scalar_one()
        return _take_counted(tx, turn, most, take) if locked else []
    with tx.connection.begin_nested() as savepoint:
        tx.lock(_lock_of(turn.project_id))
        rows = _take_counted(tx, turn, most, take)
        if not rows:
            savepoint.rollback()  # releases the lock, so that the claim may wait for that of another project
    return rows


def _take_counted(tx: Transaction, turn: Turn, most: int, take: Take) -> list[Any]:
    (now,) = tx.run(_NOW, {"of": turn.project_id})
    turn.running, turn.most_running = now.running, now.most_running
    allowed = most if turn.places is None else min(most, turn.places)
    return take(allowed) if allowed else []


def _lock_of(project_id: str) -> str:
    return f"running jobs {project_id}"


def _key_of(project_id: str) -> Any:
    return func.hashtextextended(_lock_of(project_id), 0)


# -- the limit of a project --------------------------------------------------------------------------------------------


def read_limit(tx: Transaction, project_id: str) -> tuple[int, int | None]:
    """Return the number of a project's jobs that run, and the limit; None if there is no limit."""
    limit = select(queue_share.c.most_running).where(queue_share.c.project_id == project_id).scalar_subquery()
    row = tx.execute(select(count_leased(bindparam("of", project_id)).label("running"), limit.label("limit"))).one()
    return row.running, row.limit


def set_limit(tx: Transaction, project_id: str, most_running: int | None) -> None:
    """Set the limit of a project, or remove it. Jobs that run already continue, even if they are more than the limit.

    The caller must have checked that the principal is an administrator.
    """
    tx.lock(_lock_of(project_id))
    tx.execute(tx.insert_or_ignore(queue_share, {"project_id": project_id}))
    tx.execute(update(queue_share).where(queue_share.c.project_id == project_id).values(most_running=most_running))
