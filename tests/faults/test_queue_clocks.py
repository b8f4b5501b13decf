"""Clocks that jump, and servers that were down: leases neither end early, nor last for ever, nor become valid again."""

from __future__ import annotations

import time
from collections.abc import Callable

import pytest
from tests.support.patience import wait_until
from tests.support.present import present
from tests.support.queue_desk import Desk

from marey_schemas.queue.worker_protocol import ClaimRequest
from marey_server.access.principal import SYSTEM
from marey_server.errors import LeaseLostProblem
from marey_server.store.database.clock import DatabaseClock
from marey_server.store.database.connections import Database
from marey_server.store.jobs.reaper import StartGrace, claim_after_reaping, correct_times, reap_page
from marey_server.store.transaction import Transaction

pytestmark = pytest.mark.every_database

HOUR_S = 3600.0


def _now_us(tx: Transaction) -> int:
    return tx.now_us


def jump_of_wall_clock(monkeypatch: pytest.MonkeyPatch, seconds: float) -> None:
    """Let the wall clock of this machine jump forward or back, as if an administrator had set it."""
    real = time.time_ns
    monkeypatch.setattr(time, "time_ns", lambda: real() + round(seconds * 1e9))


@pytest.mark.parametrize("jump_s", [HOUR_S, -HOUR_S])
def test_a_jump_of_the_hosts_clock_neither_ends_nor_lengthens_a_lease(
    desk: Desk, open_database: Callable[[], Database], monkeypatch: pytest.MonkeyPatch, jump_s: float
) -> None:
    desk.database.clock = DatabaseClock()
    desk.submit()
    lease = desk.claim()
    before_us = desk.database.write(SYSTEM, _now_us)
    jump_of_wall_clock(monkeypatch, jump_s)
    assert 0 <= desk.database.write(SYSTEM, _now_us) - before_us < 30e6
    assert desk.reap() == 0
    assert desk.heartbeat(lease).lease_ttl_s == pytest.approx(60, abs=5)
    desk.complete(lease)


def test_a_server_restarted_with_an_earlier_clock_does_not_go_back_in_time(
    desk: Desk, open_database: Callable[[], Database], monkeypatch: pytest.MonkeyPatch
) -> None:
    desk.database.clock = DatabaseClock()
    desk.submit()
    desk.claim()
    before_us = desk.database.write(SYSTEM, _now_us)
    jump_of_wall_clock(monkeypatch, -HOUR_S)
    restarted = open_database()
    restarted.clock = DatabaseClock()
    assert restarted.write(SYSTEM, _now_us) >= before_us - 2_000_000
    assert restarted.write(SYSTEM, reap_page).taken == 0


