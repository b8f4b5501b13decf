"""Propagates the end of a job.

The end of a job affects the jobs that depend on it, its parent job, and the jobs that wait to share its result. Rows
are locked downstream: a job before its parent job and before its dependants.

A job may have thousands of dependants, also indirect ones, and other writes must not wait until all of them have ended.
So one transaction propagates a limited number of ends. It marks the remaining jobs, whose ends later transactions
propagate (`propagate_rest`), also after a restart of the server.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Sequence
from dataclasses import replace
from itertools import takewhile
from typing import Any

from sqlalchemy import Row, and_, bindparam, false, func, null, select, update

from marey_schemas.event_kinds import OrdinaryEventKind
from marey_schemas.queue.jobs import JobState
from marey_schemas.sizes import batched
from marey_server import faults
from marey_server.store.database.prepared import Prepared, padded
from marey_server.store.jobs import late_inputs, result_cache
from marey_server.store.jobs.endings import ENDED_COLUMNS, Ended, as_ended, dependency_failure, end_jobs
from marey_server.store.jobs.events import emit_job_events, wake_watchers
from marey_server.store.jobs.fan_out import gather
from marey_server.store.jobs.fencing import RUNNING, WAITING
from marey_server.store.jobs.result_cache import READY_COLUMNS
from marey_server.store.purge_lock import hold_off_purges
from marey_server.store.tables import job, job_dependency
from marey_server.store.transaction import Transaction, in_lists
from marey_server.store.wakeups import ENDS_TO_PROPAGATE, wakeups

PAGE = 1000
"""Greatest number of ended jobs in one statement."""
MOST_AT_ONCE = 200
"""Number of ended jobs and steps, added up, after which a transaction leaves further ends to later transactions.

