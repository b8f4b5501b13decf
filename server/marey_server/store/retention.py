"""Retention: deletes events, audit entries, deliveries of webhooks, logs and jobs that are too old by the settings.

Work is done in batches, each in a transaction of its own, so that no other write waits long. If a process dies between
two batches, the next round continues. A job that created a revision or a commit is never deleted.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from sqlalchemy import ColumnElement, and_, delete, exists, func, insert, or_, select, tuple_, update

from marey_server.access.principal import SYSTEM
from marey_server.store import events
from marey_server.store.database.clock import DAY_US
from marey_server.store.database.connections import Database
from marey_server.store.garbage import BATCH
from marey_server.store.ids import first_id_at
from marey_server.store.purge_lock import hold_off_purges_of_jobs
from marey_server.store.tables import (
    HAS_LONG_LOG,
    attempt,
    dataset_commit,
    job,
    job_blob,
    job_dependency,
    job_item,
    job_log,
    lineage,
    revision,
    script_run,
    staged_output,
)
from marey_server.store.transaction import Transaction
from marey_server.store.webhooks import outbox
from marey_server.store.webhooks.managing import forget_old_secrets

DELETED_LOG = b"[This log was deleted because it was old.]\n"
"""Text that replaces a deleted log. Logs that are not longer than this text are kept (`HAS_LONG_LOG`)."""


@dataclass(frozen=True)
class Retention:
    """Numbers of days for which events, logs, jobs and audit entries are kept; 0 means for ever."""

    events_days: int = 365
    logs_days: int = 90
    jobs_days: int = 365
    audit_days: int = 0


@dataclass(frozen=True, slots=True)
class Retired:
    """Numbers of deleted events, logs, jobs and audit entries."""

    events: int = 0
    logs: int = 0
    jobs: int = 0
    audit_entries: int = 0


def retire(database: Database, retention: Retention) -> Retired:
    """Delete old events, logs, jobs and audit entries; return how many. May run in several processes at once.

    Also deletes old deliveries of webhooks, and replaced secrets of webhooks whose grace period is over.
    """
    database.write(SYSTEM, forget_old_secrets)
    return Retired(
        events=_retire_events(database, retention.events_days) if retention.events_days else 0,
        logs=_retire_logs(database, retention.logs_days) if retention.logs_days else 0,
        jobs=_retire_jobs(database, retention.jobs_days) if retention.jobs_days else 0,
        audit_entries=_retire_audit_entries(database, retention.audit_days) if retention.audit_days else 0,
    )


def _retire_events(database: Database, days: int) -> int:
    """Delete old events, and deliveries of webhooks that ended long ago; return the number of events."""
    deleted = 0
    while (count := database.write(SYSTEM, _delete_oldest, days * DAY_US)) is not None:
        deleted += count
    while database.write(SYSTEM, outbox.delete_old_deliveries, days * DAY_US, BATCH) == BATCH:
        pass
    return deleted


def _delete_oldest(tx: Transaction, age_us: int) -> int | None:
    """Delete some old events, except audit entries, and return how many; None if there are no further old events.

    Events that a webhook has not delivered yet are counted first, so that the webhook can report them as missed.
    """
    tx.lock("retention of events")  # otherwise a slower process could set the begin of the feed back
    last = events.find_last_old(tx, age_us)
    if last is None:
        return None
    outbox.count_missed(tx, last)
    return events.delete_until(tx, last)


def _retire_audit_entries(database: Database, days: int) -> int:
    deleted = 0
    while count := database.write(SYSTEM, events.delete_old_audit_entries, days * DAY_US):
        deleted += count
    return deleted


def _first_young_job(tx: Transaction, age_us: int) -> str:
    """Return an id that is greater than the ids of all jobs that ended more than `age_us` ago.

    Ids sort by the time of creation, so a search for old jobs need not read the ids after this one. Ids are made with
    the clock of the server, which may differ by up to a day from the clock of the database.
    """
    return first_id_at("job", tx.now_us - age_us + DAY_US)


# -- logs --------------------------------------------------------------------------------------------------------------


def _retire_logs(database: Database, days: int) -> int:
    deleted, after = 0, ("", 0)
    while found := database.read(SYSTEM, _old_logs, days * DAY_US, after):
        deleted += database.write(SYSTEM, _delete_logs, found)
        after = found[-1]
    return deleted


def _old_logs(tx: Transaction, age_us: int, after: tuple[str, int]) -> list[tuple[str, int]]:
    """Return the next attempts, after the attempt `after`, that ended long ago and have a log.

    An attempt is identified by the id of its job and by its fence, the number of the claim that started it.
    """
    statement = (
        select(attempt.c.job_id, attempt.c.fence)
        .where(
            tuple_(attempt.c.job_id, attempt.c.fence) > tuple_(*after),
            attempt.c.job_id < _first_young_job(tx, age_us),
            attempt.c.ended_us < tx.now_us - age_us,
            HAS_LONG_LOG,
        )
        .order_by(attempt.c.job_id, attempt.c.fence)
        .limit(BATCH)
    )
    return [(row.job_id, row.fence) for row in tx.execute(statement)]


def _delete_logs(tx: Transaction, attempts: Sequence[tuple[str, int]]) -> int:
    """Replace the logs of ended attempts by the text `DELETED_LOG`; return the number of these logs."""
    chosen = tuple_(job_log.c.job_id, job_log.c.fence).in_(attempts)
    tx.execute(delete(job_log).where(chosen))
    notices = [{"job_id": job_id, "fence": fence, "offset": 0, "data": DELETED_LOG} for job_id, fence in attempts]
    tx.execute(insert(job_log), notices)
    shortened = update(attempt).where(tuple_(attempt.c.job_id, attempt.c.fence).in_(attempts))
    tx.execute(shortened.values(log_bytes=len(DELETED_LOG)))
    return len(attempts)


# -- jobs --------------------------------------------------------------------------------------------------------------


def _retire_jobs(database: Database, days: int) -> int:
    deleted, after = 0, ""
    while found := database.read(SYSTEM, _old_jobs, days * DAY_US, after):
        for job_id in found:
            while tasks := database.write(SYSTEM, _delete_tasks, job_id):
                deleted += tasks
            deleted += database.write(SYSTEM, _delete_if_unused, job_id)
        after = found[-1]
    return deleted


task = job.alias("task")


def _old_jobs(tx: Transaction, age_us: int, after: str) -> list[str]:
    """Return the ids of the next jobs, after the id `after`, that can be deleted.

    Such a job ended long ago, and no other job depends on it. Neither the job nor one of its tasks created a revision
    or a commit.
    """
    tasks = select(task.c.id).where(task.c.parent_id == job.c.id).correlate(job)
    with_tasks = or_(job_dependency.c.on_job_id == job.c.id, job_dependency.c.on_job_id.in_(tasks))
    others = and_(job_dependency.c.job_id != job.c.id, job_dependency.c.job_id.not_in(tasks))
    task_needed = or_(task.c.finished_us.is_(None), _made_something(task.c.id))
    statement = (
        select(job.c.id)
        .where(
            job.c.id > after,
            job.c.id < _first_young_job(tx, age_us),
            func.coalesce(job.c.parent_id, "") == "",  # `IS NULL` makes SQLite read an index that contains every job
            job.c.finished_us < tx.now_us - age_us,
            ~_made_something(job.c.id),
            ~exists().where(task.c.parent_id == job.c.id, task_needed),
            ~exists().where(with_tasks, others),
        )
        .order_by(job.c.id)
        .limit(BATCH)
    )
    return list(tx.execute(statement).scalars())


def _made_something(job_id: ColumnElement[str]) -> ColumnElement[bool]:
    made = (revision.c.job_id, lineage.c.job_id, dataset_commit.c.job_id)
    return or_(*(exists().where(column == job_id) for column in made))


def _delete_tasks(tx: Transaction, parent: str) -> int:
    """Delete some tasks of an old job, and return how many."""
    hold_off_purges_of_jobs(tx, [parent])  # which change the same rows, in another order
    some = list(tx.execute(select(job.c.id).where(job.c.parent_id == parent).limit(BATCH)).scalars())
    tx.execute(delete(job_dependency).where(job_dependency.c.job_id == parent, job_dependency.c.on_job_id.in_(some)))
    return _delete_jobs(tx, some)


def _delete_if_unused(tx: Transaction, job_id: str) -> int:
    """Delete an old job, unless a job that depends on it was submitted in the meantime; return 1 or 0."""
    hold_off_purges_of_jobs(tx, [job_id])
    used = select(job_dependency.c.job_id).where(job_dependency.c.on_job_id == job_id).limit(1)
    return 0 if tx.execute(used).first() else _delete_jobs(tx, [job_id])


def _delete_jobs(tx: Transaction, job_ids: Sequence[str]) -> int:
    for table in (job_log, staged_output, attempt, job_blob, job_item, script_run, job_dependency):
        tx.execute(delete(table).where(table.c.job_id.in_(job_ids)))
    return tx.execute(delete(job).where(job.c.id.in_(job_ids))).rowcount
