"""Numbers about the queue and stored data for metrics.

The queries read queued and running jobs, uploads of the last days, and one row for each project. They never
read ended jobs or blobs, so their cost does not grow with the age of a server.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field

from sqlalchemy import case, func, select, text

from marey_schemas.queue import job_kinds
from marey_schemas.queue.workers import Worker
from marey_server.store.jobs.fencing import QUEUED, RUNNING
from marey_server.store.monitoring.workers import HeardWorker, list_workers
from marey_server.store.tables import holding, job, project, upload
from marey_server.store.transaction import Transaction

OTHER = "other"
"""Value of a metric's label in place of all values that the server does not know."""


UNKNOWN = "unknown"
"""Value of a metric's label for workers whose version is unknown, because they claim jobs from another server."""


_SQLITE_BYTES = text("SELECT page_count * page_size FROM pragma_page_count, pragma_page_size")
_POSTGRES_BYTES = text("SELECT pg_database_size(current_database())")


@dataclass(frozen=True)
class QueuedJobs:
    """Number of queued jobs, and the longest time in seconds for which one of them has been ready to run."""

    count: int
    oldest_age_s: float


@dataclass(frozen=True)
class Figures:
    """Numbers about the queue and stored data at one moment."""

    queued: dict[tuple[str, str], QueuedJobs] = field(default_factory=dict)
    """Queued jobs by kind, and by whether they require labels of their worker (`some` or `none`)."""
    running: dict[str, int] = field(default_factory=dict)
    """Number of running attempts by kind."""
    workers: dict[str, int] = field(default_factory=dict)
    """Number of workers that are alive, by version: the version of the server, `other`, or `unknown`."""
    uploads: int = 0
    stored_bytes: int = 0
    """Total size in bytes of the items of all projects, as the quotas count it."""
    database_bytes: int = 0
    """Size of the database in bytes."""


def read_figures(tx: Transaction, heard: Sequence[HeardWorker], version: str) -> Figures:
    """Return the present numbers about the queue and stored data.

    `heard` are the workers that claimed jobs from this process, and `version` is the version of the server.
    """
    alive = [worker for worker in list_workers(tx, heard) if worker.alive]
    unfinished = select(func.count()).where(upload.c.finished_digest.is_(None), upload.c.dropped.is_(False))
    stored = select(func.coalesce(func.sum(holding.c.stored_bytes), 0)).join(
        project, project.c.id == holding.c.owner_id
    )
    return Figures(
        queued=_queued(tx),
        running=_running(tx),
        workers={version: 0, OTHER: 0, UNKNOWN: 0, **Counter(_shown_version(worker, version) for worker in alive)},
        uploads=int(tx.execute(unfinished).scalar_one()),
        stored_bytes=int(tx.execute(stored).scalar_one()),
        database_bytes=int(tx.execute(_POSTGRES_BYTES if tx.is_postgres else _SQLITE_BYTES).scalar_one()),
    )


def _shown_version(worker: Worker, version: str) -> str:
    """Return the value of the metric's label for the version of a worker.

    It is `version` if the worker has the version of the server, `unknown` if the version is unknown, else `other`.
    """
    if worker.kinds is None:
        return UNKNOWN
    return version if worker.version == version else OTHER


def _queued(tx: Transaction) -> dict[tuple[str, str], QueuedJobs]:
    labels = case((job.c.labels_key == "", "none"), else_="some")
    rows = tx.execute(
        select(job.c.kind, labels.label("labels"), func.count().label("jobs"), func.min(job.c.run_at_us).label("since"))
        .where(job.c.state == QUEUED)
        .group_by(job.c.kind, labels)
    )
    found: dict[tuple[str, str], QueuedJobs] = {}
    for row in rows:
        key = (_known(row.kind), row.labels)
        before = found.get(key, QueuedJobs(0, 0.0))
        age_s = max(before.oldest_age_s, (tx.now_us - row.since) / 1e6)
        found[key] = QueuedJobs(before.count + row.jobs, age_s)
    return found


def _running(tx: Transaction) -> dict[str, int]:
    found: Counter[str] = Counter()
    leased = (job.c.state == RUNNING, job.c.lease_expires_us.is_not(None))
    for row in tx.execute(select(job.c.kind, func.count().label("jobs")).where(*leased).group_by(job.c.kind)):
        found[_known(row.kind)] += row.jobs
    return dict(found)


def _known(kind: str) -> str:
    """Return `kind`, or `other` if no installed package declares this job kind any more."""
    return kind if kind in job_kinds.job_kinds() else OTHER
