"""Exclusion of purges during commits: a commit never records the content of an item that a purge deletes meanwhile.

A commit is prepared in one transaction and recorded in a later one. It remembers the last purge of the project when it
is prepared. Recording fails if another purge has followed, and lets no purge begin before its own end.
"""

from __future__ import annotations

from sqlalchemy import func, select

from marey_server.errors import ConflictProblem
from marey_server.store.tables import item
from marey_server.store.transaction import Transaction


def last_purge(tx: Transaction, project_id: str) -> int:
    """Return the time of the last purge of a project in microseconds, 0 if there was none."""
    statement = select(func.max(item.c.purged_us)).where(item.c.project_id == project_id, item.c.purged_us.is_not(None))
    return int(tx.execute(statement).scalar() or 0)


def hold_off_purges(tx: Transaction, project_id: str) -> None:
    """Let no purge of the project begin before the end of this write; several writes may do this at the same time."""
    tx.lock(f"purge:{project_id}", shared=True)


def require_no_purge_since(tx: Transaction, project_id: str, last: int) -> None:
    """Hold off purges, and raise `ConflictProblem` if the last purge of the project was not at the time `last`."""
    hold_off_purges(tx, project_id)
    if last_purge(tx, project_id) != last:
        raise ConflictProblem(
            "Items of the project were purged while the version was computed; send the request again.",
            code="purged-meanwhile",
        )


def begin_purge(tx: Transaction, project_id: str) -> int:
    """Wait for all commits that are being recorded, exclude others, and return the time of this purge.

    Each purge of a project has a later time than the one before it.
    """
    tx.lock(f"purge:{project_id}")
    return max(tx.now_us, last_purge(tx, project_id) + 1)
