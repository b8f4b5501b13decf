"""Turns of projects: from which projects a claim takes its jobs, and how many from each.

A claim serves the project with the fewest running jobs first, and among equals the one that was served least recently.
So a project with many queued jobs delays the others only by the jobs that it runs already.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any, NamedTuple

from sqlalchemy import (
    CTE,
    BigInteger,
    ColumnElement,
    FromClause,
    Select,
    and_,
    bindparam,
    exists,
    func,
    literal_column,
    select,
    update,
)

from marey_schemas.access import Role
from marey_server.store.database.prepared import Prepared
from marey_server.store.jobs.fencing import QUEUED
from marey_server.store.quotas.running_jobs import count_leased, key_of_lock, name_of_lock
from marey_server.store.tables import job, member, project, queue_share
from marey_server.store.transaction import Transaction


class Restriction(NamedTuple):
    """Conditions that a claim puts on the jobs, besides kinds and labels.

    `one_job`: only the named job. `named_projects`: only jobs of the named projects. `own_projects`: only jobs of
    projects in which the caller is a maintainer or an owner.
    """

    one_job: bool
    named_projects: bool
    own_projects: bool


@dataclass(slots=True, eq=False)
class Turn:
    """Project that has jobs for a claim, with the numbers that decide when it is its turn."""

    project_id: str
    running: int
    most_running: int | None
    """Greatest number of running jobs, or None if there is no limit."""
    served_us: int | None
    """Time of the last claim of one of its jobs, or None if the project has no row in `queue_share`."""

    def rank(self) -> tuple[int, int, str]:
        """Return the sort key of the turn; the turn with the smallest key comes first."""
        return self.running, self.served_us or 0, self.project_id

    @property
    def places(self) -> int | None:
        """Number of jobs that may start now, or None if there is no limit."""
        return None if self.most_running is None else max(0, self.most_running - self.running)


# -- which projects have jobs for a claim ------------------------------------------------------------------------------


def is_claimable(candidate: FromClause) -> ColumnElement[bool]:
    """Return the SQL condition that a job is queued, due, and suits the kinds and the labels of the claim."""
    return and_(
        candidate.c.state == QUEUED,
        candidate.c.run_at_us <= bindparam("now_us", type_=BigInteger),
        candidate.c.kind.in_(bindparam("kinds", expanding=True)),
        candidate.c.labels_key.in_(bindparam("label_keys", expanding=True)),
    )


def claim_order(candidate: FromClause) -> tuple[ColumnElement[Any], ...]:
    """Return the order in which the jobs of a project are claimed."""
    return candidate.c.priority.desc(), candidate.c.run_at_us, candidate.c.id


def _is_workable(project_id: ColumnElement[str], restriction: Restriction) -> ColumnElement[bool]:
    """Return the SQL condition that the caller, as a worker, may run jobs of a project."""
    conditions = [project.c.id == project_id, project.c.deleted_us.is_(None)]
    if restriction.named_projects:
        conditions.append(project.c.name.in_(bindparam("project_names", expanding=True)))
    if restriction.own_projects:
        roles = (Role.MAINTAINER.value, Role.OWNER.value)
        mine = (member.c.project_id == project.c.id, member.c.user_id == bindparam("user"), member.c.role.in_(roles))
        conditions.append(exists().where(*mine))
    return exists().where(*conditions)


def projects_with_queued_jobs() -> CTE:
    """Return a query for the ids of the projects with queued jobs; the last row contains null in place of an id.

    Each step looks up the next id in an index, so the cost grows with the number of projects, not of jobs.
    """
    first, later = job.alias("first"), job.alias("later")
    found = (
        select(func.min(first.c.project_id).label("project_id"))
        .where(first.c.state == QUEUED)
        .cte("waiting", recursive=True)
    )
    following = (
        select(func.min(later.c.project_id))
        .where(later.c.state == QUEUED, later.c.project_id > found.c.project_id)
        .scalar_subquery()
    )
    return found.union_all(select(following).where(found.c.project_id.is_not(None)))


def _turns_statement(restriction: Restriction) -> Select[*tuple[Any, ...]]:
    candidate = job.alias("candidate")
    source: FromClause
    if restriction.one_job:
        one = select(candidate.c.project_id).where(candidate.c.id == bindparam("one_job"), is_claimable(candidate))
        source = one.subquery("waiting")
        conditions: list[ColumnElement[bool]] = []
    else:
        source = projects_with_queued_jobs()
        first = (
            select(candidate.c.id)
            .where(candidate.c.project_id == source.c.project_id, is_claimable(candidate))
            .order_by(*claim_order(candidate))  # so that the database reads `ix_job_claim`, up to the first such job
            .limit(literal_column("1"))
            .scalar_subquery()
        )
        conditions = [source.c.project_id.is_not(None), first.is_not(None)]
    return (
        select(
            source.c.project_id,
            count_leased(source.c.project_id).label("running"),
            queue_share.c.most_running,
            queue_share.c.served_us,
        )
        .select_from(source.outerjoin(queue_share, queue_share.c.project_id == source.c.project_id))
        .where(*conditions, _is_workable(source.c.project_id, restriction))
    )


_TURNS = {
    restriction: Prepared(_turns_statement(restriction))
    for restriction in (Restriction(*flags) for flags in product((False, True), repeat=3))
}


def statement_of_turns(restriction: Restriction) -> Prepared:
    """Return the statement that finds the projects with jobs for a claim; `turns_of` takes its rows."""
    return _TURNS[restriction]


def turns_of(rows: Iterable[Any]) -> list[Turn]:
    """Convert the rows of the statement from `statement_of_turns` to turns."""
    return [Turn(row.project_id, row.running, row.most_running, row.served_us) for row in rows]


# -- who is next -------------------------------------------------------------------------------------------------------


def next_projects(turns: Sequence[Turn], most: int) -> Iterator[Turn]:
    """Yield, for each of the `most` jobs of a claim, the project whose turn it is, as if each project had enough jobs.

    A project is left out as soon as it reaches its limit of running jobs. So fewer than `most` values may be yielded.
    """
    order = [(*turn.rank(), turn) for turn in turns if turn.places != 0]
    heapq.heapify(order)
    for _ in range(most):
        if not order:
            return
        running, served_us, project_id, turn = order[0]
        yield turn
        if turn.most_running is not None and running + 1 >= turn.most_running:
            heapq.heappop(order)
        else:
            heapq.heapreplace(order, (running + 1, served_us, project_id, turn))


_SERVE = Prepared(
    update(queue_share).where(queue_share.c.project_id == bindparam("of")).values(served_us=bindparam("at_us"))
)
_this_share = queue_share.alias("this_share")
_SERVE_UNLESS_LOCKED = Prepared(
    update(queue_share)
    .where(
        queue_share.c.project_id.in_(
            select(_this_share.c.project_id)
            .where(_this_share.c.project_id == bindparam("of"))
            .with_for_update(skip_locked=True)
        )
    )
    .values(served_us=bindparam("at_us"))
)
"""Statement that stores when a claim served a project, unless another claim has locked the project's row.

