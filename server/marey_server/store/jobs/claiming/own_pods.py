"""Jobs that wait for a pod of their own, and the states of the jobs for which pods exist."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any

from sqlalchemy import Row, exists, func, literal, or_, select

from marey_schemas.queue.jobs import JobState
from marey_schemas.queue.own_pods import OWN_POD_LABEL
from marey_schemas.queue.scripts import SCRIPT
from marey_server.access.labels import labels_key, labels_of
from marey_server.store.jobs.claiming.turns import claim_order
from marey_server.store.jobs.fencing import QUEUED, RUNNING
from marey_server.store.quotas.running_jobs import count_leased
from marey_server.store.tables import job, project, queue_share
from marey_server.store.transaction import Transaction, in_lists

_LABELS = literal(",") + job.c.labels_key
_OWN_POD = f",{labels_key({OWN_POD_LABEL: ''})}"
"""Comma and name of the label; without the comma, a longer name would match. SQLite's LIKE would ignore the case."""


@dataclass(frozen=True)
class WaitingJob:
    """Queued job that needs a pod of its own.

    `parent` and `position` are those of a task, and `siblings` is the number of tasks of its parent. `fence` counts the
    claims of the job. `image` is the image that the script of the job names, if any.
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


def read_waiting(
    tx: Transaction, limit: int, served: Collection[str] = (), split: Collection[str] = ()
) -> list[WaitingJob]:
    """Return the first `limit` jobs that could start now and need a pod of their own, in the order of claims.

    Jobs of a project whose limit of running jobs is reached are left out, and jobs whose concurrency key is in use.

    Parameters
    ----------
    served : ids of jobs that have a pod already
    split : ids of jobs whose tasks have a pod each; tasks that were claimed before are returned nevertheless
    """
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
        .order_by(*claim_order(job))
        .limit(limit)
    )  # fmt: skip
    return [_waiting(row) for row in _one_of_each_key(tx.execute(statement).all(), _unclaimed(tx, served))]


def read_unfinished(tx: Transaction, ids: Collection[str]) -> set[str]:
    """Return those of the given jobs that have not ended."""
    unfinished = [state.value for state in JobState if not state.terminal]
    found: set[str] = set()
    for some in in_lists(ids):
        found |= set(tx.execute(select(job.c.id).where(job.c.id.in_(some), job.c.state.in_(unfinished))).scalars())
    return found


def _unclaimed(tx: Transaction, served: Collection[str]) -> list[Row[Any]]:
    """Return the projects and concurrency keys of the served jobs that their pods have not claimed yet."""
    statement = select(job.c.project_id, job.c.concurrency_key).where(job.c.state == QUEUED)
    return [row for some in in_lists(served) for row in tx.execute(statement.where(job.c.id.in_(some)))]


def _one_of_each_key(rows: Collection[Row[Any]], unclaimed: Collection[Row[Any]]) -> list[Row[Any]]:
    """Return the rows without those that cannot run beside an earlier one, or beyond the limit of their project.

    Jobs whose pods have not claimed them yet count as earlier ones; otherwise, pods would start that can only wait.
    """
    kept: list[Row[Any]] = []
    keys = {(row.project_id, row.concurrency_key) for row in unclaimed if row.concurrency_key is not None}
    chosen = Counter(row.project_id for row in unclaimed)
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
        declaration.get("image"), row.parent_id, row.position, row.siblings or 0,
    )  # fmt: skip