def test_servers_of_one_database_follow_the_one_whose_clock_is_ahead(
    desk: Desk, open_database: Callable[[], Database], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The second server starts after the clock of the machine was set forward, or after the machine slept."""
    desk.database.clock = DatabaseClock()
    desk.submit()
    lease = desk.claim()
    jump_of_wall_clock(monkeypatch, HOUR_S)
    later = open_database()
    later.clock = DatabaseClock()

    def apart_s() -> float:
        return (later.write(SYSTEM, _now_us) - desk.database.write(SYSTEM, _now_us)) / 1e6

    if later.is_sqlite:
        assert apart_s() > HOUR_S / 2
    wait_until(lambda: abs(apart_s()) < 5)
    assert desk.heartbeat(lease).lease_ttl_s == pytest.approx(60, abs=5)
    assert later.write(SYSTEM, reap_page).taken == 0
    desk.complete(lease)


def test_leases_and_rests_end_soon_although_the_databases_clock_was_set_back(desk: Desk) -> None:
    lost, resting = desk.submit(), desk.submit()
    desk.claim(job=lost)
    desk.fail(desk.claim(job=resting))
    desk.clock.advance(-HOUR_S)
    assert desk.database.write(SYSTEM, correct_times) == 2
    assert desk.database.write(SYSTEM, correct_times) == 0
    assert desk.claim_many() != []
    desk.clock.advance(61)
    assert desk.reap() == 2
    assert desk.state(lost) == "queued"


def test_a_clock_that_jumps_beyond_the_time_limit_ends_no_job_of_a_live_worker(desk: Desk) -> None:
    desk.submit(resources={"time_limit_s": 600})
    lease = desk.claim()
    desk.heartbeat(lease)
    desk.clock.advance(HOUR_S)
    assert desk.heartbeat(lease).lease_ttl_s == pytest.approx(60, abs=1)
    assert desk.reap() == 0
    desk.complete(lease)


def test_a_worker_that_does_not_stop_at_the_time_limit_loses_its_job_even_if_it_is_late(desk: Desk) -> None:
    job = desk.submit(resources={"time_limit_s": 600})
    lease = desk.claim()
    for _ in range(12):
        desk.heartbeat(lease)
        desk.clock.advance(50)
    for _ in range(20):  # the server has no time to take the job back
        desk.heartbeat(lease)
        desk.clock.advance(50)
    assert desk.reap() == 1
    assert present(desk.job(job).failure).code == "time-limit"
    assert desk.state(job) == "failed"


def test_after_an_outage_workers_have_a_whole_lease_to_come_back_before_anything_is_taken(desk: Desk) -> None:
    grace = StartGrace(desk.policy)
    request = ClaimRequest(worker="v", kinds=("errand",))

    def tick() -> int:
        return len(desk.database.write(SYSTEM, claim_after_reaping, request, grace, desk.policy))

    alive, dead = (desk.submit(resources={"time_limit_s": 86_400}) for _ in range(2))
    leases = {lease.job: lease for lease in desk.claim_many()}
    for _ in range(8):
        assert tick() == 0
        desk.clock.advance(10)
        for lease in leases.values():
            desk.heartbeat(lease)

    desk.clock.advance(HOUR_S)  # nobody could reach the database, or its clock jumped
    assert tick() == 0
    desk.heartbeat(leases[alive])
    for _ in range(5):
        desk.clock.advance(11)
        assert tick() == 0
        desk.heartbeat(leases[alive])
    desk.clock.advance(11)
    assert tick() == 1  # the dead one's job, taken back and given to the next
    assert desk.job(dead).attempt == 2
    desk.complete(leases[alive])
    with pytest.raises(LeaseLostProblem):
        desk.complete(leases[dead])


def test_a_job_is_not_taken_from_a_worker_whose_heartbeat_waits_behind_a_long_write(desk: Desk) -> None:
    grace = StartGrace(desk.policy)
    request = ClaimRequest(worker="v", kinds=("errand",))
    desk.submit(resources={"time_limit_s": 86_400})
    lease = desk.claim()
    for _ in range(15):
        assert desk.database.write(SYSTEM, claim_after_reaping, request, grace, desk.policy) == []
        desk.heartbeat(lease)
        desk.clock.advance(5)
    desk.clock.advance(desk.policy.heartbeat_s - 5 - 1)  # the next one is about to be sent
    assert desk.database.write(SYSTEM, claim_after_reaping, request, grace, desk.policy) == []
    desk.clock.advance(50)
    assert desk.database.write(SYSTEM, claim_after_reaping, request, grace, desk.policy) == []
    desk.heartbeat(lease)


def test_the_grace_begins_anew_when_the_database_was_away(desk: Desk) -> None:
    grace = StartGrace(desk.policy)
    second_us = 1_000_000
    assert not grace.over(0)
    assert not grace.over(40 * second_us)
    assert not grace.over(59 * second_us)
    assert grace.over(60 * second_us)
    assert grace.over(105 * second_us)
    grace.restart()
    assert not grace.over(111 * second_us)
    assert not grace.over(140 * second_us)
    assert not grace.over(170 * second_us)
    assert grace.over(171 * second_us)
    assert not grace.over(171 * second_us - 1), "the clock went back"
    assert not grace.over(300 * second_us), "nothing was seen for longer than a lease"
