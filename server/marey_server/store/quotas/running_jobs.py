"""Limit on the number of jobs of a project that run at the same time."""

from __future__ import annotations

from sqlalchemy import ColumnElement, bindparam, func, select, update

from marey_server.store.tables import LEASED, job, queue_share
from marey_server.store.transaction import Transaction


def count_leased(project_id: ColumnElement[str]) -> ColumnElement[int]:
    """Return the SQL expression for the number of a project's jobs that workers run."""
    leased = job.alias("leased")
    return select(func.count()).select_from(leased).where(leased.c.project_id == project_id, LEASED).scalar_subquery()


def name_of_lock(project_id: str) -> str:
    """Return the name of the lock on a project's limit of running jobs; claims and changes of the limit hold it."""
    return f"running jobs {project_id}"


def key_of_lock(project_id: str) -> ColumnElement[int]:
    """Return the SQL expression for the number by which Postgres identifies the lock `name_of_lock`."""
    return func.hashtextextended(name_of_lock(project_id), 0)


def read_limit(tx: Transaction, project_id: str) -> tuple[int, int | None]:
    """Return the number of a project's jobs that run, and the limit; None if there is no limit."""
    limit = select(queue_share.c.most_running).where(queue_share.c.project_id == project_id).scalar_subquery()
    row = tx.execute(select(count_leased(bindparam("of", project_id)).label("running"), limit.label("limit"))).one()
    return row.running, row.limit


def set_limit(tx: Transaction, project_id: str, most_running: int | None) -> None:
    """Set the limit of a project, or remove it. Jobs that run already continue, even if they are more than the limit.

    The caller must have checked that the principal is an administrator.
    """
    tx.lock(name_of_lock(project_id))
    tx.execute(tx.insert_or_ignore(queue_share, {"project_id": project_id}))
    tx.execute(update(queue_share).where(queue_share.c.project_id == project_id).values(most_running=most_running))
