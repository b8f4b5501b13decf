"""Jobs that wait for a pod of their own, and the states of the jobs for which pods exist."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from sqlalchemy import Row, case, exists, func, literal, or_, select, update

from marey_schemas.queue.jobs import LONGEST_NOTE, JobState, Progress
from marey_schemas.queue.own_pods import OWN_POD_LABEL
from marey_schemas.queue.scripts import SCRIPT
from marey_server.access.labels import labels_key, labels_of
from marey_server.store.jobs.claiming.turns import claim_order
from marey_server.store.jobs.fencing import QUEUED, RUNNING
from marey_server.store.jobs.policy import SECOND_US
from marey_server.store.quotas.running_jobs import count_leased
from marey_server.store.tables import job, project, queue_share
from marey_server.store.transaction import Transaction, in_lists

_LABELS = literal(",") + job.c.labels_key
_OWN_POD = f",{labels_key({OWN_POD_LABEL: ''})}"
"""Text that `_LABELS` contains if a job has the label `OWN_POD_LABEL`.

The leading comma excludes labels whose longer names end with this name.
"""


@dataclass(frozen=True)
class WaitingJob:
    """Queued job that needs a pod of its own.

    For a task, `parent` is the parent job, `position` the place among the tasks of the parent job, and `siblings` the
    number of these tasks. `fence` counts the claims of the job. `image` is the image that the script of the job names,
    if any. `limited` states whether the `project` has a limit of running jobs.
    """

    id: str
    kind: str
    fence: int
    time_limit_s: int
    memory_limit_mb: int
    labels: Mapping[str, str]
    image: str | None = None
    parent: str | None = None
    position: int | None = None
    siblings: int = 0
    project: str = ""
    limited: bool = False


def read_waiting(
    tx: Transaction, limit: int, served: Collection[str] = (), split: Mapping[str, int] | None = None
) -> list[WaitingJob]:
    """Return the first `limit` jobs that could start now and need a pod of their own.

    Projects take turns; the jobs of a project are in the order of claims.

    A job is left out if its project has reached its limit of running jobs, or if its concurrency key is in use.

    Parameters
    ----------
    served : ids of jobs that have a pod already
    split : ids of parent jobs whose tasks have a pod each, with the number of these pods that can run at once; of their
        tasks, only those that were claimed before are returned
    """
    split = split or {}
    rival, parent = job.alias("rival"), job.alias("parent")
    rival_runs = exists().where(
        rival.c.project_id == job.c.project_id, rival.c.concurrency_key == job.c.concurrency_key,
        rival.c.state == RUNNING,
    )  # fmt: skip
    running = count_leased(job.c.project_id)
    statement = (
        select(
            job.c.id, job.c.kind, job.c.fence, job.c.time_limit_s, job.c.memory_limit_mb, job.c.labels_key,
            job.c.params, job.c.parent_id, job.c.position, job.c.project_id, job.c.concurrency_key,
            parent.c.size.label("siblings"), queue_share.c.most_running, running.label("running"),
        )
        .select_from(
            job.join(project, project.c.id == job.c.project_id)
            .outerjoin(parent, parent.c.id == job.c.parent_id)
            .outerjoin(queue_share, queue_share.c.project_id == job.c.project_id)
        )
        .where(
            job.c.state == QUEUED,
            job.c.run_at_us <= tx.now_us,
            func.replace(_LABELS, _OWN_POD, "") != _LABELS,
            project.c.deleted_us.is_(None),
            or_(queue_share.c.most_running.is_(None), queue_share.c.most_running > running),
            or_(job.c.concurrency_key.is_(None), ~rival_runs),
            job.c.id.not_in(served),
            or_(job.c.parent_id.is_(None), job.c.fence > 0, job.c.parent_id.not_in(split)),
        )
        .order_by(
            func.row_number().over(partition_by=job.c.project_id, order_by=claim_order(job)), *claim_order(job)
        )
        .limit(limit)
    )  # fmt: skip
    unclaimed = [*_unclaimed(tx, served), *_unclaimed_tasks(tx, split)]
    return [_waiting(row) for row in _one_of_each_key(tx.execute(statement).all(), unclaimed)]


def read_unfinished(tx: Transaction, ids: Collection[str]) -> set[str]:
    """Return those of the given jobs that have not ended."""
    unfinished = [state.value for state in JobState if not state.terminal]
    found: set[str] = set()
    for some in in_lists(ids):
        found |= set(tx.execute(select(job.c.id).where(job.c.id.in_(some), job.c.state.in_(unfinished))).scalars())
    return found


def postpone(tx: Transaction, job_id: str, reason: str, pause_s: float, *, tasks: bool) -> bool:
    """Delay a queued job, or with `tasks` all queued tasks of a job, so that none starts in the next `pause_s` seconds.

    The note of the progress of each delayed job is set to `reason`. Returns false if there was no such job or task.
    """
    note = Progress(done=0, note=reason[:LONGEST_NOTE])
    until_us = tx.now_us + round(pause_s * SECOND_US)
    statement = (
        update(job)
        .where((job.c.parent_id if tasks else job.c.id) == job_id, job.c.state == QUEUED)
        .values(
            run_at_us=case((job.c.run_at_us > until_us, job.c.run_at_us), else_=until_us),
            progress=note.model_dump(mode="json"),
            rev=job.c.rev + 1,
        )
        .returning(job.c.id)
    )
    return bool(tx.execute(statement).all())


Unclaimed = tuple[str, str | None]
"""Project and concurrency key of a job whose pod has not claimed it yet."""


def _unclaimed(tx: Transaction, served: Collection[str]) -> Iterator[Unclaimed]:
    """Yield project and concurrency key of those jobs in `served` that their pods have not claimed yet."""
    statement = select(job.c.project_id, job.c.concurrency_key).where(job.c.state == QUEUED)
    for some in in_lists(served):
        for row in tx.execute(statement.where(job.c.id.in_(some))):
            yield row.project_id, row.concurrency_key


def _unclaimed_tasks(tx: Transaction, split: Mapping[str, int]) -> Iterator[Unclaimed]:
    """Yield one entry for each pod of the parent jobs in `split` that has not claimed a task yet."""
    task = job.alias("task")
    running = select(func.count()).where(task.c.parent_id == job.c.id, task.c.state == RUNNING).scalar_subquery()
    statement = select(job.c.id, job.c.project_id, running.label("running"))
    for some in in_lists(split):
        for row in tx.execute(statement.where(job.c.id.in_(some))):
            yield from [(row.project_id, None)] * max(0, split[row.id] - row.running)


def _one_of_each_key(rows: Collection[Row[Any]], unclaimed: Collection[Unclaimed]) -> list[Row[Any]]:
    """Return the rows of those jobs that can all run at the same time.

    A job is left out if an earlier job has the same concurrency key, or if earlier jobs reach the project's limit of
    running jobs. The jobs in `unclaimed` count as earlier jobs, because their pods exist already. Otherwise, pods would
    start that can only wait.
    """
    kept: list[Row[Any]] = []
    keys = {one for one in unclaimed if one[1] is not None}
    chosen = Counter(project_id for project_id, _ in unclaimed)
    for row in rows:
        if row.most_running is not None and row.running + chosen[row.project_id] >= row.most_running:
            continue
        if row.concurrency_key is not None:
            if (row.project_id, row.concurrency_key) in keys:
                continue
            keys.add((row.project_id, row.concurrency_key))
        chosen[row.project_id] += 1
        kept.append(row)
    return kept


def _waiting(row: Row[Any]) -> WaitingJob:
    declaration = (row.params.get("declaration") or {}) if row.kind == SCRIPT else {}
    return WaitingJob(
        row.id, row.kind, row.fence, row.time_limit_s, row.memory_limit_mb, labels_of(row.labels_key),
        declaration.get("image"), row.parent_id, row.position, row.siblings or 0, row.project_id,
        row.most_running is not None,
    )  # fmt: skip
