"""Jobs that name items: as inputs, in their parameters, or as results."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field

from sqlalchemy import func, select

from marey_server.store.jobs.reading import UNFINISHED
from marey_server.store.tables import job, job_item
from marey_server.store.transaction import Transaction


@dataclass(frozen=True, slots=True)
class JobNaming:
    """Job that names items in its inputs, parameters or results."""

    id: str
    parent: str | None
    kind: str
    state: str
    """State of the job, or of its parent job if it is a task."""
    named: set[str] = field(default_factory=set)
    """Ids of those of the wanted items that the job names."""


def jobs_naming(
    tx: Transaction, project_id: str, items: Collection[str], *, unfinished: bool = False
) -> list[JobNaming]:
    """Return the jobs of a project that name one of `items`, which are ids of items; the jobs are sorted by id.

    With `unfinished`, only jobs are returned that have not ended, or whose parent job has not ended.
    """
    parent = job.alias("parent")
    columns = (job_item.c.item_id, job.c.id, job.c.project_id, job.c.parent_id, job.c.kind)
    statement = (
        select(*columns, job.c.state, func.coalesce(parent.c.state, job.c.state).label("whole"))
        .join(job, job.c.id == job_item.c.job_id)
        .outerjoin(parent, parent.c.id == job.c.parent_id)
        .where(job_item.c.item_id.in_(items))
        .order_by(job_item.c.job_id)
    )
    found: dict[str, JobNaming] = {}
    for row in tx.execute(statement) if items else ():
        if row.project_id != project_id:  # no condition of the query, which SQLite would answer by reading all jobs
            continue
        if unfinished and row.state not in UNFINISHED and row.whole not in UNFINISHED:
            continue
        one = found.setdefault(row.id, JobNaming(row.id, row.parent_id, row.kind, row.whole))
        one.named.add(row.item_id)
    return list(found.values())
