"""Lock that excludes purges during writes that a purge could break, such as a write that refers to items.

Such a write reads items and then stores something that refers to them: a revision, an input of a job, a commit. Between
reading and storing, another request could delete and purge the items. So each of these writes first acquires a lock
that excludes purges of its project. The write does so before it reads items and before it locks any row. Many such
writes run side by side. A purge waits until the writes that hold the lock have ended, and later writes wait until the
purge has ended. While a purge or such a write waits for this lock, it has locked no row that the other side needs. So
there are no deadlocks.

A commit is prepared in one transaction and recorded in a later one. The preparation reads the time of the project's
last purge. Recording fails if another purge has followed.

On SQLite, where writes run one after another, only this rule for commits is needed.
"""

from __future__ import annotations

from collections.abc import Iterable

from sqlalchemy import func, select

from marey_server.errors import ConflictProblem
from marey_server.store.tables import item, job
from marey_server.store.transaction import Transaction, in_lists

PURGED_MEANWHILE = "purged-meanwhile"
"""Code of the error for a request that was prepared before a purge, and can be sent again."""


def last_purge(tx: Transaction, project_id: str) -> int:
    """Return the time of the last purge of a project in microseconds, 0 if there was none."""
    statement = select(func.max(item.c.purged_us)).where(item.c.project_id == project_id, item.c.purged_us.is_not(None))
    return int(tx.execute(statement).scalar() or 0)


def hold_off_purges(tx: Transaction, *project_ids: str) -> None:
    """Prevent purges of these projects until this write ends; several writes may do this at the same time.

    Must be called before the write reads items or locks rows.
    """
    for project_id in sorted(set(project_ids)):
        tx.lock(f"purge:{project_id}", shared=True)


def hold_off_purges_of_jobs(tx: Transaction, job_ids: Iterable[str]) -> None:
    """Prevent purges, as `hold_off_purges` does, of the projects of jobs that this write is going to end.

    This is necessary because the end of a job can publish items, and use them as inputs of waiting jobs.
    """
    if not tx.is_postgres:
        return
    if tx.principal.project_id is not None:  # of the attempt whose job ends
        hold_off_purges(tx, tx.principal.project_id)
        return
    wanted = sorted(set(job_ids))
    found: set[str] = set()
    for some in in_lists(wanted):
        found.update(tx.execute(select(job.c.project_id).where(job.c.id.in_(some)).distinct()).scalars())
    hold_off_purges(tx, *found)


def require_no_purge_since(tx: Transaction, project_id: str, last: int) -> None:
    """Prevent purges until this write ends, and raise `ConflictProblem` if the project was purged after `last`.

    `last` is the time that `last_purge` returned when the request was prepared.
    """
    hold_off_purges(tx, project_id)
    if last_purge(tx, project_id) != last:
        raise ConflictProblem(
            "Items of the project were purged while the request was prepared; send the request again.",
            code=PURGED_MEANWHILE,
        )


def begin_purge(tx: Transaction, project_id: str) -> int:
    """Lock a project for a purge until the transaction ends, and return the time of the purge in microseconds.

    The call first waits until the running writes that hold off purges of the project (`hold_off_purges`) have ended.
    While the project is locked, later writes of this kind, and other purges of the project, wait. Each purge of a
    project has a later time than the purge before it.
    """
    tx.lock(f"purge:{project_id}")
    return max(tx.now_us, last_purge(tx, project_id) + 1)
