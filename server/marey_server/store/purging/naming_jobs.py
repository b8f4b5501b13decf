"""Jobs that name items: as inputs, in their parameters, or as results."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass

from sqlalchemy import Text, cast, func, or_, select

from marey_server.store.ids import ids_in
from marey_server.store.jobs.reading import UNFINISHED
from marey_server.store.tables import job
from marey_server.store.transaction import Transaction


@dataclass(frozen=True, slots=True)
class NamingJob:
    """Job that names items."""

    id: str
    parent: str | None
    kind: str
    state: str
    """State of the job, or of its parent job if it is a task."""
    named: frozenset[str]
    """Ids of items in its inputs, parameters and results."""


def jobs_naming(
    tx: Transaction, project_id: str, items: Collection[str], *, unfinished: bool = False
) -> Iterator[NamingJob]:
    """Yield the jobs of a project that name one of `items`.

    With `unfinished`, only those are searched that have not ended, or whose parent job has not ended.
    The texts of all jobs of the project are searched, because ids can be anywhere in parameters.
    """
    parent = job.alias("parent")
    statement = (
        select(
            job.c.id, job.c.parent_id, job.c.kind, func.coalesce(parent.c.state, job.c.state).label("state"),
            (cast(job.c.inputs, Text) + cast(job.c.params, Text) + func.coalesce(cast(job.c.outputs, Text), "")).label(
                "text"
            ),
        )
        .outerjoin(parent, parent.c.id == job.c.parent_id)
        .where(job.c.project_id == project_id)
        .order_by(job.c.id)
        .execution_options(yield_per=10)
    )  # fmt: skip
    if unfinished:
        statement = statement.where(or_(job.c.state.in_(UNFINISHED), parent.c.state.in_(UNFINISHED)))
    wanted = frozenset(items)
    for row in tx.execute(statement):
        if named := wanted.intersection(ids_in(row.text)):
            yield NamingJob(row.id, row.parent_id, row.kind, row.state, named)
