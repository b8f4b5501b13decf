"""Ended jobs for benchmarks: the rows written by SQL equal the rows that the queue would have written."""

from __future__ import annotations

from benchmarks.ended_jobs import add_ended_jobs
from benchmarks.local_server import PROJECT
from benchmarks.seeding import fill_database

from marey_schemas.queue.jobs import JobState
from marey_server.access.principal import SYSTEM
from marey_server.store import events, fsck, users
from marey_server.store.database.connections import Database
from marey_server.store.jobs import reading
from marey_server.store.jobs.reading import JobFilters
from marey_server.store.retention import Retention, Retired, retire


def test_a_year_of_jobs_is_listed_and_shown_and_leaves_nothing_to_sweep(database: Database) -> None:
    database.write(SYSTEM, users.ensure_first_administrator)
    fill_database(database, 1)
    before = database.read(SYSTEM, events.newest_number)
    add_ended_jobs(database, 200)
    administrator = database.read(SYSTEM, users.administrator_principal)
    counts = [
        database.read(administrator, reading.list_jobs, PROJECT, JobFilters((state,)), count=True).count
        for state in JobState
    ]
    assert dict(zip(JobState, counts, strict=True)) == dict.fromkeys(JobState, 0) | {
        JobState.SUCCEEDED: 180,
        JobState.FAILED: 12,
        JobState.CANCELLED: 8,
    }
    failed = database.read(administrator, reading.list_jobs, PROJECT, JobFilters((JobState.FAILED,))).items[0]
    attempts = database.read(administrator, reading.list_attempts, failed.id).items
    assert [(one.fence, one.outcome) for one in attempts] == [(1, "error"), (2, "error")]
    shown = database.read(administrator, reading.list_job_events, failed.id).items
    assert [one.kind for one in shown] == ["job.submitted", "job.started", "job.failed"]
    database.write(SYSTEM, events.number_events)
    assert database.read(SYSTEM, events.newest_number) > before + 590
    assert list(fsck.check_store(database)) == []
    assert retire(database, Retention()) == Retired()
