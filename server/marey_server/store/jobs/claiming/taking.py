"""Claims of jobs of one project, within its limit of running jobs."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from sqlalchemy import bindparam, func, select

from marey_server.store.database.prepared import Prepared
from marey_server.store.jobs.claiming.limits import count_leased, key_of_lock, name_of_lock
from marey_server.store.jobs.claiming.turns import Turn
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
        locked = tx.execute(select(func.pg_try_advisory_xact_lock(key_of_lock(turn.project_id)))).scalar_one()
        return _take_counted(tx, turn, most, take) if locked else []
    with tx.connection.begin_nested() as savepoint:
        tx.lock(name_of_lock(turn.project_id))
        rows = _take_counted(tx, turn, most, take)
        if not rows:
            savepoint.rollback()  # releases the lock, so that the claim may wait for that of another project
    return rows


def _take_counted(tx: Transaction, turn: Turn, most: int, take: Take) -> list[Any]:
    (now,) = tx.run(_NOW, {"of": turn.project_id})
    turn.running, turn.most_running = now.running, now.most_running
    allowed = most if turn.places is None else min(most, turn.places)
    return take(allowed) if allowed else []
