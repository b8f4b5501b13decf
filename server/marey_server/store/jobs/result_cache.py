"""Result cache: identical jobs share one computation, finished or still running.

Jobs are identical if they have the same cache key (`layout`). For each job, shared results are published again, into
the job's own collection. Jobs of different projects share no results. The result of an export is shared only if the
consent has ended for the same clips as when the result was computed.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import Any, NamedTuple

from sqlalchemy import and_, case, delete, insert, not_, or_, select, tuple_, update

from marey_server.access.labels import is_within
from marey_server.errors import ApiProblem
from marey_server.store import blobs
from marey_server.store.jobs import commits, exports, staging
from marey_server.store.jobs.endings import Ended, end_jobs
from marey_server.store.jobs.events import wake_workers
from marey_server.store.jobs.fencing import AUTHOR_MAY_RUN, QUEUED, RUNNING, WAITING
from marey_server.store.jobs.inputs import NamingJob, record_named_items
from marey_server.store.purge_lock import hold_off_purges
from marey_server.store.tables import job, job_dependency, staged_output
from marey_server.store.transaction import Transaction, in_lists
from marey_versions.tree.chunks import DamagedChunk

log = logging.getLogger(__name__)

SHARED_AT_ONCE = 64
"""Greatest number of jobs that get a cached result at submission; the leading process serves the others later."""

MOST_SHARED_OUTPUTS = 256
"""Greatest number of outputs published from the cache in one transaction; a single job may publish more."""

MEASURED_PER_OUTPUT = 5
"""Number of revisions whose facets count as one output, because publishing these facets takes about as long."""


class SharedResult(NamedTuple):
    """Job whose result other jobs share, now or as soon as it has finished.

    `leased` says whether a worker runs the job. The labels, the priority and the concurrency key decide when it runs.
    """

    id: str
    finished: bool
    leased: bool
    labels_key: str
    priority: int
    concurrency_key: str | None

    @classmethod
    def of(cls, one: Any, *, finished: bool = False, leased: bool = False) -> SharedResult:
        """Return the `SharedResult` of a job, which is a database row or a `NewJob`.

        `finished` says whether the job has succeeded, `leased` whether a worker runs it.
        """
        return cls(one.id, finished, leased, one.labels_key, one.priority, one.concurrency_key)

    def is_no_later_than(self, other: Any) -> bool:
        """Return whether this job has finished, or starts no later than the queued job `other` would start.

        Unless this job has finished, the result is False if it needs a label that `other` does not need: perhaps no
        worker has this label. This applies even while a worker runs this job, because the worker may be lost.
        """
        if self.finished:
            return True
        if not is_within(self.labels_key, other.labels_key):
            return False
        waits_for_no_rival = self.concurrency_key in (None, other.concurrency_key)
        return self.leased or (self.priority >= other.priority and waits_for_no_rival)


# -- deciding ---------------------------------------------------------------------------------------------------------

_COMMON_COLUMNS = (
    job.c.id,
    job.c.project_id,
    job.c.cache_key,
    job.c.cache_mode,
    job.c.labels_key,
    job.c.priority,
)
CANDIDATE_COLUMNS = (*_COMMON_COLUMNS, job.c.concurrency_key)
READY_COLUMNS = (*CANDIDATE_COLUMNS, job.c.kind, job.c.size, job.c.unbound, job.c.cached_from)
"""Columns of waiting jobs that are read to make the jobs ready."""

_BY_ID = job.c.id.concat("")
"""SQL expression for the id of a job in ORDER BY; with the plain column, SQLite would read all jobs by their ids."""

_task = job.alias("task")
_KEY_OF_TASKS = select(_task.c.concurrency_key).where(_task.c.parent_id == job.c.id).limit(1).scalar_subquery()
_KEY_OF_SOURCE = case(
    (and_(job.c.size.is_not(None), job.c.state == RUNNING), _KEY_OF_TASKS), else_=job.c.concurrency_key
).label("concurrency_key")
"""SQL expression for the concurrency key of a job; for a parent job whose tasks run, it is the key of the tasks."""
_SOURCE_COLUMNS = (*_COMMON_COLUMNS, _KEY_OF_SOURCE, job.c.state, job.c.lease_expires_us)


def decide(tx: Transaction, candidates: Sequence[Any], *, finished: bool = True) -> dict[str, SharedResult]:
    """Find, for each of `candidates`, the job whose result it can share.

    A candidate is a new job, or a row with `CANDIDATE_COLUMNS`. The result maps ids of candidates to the found jobs;
    candidates that cannot share a result are left out. Of several identical candidates, the first computes the result
    and the others share it. But a candidate never waits for a job that may start later than the candidate itself would.
    Results of finished jobs are used only if `finished` is true.

    The function locks each project of the candidates, so that only one transaction at a time decides for a project. It
    also locks the found jobs, so that none ends before the transaction has recorded who shares its result. A
    transaction that ends a job locks the job before the project; a submission locks the project before the job. So the
    two can deadlock; `Database.write` then runs one of them again.
    """
    asking = [one for one in candidates if one.cache_key is not None and one.cache_mode in ("use", "refresh")]
    if not asking:
        return {}
    for project_id in sorted({one.project_id for one in asking}):
        tx.lock(f"job-cache:{project_id}")
    known = _known_sources(tx, asking, finished=finished)
    sources: dict[str, SharedResult] = {}
    for one in asking:
        identical = known.setdefault((one.project_id, one.cache_key), [])
        source = next((other for other in identical if other.is_no_later_than(one)), None)
        if one.cache_mode == "use" and source is not None:
            sources[one.id] = source
        else:
            identical.insert(0, SharedResult.of(one))
    return sources


def _known_sources(
    tx: Transaction, asking: Sequence[Any], *, finished: bool
) -> dict[tuple[str, str], list[SharedResult]]:
    """Return, for each project and cache key, the jobs whose result can be shared, the best first.

    The newest succeeded job comes first, then the jobs that a worker runs, then the other jobs by priority. Jobs that
    wait for their next attempt after a failure are left out, because a candidate may start earlier.
    """
    keys = sorted({one.cache_key for one in asking if one.cache_mode == "use"})
    projects = sorted({one.project_id for one in asking})
    rests = and_(job.c.fence > 0, job.c.run_at_us > tx.now_us)  # never claimed, it may be of a later transaction
    states = or_(and_(job.c.state == QUEUED, not_(rests)), job.c.state == RUNNING)
    if finished:
        states = or_(states, job.c.state == "succeeded")
    succeeded: dict[tuple[str, str], list[SharedResult]] = {}
    under_way: dict[tuple[str, str], list[SharedResult]] = {}
    for some in in_lists(keys):
        rows = tx.execute(
            select(*_SOURCE_COLUMNS)
            .where(job.c.project_id.in_(projects), job.c.cache_key.in_(some), job.c.cached_from.is_(None), states)
            .order_by(_BY_ID)
            .with_for_update(read=True)
        )
        for row in rows:
            place = (row.project_id, row.cache_key)
            if row.state == "succeeded":
                succeeded[place] = [SharedResult.of(row, finished=True)]
            else:
                leased = row.lease_expires_us is not None
                under_way.setdefault(place, []).append(SharedResult.of(row, leased=leased))
    for sources in under_way.values():
        sources.sort(key=lambda source: (not source.leased, -source.priority))
    return {place: [*succeeded.get(place, ()), *under_way.get(place, ())] for place in {*succeeded, *under_way}}


# -- sharing ----------------------------------------------------------------------------------------------------------


def join(tx: Transaction, joining: Sequence[tuple[Any, SharedResult]]) -> list[Ended]:
    """Let waiting jobs share the results of other jobs, now or as soon as these have finished; return the ended jobs.

    Each pair in `joining` is a waiting job, of which only the `id` is read, and the job whose result it shares.
    """
    if not joining:
        return []
    for row, source in joining:
        tx.execute(
            update(job)
            .where(job.c.id == row.id, job.c.state == WAITING)
            .values(cached_from=source.id, dependencies_left=0 if source.finished else 1, rev=job.c.rev + 1)
        )
    pending = [{"job_id": row.id, "on_job_id": source.id} for row, source in joining if not source.finished]
    if pending:
        tx.execute(insert(job_dependency), pending)
    return share(tx, [row for row, source in joining if source.finished])


def share(tx: Transaction, rows: Sequence[Any]) -> list[Ended]:
    """Give waiting jobs the results of the finished jobs that their `cached_from` names; return the jobs that ended.

    Of `rows`, only the `id` is read. One transaction publishes the results for a limited number of jobs and outputs;
    the leading server process publishes the results for the remaining jobs later. If a result is no longer stored, or
    cannot be published again, the waiting job is queued, or waits for another identical job.
    """
    ended: list[Ended] = []
    unserved: list[str] = []
    for row in rows[:SHARED_AT_ONCE]:
        if tx.shared_outputs >= MOST_SHARED_OUTPUTS:
            break
        of_row = _share_one(tx, row.id)
        ended += of_row
        if not of_row:
            unserved.append(row.id)
    _compute_again(tx, unserved)
    return ended


def share_waiting(tx: Transaction) -> list[Ended]:
    """Give at most `SHARED_AT_ONCE` waiting jobs the results for which they wait, if these exist now.

    Returns the jobs that have ended. If the job that should compute the result was deleted, the waiting job is queued,
    or waits for another identical job.
    """
    source = job.alias("source")
    statement = (
        select(job.c.id, job.c.project_id)
        .outerjoin(source, source.c.id == job.c.cached_from)
        .where(job.c.state == WAITING, job.c.cached_from.is_not(None))
        .where(or_(source.c.state == "succeeded", source.c.id.is_(None)))
        .order_by(_BY_ID)
        .limit(SHARED_AT_ONCE)
    )
    projects = {row.project_id for row in tx.execute(statement)}
    if not projects:
        return []
    hold_off_purges(tx, *projects)
    chosen = statement.where(job.c.project_id.in_(projects)).with_for_update(of=job, skip_locked=True)
    return share(tx, tx.execute(chosen).all())


_UNUSABLE = (ApiProblem, DamagedChunk, LookupError, TypeError, ValueError)
"""Errors because of which a job cannot have a shared result: refusals, and stored data that cannot be read."""


def _share_one(tx: Transaction, job_id: str) -> list[Ended]:
    """Give one job the result for which it waits; return the jobs that ended, none if the job cannot have the result.

    Errors are not raised, because they concern only this job, and not the others that share the result.
    """
    try:
        with tx.connection.begin_nested():
            return _publish_shared(tx, job_id)
    except _UNUSABLE as error:
        if not isinstance(error, ApiProblem):
            log.exception("%s cannot share the result of an identical job", job_id)
        return []


def _publish_shared(tx: Transaction, job_id: str) -> list[Ended]:
    """Publish the shared result as the result of a waiting job, and end this job; return the jobs that ended.

    The waiting job does not end, and the answer is empty, if the result is not to be shared any more (the other job has
    no cache key), or is no longer stored. The same applies if the author of the waiting job may not run jobs any more,
    or if both jobs export clips and the clips whose consent has ended are not the same. The waiting job fails if its
    outputs cannot be committed. Raises the errors of `publish`.
    """
    waits = and_(job.c.id == job_id, job.c.state == WAITING)
    source = job.alias("source")
    own = (*commits.JOB_COLUMNS, job.c.inputs)
    shared = (
        source.c.inputs.label("source_inputs"),
        source.c.fence,
        source.c.result,
        source.c.code_version,
        source.c.environment,
    )
    row = tx.execute(
        select(*own, source.c.id.label("source_id"), *shared)
        .join(source, source.c.id == job.c.cached_from)
        .where(waits, AUTHOR_MAY_RUN, source.c.state == "succeeded", source.c.cache_key.is_not(None))
        .with_for_update(read=True, of=source)  # so that its outputs are not released before they are read
    ).one_or_none()
    if row is None or not exports.may_share(tx, row.kind, row.inputs, row.result):
        return []
    place = (row.source_id, row.fence)
    drafts = staging.staged_drafts(tx, [place]).get(place, {})
    tx.shared_outputs += len(drafts) + staging.number_measured(drafts) // MEASURED_PER_OUTPUT
    named = set(staging.named_blobs(row.result))
    if not staging.renew_documents(tx, drafts) or not blobs.share_with_job(tx, row.id, named):
        return []
    made = commits.publish_outputs(tx, row, staging.with_inputs(drafts, row.source_inputs, row.inputs))
    if made.failure is not None:
        return end_jobs(tx, waits, "failed", dependencies_left=0, failure=made.failure)
    record_named_items(tx, [NamingJob(row.id, outputs=made.outputs)])
    return end_jobs(
        tx,
        waits,
        "succeeded",
        dependencies_left=0,
        result=made.result(row.kind, row.result),
        outputs=made.outputs,
        code_version=row.code_version,
        environment=row.environment,
        **made.columns,
    )


def _compute_again(tx: Transaction, job_ids: Sequence[str]) -> None:
    """Let jobs that cannot share a result compute it: of identical jobs, one is queued and the others wait for it.

    Results of finished jobs are not used, because the jobs could not share such a result before.
    """
    statement = select(*READY_COLUMNS).where(job.c.state == WAITING).order_by(job.c.id)
    for some in in_lists(job_ids):
        rows = tx.execute(statement.where(job.c.id.in_(some))).all()
        stop_sharing(tx, rows)
        admit(tx, rows, finished=False)


def stop_sharing(tx: Transaction, rows: Sequence[Any]) -> None:
    """Remove the links from waiting jobs to the jobs whose results they would have shared.

    The caller must then call `admit` or `enqueue` for the waiting jobs.
    """
    if rows:
        ids = [row.id for row in rows]
        tx.execute(update(job).where(job.c.id.in_(ids)).values(cached_from=None, dependencies_left=0))
        pairs = [(row.id, row.cached_from) for row in rows]
        links = tuple_(job_dependency.c.job_id, job_dependency.c.on_job_id).in_(pairs)  # SQLite finds pairs by no index
        tx.execute(delete(job_dependency).where(job_dependency.c.job_id.in_(ids), links))


def admit(tx: Transaction, rows: Sequence[Any], *, finished: bool = True) -> list[Ended]:
    """Queue jobs whose dependencies have all succeeded, or let them share results; return the jobs that have ended.

    The rows have the columns `READY_COLUMNS`. Results of finished jobs are used only if `finished` is true.
    """
    decisions = decide(tx, rows, finished=finished)
    enqueue(tx, [row for row in rows if row.id not in decisions])
    return join(tx, [(row, decisions[row.id]) for row in rows if row.id in decisions])


def enqueue(tx: Transaction, rows: Sequence[Any]) -> None:
    """Queue waiting jobs whose dependencies have all succeeded; the rows have the columns `READY_COLUMNS`."""
    if rows:
        tx.execute(
            update(job)
            .where(job.c.id.in_([row.id for row in rows]), job.c.state == WAITING)
            .values(state="queued", dependencies_left=0, rev=job.c.rev + 1)
        )
        wake_workers(tx, {row.kind for row in rows})


# -- forgetting -------------------------------------------------------------------------------------------------------


def forget_results(tx: Transaction, job_ids: Sequence[str]) -> None:
    """Forget the results of ended jobs, so that identical jobs compute them again.

    Deletes the drafts that the jobs staged. Of identical jobs that wait to share one of the results, one is queued, and
    the others wait for it.
    """
    for some in in_lists(job_ids):
        tx.execute(delete(staged_output).where(staged_output.c.job_id.in_(some)))
        tx.execute(update(job).where(job.c.id.in_(some)).values(cache_key=None))
        waiting = select(job.c.id).where(job.c.state == WAITING, job.c.cached_from.in_(some)).order_by(job.c.id)
        _compute_again(tx, tx.execute(waiting).scalars().all())