A step propagates the ends of up to `PAGE` jobs. `MOST_AT_ONCE` is also the greatest number of dependants that one step
updates.
"""


def propagate_ends(tx: Transaction, ended: Iterable[Ended]) -> None:
    """Propagate the ends of jobs to dependants, parent jobs and jobs that share a result, until no further job ends.

    The parent jobs of `ended` are updated in this transaction. If there are many dependants, later transactions end or
    queue some of them, in the order in which a single transaction would have done this.
    """
    queue = list(ended)
    unmoved, queue = _propagate(tx, queue, required=len(queue), most=MOST_AT_ONCE)
    _leave(tx, unmoved, announced=True)
    _leave(tx, queue, announced=False)


def propagate_rest(tx: Transaction) -> bool:
    """Propagate some of the ends that earlier transactions have left, the oldest first; return whether there were any.

    Events have the same actor as those of the earlier transaction.
    """
    tx.lock("propagation")
    most = {"most": MOST_AT_ONCE}
    projects = {row.project_id for row in tx.execute(_REST, most)}
    hold_off_purges(tx, *projects)
    found = tx.execute(_REST, most).all()  # again, because a purge may have deleted some
    if not found:
        return False
    how, rank = found[0].propagation, found[0].propagation_rank
    rows = list(takewhile(lambda row: row.propagation == how and row.project_id in projects, found))
    if not rows:  # the first was marked in the meantime, in a project that may be purged now
        return True
    ended = [replace(as_ended(row), shareable=how["shareable"]) for row in rows]
    unmark = update(job).where(job.c.id.in_([one.id for one in ended]))
    tx.execute(unmark.values(propagation=null(), propagation_rank=None))
    tx.continued_for = how["actor"]
    ends_here = len(rows) == len(found) < MOST_AT_ONCE  # otherwise, others come before jobs that end now
    further = MOST_AT_ONCE if ends_here else 0
    if how["announced"]:
        following, is_complete = _move_dependants(tx, ended)
        unmoved, queue = _propagate(tx, following, required=0, most=further if is_complete else 0)
        unmoved += [] if is_complete else ended
    else:
        unmoved, queue = _propagate(tx, ended, required=len(ended), most=further)
    _leave(tx, unmoved, announced=True, rank=rank)
    _leave(tx, queue, announced=False)
    faults.point("propagation.before_commit")
    tx.after_commit(lambda: faults.point("propagation.after_commit"))
    return True


def postpone_rest(tx: Transaction) -> None:
    """Put the ends that `propagate_rest` would propagate next behind all others, after an unexpected error."""
    tx.lock("propagation")
    found = tx.execute(_REST, {"most": 1}).first()
    if found is not None:
        same = update(job).where(job.c.propagation_rank == found.propagation_rank)
        tx.execute(same.values(propagation_rank=_next_rank(tx)))


def _next_rank(tx: Transaction) -> int:
    last = select(func.max(job.c.propagation_rank)).where(job.c.propagation_rank.is_not(None))
    return (tx.execute(last).scalar() or 0) + 1


_REST = (
    select(*ENDED_COLUMNS, job.c.propagation, job.c.propagation_rank)
    .where(job.c.propagation_rank.is_not(None))
    .order_by(job.c.propagation_rank, job.c.id)
    .limit(bindparam("most"))
)


def _propagate(tx: Transaction, queue: list[Ended], *, required: int, most: int) -> tuple[list[Ended], list[Ended]]:
    """Propagate the ends of the first `required` jobs in `queue`, and of at most about `most` further jobs.

    A step propagates the ends of up to `PAGE` jobs, and counts as one job itself. Returns the jobs some of whose
    dependants are not updated yet, and the jobs whose ends are not propagated yet.
    """
    unmoved: list[Ended] = []
    while queue and (required > 0 or (most > 0 and not unmoved)):
        page, queue = queue[:PAGE], queue[PAGE:]
        _announce(tx, page)
        of_tasks = _count_tasks(tx, page)
        following, is_complete = _move_dependants(tx, page)
        unmoved += [] if is_complete else page
        queue += of_tasks + following
        required += len(of_tasks) - len(page)
        most -= len(page) + 1
    return unmoved, queue


def _leave(tx: Transaction, ended: Sequence[Ended], *, announced: bool, rank: int | None = None) -> None:
    """Mark ended jobs, so that later transactions propagate their ends, by default after all other marked jobs.

    `announced` says whether only dependants of these jobs remain to be updated.
    """
    if not ended:
        return
    if rank is None:
        rank = _next_rank(tx)
    for shareable in (True, False):
        how = {"actor": tx.actor, "shareable": shareable, "announced": announced}
        for some in in_lists([end.id for end in ended if end.shareable == shareable]):
            tx.execute(update(job).where(job.c.id.in_(some)).values(propagation=how, propagation_rank=rank))
    tx.after_commit(lambda: wakeups.announce([ENDS_TO_PROPAGATE]))


def make_ready(tx: Transaction, rows: Sequence[Row[Any]]) -> list[Ended]:
    """Queue waiting jobs whose dependencies have succeeded, start their tasks, or give them a cached result.

    First, inputs that are outputs of other jobs (late inputs) are pinned to exact revisions. The rows hold
    `READY_COLUMNS`. Returns the jobs that ended as a result.
    """
    ended = late_inputs.pin_late_inputs(tx, [row.id for row in rows if row.unbound])
    for row in rows:
        if row.size is not None:
            ended += _open_fan_out(tx, row)
    single = [row for row in rows if row.size is None and not row.unbound]
    for page in batched(single, PAGE):
        ended += result_cache.admit(tx, page)
    return ended


_ENDINGS: dict[str, OrdinaryEventKind] = {
    JobState.SUCCEEDED: "job.succeeded",
    JobState.FAILED: "job.failed",
    JobState.CANCELLED: "job.cancelled",
}
"""Kinds of events by the state in which jobs ended."""


def _count(tx: Transaction, ended: Sequence[Ended]) -> None:
    for one in ended:
        tx.observer.count_ended(one.state, None if one.failure is None else one.failure["reason"])


def _announce(tx: Transaction, ended: Sequence[Ended]) -> None:
    for state in sorted({end.state for end in ended}):
        emit_job_events(
            tx,
            _ENDINGS[state],
            [(end.project_id, end.id, _facts_of(end)) for end in ended if end.state == state],
        )
    wake_watchers(tx, [end.id for end in ended])
    tx.after_commit(lambda: _count(tx, ended))


def _facts_of(end: Ended) -> dict[str, Any]:
    """Return the body of the event that reports the end of a job.

    It is the failure of the job, or names the commit with its outputs, or is empty.
    """
    return end.failure or ({} if end.commit is None else {"commit": end.commit})


# -- dependants -------------------------------------------------------------------------------------------------------


_OF_ENDED = (
    job_dependency.c.on_job_id.in_(bindparam("ended", expanding=True)),
    job_dependency.c.satisfied == false(),
)
_DEPENDANTS = Prepared(
    select(job_dependency.c.job_id)
    .distinct()
    .where(*_OF_ENDED)
    .order_by(job_dependency.c.job_id)
    .limit(bindparam("most"))
)
_RELEASE = Prepared(
    update(job_dependency)
    .where(*_OF_ENDED, job_dependency.c.job_id.in_(bindparam("dependants", expanding=True)))
    .values(satisfied=True)
    .returning(job_dependency.c.job_id, job_dependency.c.on_job_id)
)
_WAITING_JOBS = Prepared(
    select(*READY_COLUMNS, job.c.parent_id, job.c.dependencies_left, job.c.on_failure)
    .where(job.c.id.in_(bindparam("ids", expanding=True)), job.c.state == WAITING)
    .order_by(job.c.id)
    .with_for_update()
)


def _move_dependants(tx: Transaction, ended: Sequence[Ended]) -> tuple[list[Ended], bool]:
    """Update the first `MOST_AT_ONCE` jobs that depend on ended jobs.

    Returns the jobs that have ended as a result, and whether no dependants are left.
    """
    ends = {end.id: end for end in ended}
    ids = [row.job_id for row in tx.run(_DEPENDANTS, {"ended": padded(ends), "most": MOST_AT_ONCE})]
    if not ids:
        return [], True
    upstream: dict[str, list[Ended]] = {}
    for row in tx.run(_RELEASE, {"ended": padded(ends), "dependants": padded(ids)}):
        upstream.setdefault(row.job_id, []).append(ends[row.on_job_id])
    # Without those that another transaction has released since: they do not share the result of these jobs any more.
    waiting = tx.run(_WAITING_JOBS, {"ids": padded(upstream)}) if upstream else []
    return _move(tx, waiting, upstream), len(ids) < MOST_AT_ONCE


def _move(tx: Transaction, rows: Sequence[Row[Any]], upstream: dict[str, list[Ended]]) -> list[Ended]:
    """Update waiting jobs after jobs on which they depend have ended; return the jobs that have ended as a result.

    `upstream` maps the id of each waiting job to the ended jobs. Jobs whose dependencies have all succeeded are made
    ready, and jobs of which a dependency did not succeed are ended. Jobs that waited to share a result get the result
    or, if the other job did not succeed, wait for another identical job or are queued. If the result must not be
    shared, all jobs that waited for it are queued, because their own results can probably not be shared either.
    """
    left: dict[str, int] = {}
    unrunnable: list[tuple[Row[Any], Ended]] = []
    shared: list[Row[Any]] = []
    orphans: list[Row[Any]] = []
    alone: list[Row[Any]] = []
    for row in rows:
        missed = [end for end in upstream[row.id] if not end.succeeded]
        if row.cached_from is not None:
            (orphans if missed else shared if upstream[row.id][0].shareable else alone).append(row)
        elif missed:
            unrunnable.append((row, missed[0]))
        else:
            left[row.id] = row.dependencies_left - len(upstream[row.id])
    following = _end_unrunnable(tx, unrunnable)
    _store_counts(tx, left)
    following += make_ready(tx, [row for row in rows if left.get(row.id) == 0])
    following += result_cache.share(tx, shared)
    result_cache.stop_sharing(tx, [*orphans, *alone])
    result_cache.enqueue(tx, alone)
    return following + make_ready(tx, orphans)


def _store_counts(tx: Transaction, left: dict[str, int]) -> None:
    if left:
        statement = update(job).where(job.c.id == bindparam("of_job")).values(dependencies_left=bindparam("left"))
        tx.execute(statement, [{"of_job": job_id, "left": count} for job_id, count in left.items()])


_END_UNRUNNABLE = Prepared(
    update(job)
    .where(job.c.id == bindparam("of_job"), job.c.state == WAITING)
    .values(
        state=bindparam("its_state"),
        failure=bindparam("its_failure"),
        finished_us=bindparam("now"),
        rev=job.c.rev + 1,
    )
)


def _end_unrunnable(tx: Transaction, unrunnable: Sequence[tuple[Row[Any], Ended]]) -> list[Ended]:
    """End locked waiting jobs, each because a job on which it depends did not succeed; return the ended jobs.

    `unrunnable` pairs each waiting job with the job that did not succeed. The waiting job fails, or is cancelled if its
    `on_failure` is `skip`. Its tasks are cancelled, and returned, too. All waiting jobs end in one statement, because
    other writes wait while thousands end.
    """
    parents = [row.id for row, _ in unrunnable if row.size is not None]
    tasks = end_jobs(tx, and_(job.c.parent_id.in_(parents), job.c.state == WAITING), "cancelled") if parents else []
    ended = [
        Ended(row.id, row.project_id, "cancelled", row.parent_id)
        if row.on_failure == "skip"
        else Ended(row.id, row.project_id, "failed", row.parent_id, dependency_failure(cause.id, cause.state))
        for row, cause in unrunnable
    ]
    if ended:
        tx.run_each(
            _END_UNRUNNABLE,
            [{"of_job": one.id, "its_state": one.state, "its_failure": one.failure, "now": tx.now_us} for one in ended],
        )
    return [*tasks, *ended]


# -- fan-out ----------------------------------------------------------------------------------------------------------


def _open_fan_out(tx: Transaction, row: Row[Any]) -> list[Ended]:
    """Start a parent job, and make its waiting tasks ready; return the jobs that ended as a result."""
    tasks = tx.execute(
        select(*READY_COLUMNS).where(job.c.parent_id == row.id, job.c.state == WAITING).order_by(job.c.position)
    ).all()
    tx.execute(
        update(job)
        .where(job.c.id == row.id, job.c.state == WAITING)
        .values(state="running", started_us=tx.now_us, dependencies_left=len(tasks), rev=job.c.rev + 1)
    )
    if not tasks:  # every task was cancelled before it could start
        return gather(tx, row.id)
    return make_ready(tx, tasks)


def _count_tasks(tx: Transaction, ended: Sequence[Ended]) -> list[Ended]:
    """Update the number of unfinished tasks of parent jobs; end the parent jobs whose last task has ended.

    Returns the jobs that ended as a result.
    """
    following = _stop_idle_tasks(tx, {end.parent_id for end in ended if end.state == "failed"} - {None})
    for parent_id, count in sorted(Counter(end.parent_id for end in ended if end.parent_id is not None).items()):
        left = tx.execute(
            update(job)
            .where(job.c.id == parent_id, job.c.state == RUNNING)
            .values(dependencies_left=job.c.dependencies_left - count, rev=job.c.rev + 1)
            .returning(job.c.dependencies_left)
        ).scalar_one_or_none()
        if left == 0:
            following += gather(tx, parent_id)
    return following


def _stop_idle_tasks(tx: Transaction, parents: Collection[str | None]) -> list[Ended]:
    """Cancel those tasks of the given parent jobs that have not started, and return the cancelled tasks.

    Called when a task of each of these jobs has failed. Tasks are cancelled only if a worker would have combined the
    results of all tasks, so that the results of the remaining tasks are not needed any more.
    """
    if not parents:
        return []
    gathered = select(job.c.id).where(job.c.id.in_(parents), job.c.gathers)
    idle = and_(job.c.parent_id.in_(gathered), job.c.state.in_(("queued", "waiting")))
    tx.execute(select(job.c.id).where(idle).order_by(job.c.id).with_for_update()).all()  # in the order of all others
    return end_jobs(tx, idle, "cancelled")