The other claim then stores its own time, which is nearly the same. So claims of one project's jobs do not wait for each
other.
"""


def note_served(tx: Transaction, turns: Sequence[Turn], served: Iterable[Turn]) -> None:
    """Record that a claim has served the projects `served`; `turns` are all projects that had jobs.

    Each project gets a different time, in the order of their ranks after the claim. The next claim serves projects with
    equally many running jobs in this order. If only one project had jobs, nothing is recorded, because no other project
    had to wait.
    """
    if len(turns) < 2:
        return
    in_order = sorted(served, key=Turn.rank)
    for turn in in_order:
        if turn.served_us is None:
            tx.execute(tx.insert_or_ignore(queue_share, {"project_id": turn.project_id}))
    statement = _SERVE_UNLESS_LOCKED if tx.is_postgres else _SERVE
    tx.run_each(statement, [{"of": turn.project_id, "at_us": tx.now_us + at} for at, turn in enumerate(in_order)])


# -- jobs of one project, within its limit -----------------------------------------------------------------------------

Take = Callable[[int], list[Any]]
"""Function that claims up to a number of jobs of one project, and returns their rows."""

_NOW = Prepared(
    select(queue_share.c.most_running, count_leased(queue_share.c.project_id).label("running")).where(
        queue_share.c.project_id == bindparam("of")
    )
)


def take_within_limit(tx: Transaction, turn: Turn, most: int, take: Take, *, may_wait: bool) -> list[Any]:
    """Claim up to `most` jobs of a project, but not more than its limit allows; return the rows of the claimed jobs.

    On Postgres, claims of a project with a limit run one after another: each claim locks the project, and then counts
    the running jobs again. With `may_wait`, the claim waits for the lock. Without it, nothing is claimed if another
    claim has the lock. `may_wait` is only allowed for a claim that holds no such lock, so that no two claims wait for
    each other. On SQLite, there is only one writer at a time.
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
