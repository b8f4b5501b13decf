"""Jobs that name items: as inputs, in their parameters, or as results."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator
from dataclasses import dataclass

from sqlalchemy import Text, cast, or_, select

from marey_schemas.queue.jobs import JobState
from marey_server.store.tables import job
from marey_server.store.transaction import Transaction

UNFINISHED = tuple(state.value for state in JobState if not state.terminal)
_ITEM_ID = re.compile(r"\b[a-z]+_[0-9a-hjkmnp-tv-z]{26}\b")


@dataclass(frozen=True, slots=True)
class NamingJob:
    """Job that names items."""

    id: str
    kind: str
    state: str
    busy: bool
    """Whether the job, or the parent job that will use its results, has not ended."""
    reads: frozenset[str]
    """Ids of items in its inputs and parameters."""
    made: frozenset[str]
    """Ids of items in its results."""

    @property
    def named(self) -> frozenset[str]:
        """The ids of all items that the job names."""
        return self.reads | self.made


def jobs_naming(
    tx: Transaction, project_id: str, items: Collection[str], *, unfinished: bool = False
) -> Iterator[NamingJob]:
    """Yield the jobs of a project that name one of `items`; with `unfinished`, only those that may hold an item.

    The texts of all jobs of the project are searched, because ids can be anywhere in parameters.
    """
    parent = job.alias("parent")
    statement = (
        select(
            job.c.id, job.c.kind, job.c.state, parent.c.state.label("parent_state"),
            (cast(job.c.inputs, Text) + cast(job.c.params, Text)).label("reads"),
            cast(job.c.outputs, Text).label("made"),
        )
        .outerjoin(parent, parent.c.id == job.c.parent_id)
        .where(job.c.project_id == project_id)
        .order_by(job.c.id)
        .execution_options(yield_per=500)
    )  # fmt: skip
    if unfinished:
        statement = statement.where(or_(job.c.state.in_(UNFINISHED), parent.c.state.in_(UNFINISHED)))
    wanted = frozenset(items)
    for row in tx.execute(statement):
        reads = wanted.intersection(_ITEM_ID.findall(row.reads))
        made = wanted.intersection(_ITEM_ID.findall(row.made or ""))
        if reads or made:
            busy = row.state in UNFINISHED or row.parent_state in UNFINISHED
            yield NamingJob(row.id, row.kind, row.state, busy, reads, made)
