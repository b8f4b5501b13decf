"""Retention: old data is deleted in batches, and data that is still needed stays."""

from typing import Any

import pytest
from sqlalchemy import func, select
from tests.support.queue_desk import Desk
from tests.support.store_fixtures import Lab

from marey_schemas.queue.jobs import ItemInput
from marey_schemas.queue.worker_protocol import Lease
from marey_server.access.principal import SYSTEM
from marey_server.errors import GoneProblem, NotFoundProblem
from marey_server.store import events, fsck, retention
from marey_server.store.jobs import logs, reading
from marey_server.store.retention import DELETED_LOG, Retention, Retired, retire
from marey_server.store.tables import event, job

DAY_S = 86400.0
SHORT = Retention(events_days=10, logs_days=10, jobs_days=10)
OUTPUT = b"frame after frame\n" * 10


def ended(desk: Desk, *, log: bytes = OUTPUT) -> str:
    """Run a job that writes a log and publishes nothing; return its id."""
    submitted = desk.submit()
    lease = desk.claim()
    assert lease.job == submitted
    write_log(desk, lease, log)
    desk.complete(lease)
    return submitted


def write_log(desk: Desk, lease: Lease, log: bytes) -> None:
    desk.database.write(desk._attempt_of(lease), logs.append_log, lease.job, lease.fence, 0, log, desk.policy)


def log_of(desk: Desk, job_id: str) -> bytes:
    return desk.database.read(desk.user, reading.read_job_log, job_id, 0, 10_000).data


def job_count(desk: Desk) -> int:
    return desk.database.read(SYSTEM, lambda tx: tx.execute(select(func.count()).select_from(job)).scalar_one())


def test_nothing_is_deleted_before_its_time(desk: Desk) -> None:
    done = ended(desk)
    desk.clock.advance(9 * DAY_S)
    assert retire(desk.database, SHORT) == Retired()
    assert log_of(desk, done) == OUTPUT
    desk.clock.advance(1000 * DAY_S)
    assert retire(desk.database, Retention(0, 0, 0)) == Retired()


def test_old_logs_are_replaced_by_a_notice_and_short_ones_stay(desk: Desk) -> None:
    long, short = ended(desk), ended(desk, log=b"done\n")
    desk.clock.advance(11 * DAY_S)
    only_logs = Retention(events_days=0, logs_days=10, jobs_days=0)
    assert retire(desk.database, only_logs).logs == 1
    assert (log_of(desk, long), log_of(desk, short)) == (DELETED_LOG, b"done\n")
    assert retire(desk.database, only_logs).logs == 0


def test_the_log_of_a_job_that_goes_on_stays(desk: Desk) -> None:
    desk.submit()
    lease = desk.claim()
    write_log(desk, lease, OUTPUT)
    desk.clock.advance(11 * DAY_S)
    assert retire(desk.database, SHORT).logs == 0
    assert log_of(desk, lease.job) == OUTPUT


def test_an_old_job_that_made_nothing_is_deleted_and_one_that_made_something_is_kept(desk: Desk) -> None:
    fruitless, fruitful = ended(desk), desk.submit()
    lease = desk.claim()
    desk.stage(lease, "made")
    desk.complete(lease)
    assert desk.outputs(fruitful)
    desk.clock.advance(11 * DAY_S)
    assert retire(desk.database, SHORT).jobs == 1
    with pytest.raises(NotFoundProblem):
        desk.job(fruitless)
    assert desk.job(fruitful).state == "succeeded"
    assert list(fsck.check_store(desk.database)) == []


def test_a_job_is_kept_while_another_waits_for_it_or_comes_after_it(desk: Desk) -> None:
    first = ended(desk)
    second = desk.submit(after=(first,))
    desk.clock.advance(11 * DAY_S)
    assert retire(desk.database, SHORT).jobs == 0
    desk.complete(desk.claim())
    desk.clock.advance(11 * DAY_S)
    assert retire(desk.database, SHORT).jobs + retire(desk.database, SHORT).jobs == 2
    for gone in (first, second):
        with pytest.raises(NotFoundProblem):
            desk.job(gone)


def test_tasks_are_deleted_with_their_job_in_batches(desk: Desk, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(retention, "BATCH", 2)
    things = tuple(ItemInput(item=thing) for thing in desk.things(7))
    whole = desk.submit("square", inputs={"things": things}, max_attempts=1)
    for lease in desk.claim_many():
        desk.fail(lease)
    before = job_count(desk)
    assert desk.job(whole).state.terminal
    desk.clock.advance(11 * DAY_S)
    assert retire(desk.database, SHORT).jobs == before == 5
    assert job_count(desk) == 0


def test_old_events_are_deleted_and_a_follower_who_missed_some_is_told_where_to_go_on(lab: Lab) -> None:
    clock: Any = lab.database.clock
    lab.add_skeleton("old")
    last_old = lab.events()[-1].seq
    clock.advance(11 * DAY_S)
    lab.add_skeleton("new")
    kept = [one.seq for one in lab.events(after=last_old)]
    assert retire(lab.database, SHORT).events > 0
    assert [one.seq for one in lab.events()] == [one.seq for one in lab.events(after=last_old)] == kept
    with pytest.raises(GoneProblem) as refused:
        lab.events(after=last_old - 1)
    assert (refused.value.error_code, refused.value.context) == ("events-deleted", {"after": last_old})


def test_the_newest_event_is_kept_however_old_it_is(lab: Lab) -> None:
    lab.add_skeleton()
    newest = lab.events()[-1]
    clock: Any = lab.database.clock
    clock.advance(1000 * DAY_S)
    retire(lab.database, SHORT)
    assert lab.database.read(SYSTEM, events.newest_number) == newest.seq
    ordinary = select(func.count()).select_from(event).where(event.c.about.is_(None))
    assert lab.database.read(SYSTEM, lambda tx: tx.execute(ordinary).scalar()) == 1
