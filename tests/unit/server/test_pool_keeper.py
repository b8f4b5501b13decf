"""Task that keeps pools: starts, stops, lost answers, failing workers, failing engines, and one leader."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Coroutine
from typing import Any

import pytest
from tests.support.fake_launcher import FakeLauncher
from tests.support.queue_desk import Desk

from marey_schemas.backoff import Backoff
from marey_server.errors import UnavailableProblem
from marey_server.launchers import pool_keeper, rounds
from marey_server.launchers.launcher import EngineError, LaunchedWorker, WorkerEnd, WorkerRequest
from marey_server.launchers.pool_keeper import PoolKeeper
from marey_server.process.worker_pools import WorkerPool

GPU = WorkerPool(name="gpu", labels={"gpu": "a100"}, most=3, idle_s=100)


class Seconds:
    """Clock that tests set."""

    now = 1000.0

    def __call__(self) -> float:
        return self.now


class Pool:
    """A pool with a fake engine; each call of `adjust` is a round, after `seconds`."""

    def __init__(self, desk: Desk, pool: WorkerPool = GPU, launcher: FakeLauncher | None = None) -> None:
        self.desk = desk
        self.launcher = launcher or FakeLauncher()
        self.clock = Seconds()
        self.keeper = PoolKeeper(pool, self.launcher, desk.database, clock_s=self.clock)
        self.jobs: list[str] = []

    def adjust(self, seconds: float = 0.0) -> None:
        self.clock.now += seconds
        run(self.keeper.adjust())

    def grow(self, jobs: int) -> list[str]:
        """Submit jobs, and return the names of the workers that are started for them."""
        self.jobs += [self.desk.submit(labels=dict(GPU.labels)) for _ in range(jobs)]
        self.adjust(0.1)
        self.adjust(10)
        self.launcher.run_all()
        return list(self.launcher.states)

    def claim(self, worker: str) -> None:
        self.jobs.remove(self.desk.claim(worker=worker, labels=GPU.labels).job)

    def cancel_waiting(self) -> None:
        """Cancel the jobs that no worker has claimed."""
        for job in self.jobs:
            self.desk.cancel(job)


def run(call: Coroutine[Any, Any, None]) -> None:
    asyncio.run(call)


@pytest.fixture
def pool(desk: Desk) -> Pool:
    return Pool(desk)


def test_workers_are_started_for_jobs_with_the_labels_of_the_pool_only(pool: Pool) -> None:
    pool.desk.submit(labels={"gpu": "h100"})
    pool.adjust()
    pool.adjust(20)
    assert pool.launcher.states == {}
    assert len(pool.grow(2)) == 2
    (request,) = pool.launcher.requests
    assert request == WorkerRequest(labels={"gpu": "a100"})


def test_workers_that_run_nothing_are_stopped_after_the_idle_time_and_busy_ones_are_not(pool: Pool) -> None:
    names = pool.grow(3)
    pool.claim(names[1])
    pool.cancel_waiting()
    pool.adjust(5)
    pool.adjust(90)
    assert pool.launcher.stopped == []
    pool.adjust(15)
    assert sorted(pool.launcher.stopped) == sorted({*names} - {names[1]})
    pool.adjust(10)
    assert names[1] not in pool.launcher.stopped, "workers that are being stopped do not count"


@pytest.mark.parametrize("listed", [True, False])
def test_a_start_whose_answer_was_lost_starts_nothing_twice(pool: Pool, listed: bool) -> None:
    pool.launcher.lose_answers = True
    with pytest.raises(EngineError):
        pool.grow(2)
    pool.launcher.lose_answers = False
    if not listed:
        pool.launcher.states = {}
    pool.adjust(5)
    assert len(pool.launcher.states) == 2
    assert len(pool.launcher.keys) == (1 if listed else 2)
    assert len(set(pool.launcher.keys)) == 1


def test_a_start_that_failed_is_not_repeated_when_no_job_waits_any_more(pool: Pool) -> None:
    pool.launcher.lose_answers = True
    with pytest.raises(EngineError):
        pool.grow(2)
    pool.launcher.lose_answers = False
    pool.launcher.states = {}
    pool.cancel_waiting()
    pool.adjust(5)
    assert pool.launcher.states == {}


def test_of_many_ends_in_a_round_some_are_explained_and_the_others_counted(
    pool: Pool, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(pool_keeper, "MOST_EXPLAINED", 1)
    names = pool.grow(3)
    pool.adjust(1)
    for name in names:
        pool.launcher.end(name, WorkerEnd("preempted"))
    with caplog.at_level(logging.INFO, pool_keeper.__name__):
        pool.adjust(1)
    assert caplog.text.count("ended: preempted") == 1
    assert "pool gpu: 2 other workers ended" in caplog.text


def test_a_worker_that_the_engine_does_not_list_yet_counts(pool: Pool) -> None:
    pool.grow(2)
    pool.launcher.states = {}
    pool.adjust(30)
    assert len(pool.launcher.keys) == 1
    pool.adjust(31)
    assert len(pool.launcher.keys) == 2


def test_after_workers_that_die_at_once_the_next_start_waits(pool: Pool, caplog: pytest.LogCaptureFixture) -> None:
    (name,) = pool.grow(1)
    pool.adjust(1)
    pool.launcher.end(name, WorkerEnd("out-of-memory", -9, "cgroup"))
    with caplog.at_level(logging.INFO, pool_keeper.__name__):
        pool.adjust(1)
    assert f"worker {name} ended: out-of-memory, status -9. cgroup" in caplog.text
    assert len(pool.launcher.keys) == 1
    pool.adjust(10)
    assert len(pool.launcher.keys) == 2


def test_only_one_server_keeps_a_pool_whose_workers_outlive_it(desk: Desk) -> None:
    launcher = FakeLauncher()
    first, second = Pool(desk, launcher=launcher), Pool(desk, launcher=launcher)
    assert len(first.grow(2)) == 2
    second.adjust()
    second.adjust(200)
    assert (len(launcher.keys), launcher.stopped) == (1, [])
    run(first.keeper.close())
    first.cancel_waiting()
    second.adjust()
    second.adjust(99)
    assert launcher.stopped == [], "the second server counts from the moment at which it became the leader"
    second.adjust(2)
    assert len(launcher.stopped) == 2


def test_every_server_keeps_the_workers_on_its_own_machine(desk: Desk) -> None:
    pools = [Pool(desk, launcher=FakeLauncher(outlives_server=False)) for _ in range(2)]
    for pool in pools:
        pool.grow(1)
    assert all(len(pool.launcher.keys) == 1 for pool in pools)


def test_an_engine_or_a_database_that_fails_is_asked_again(
    pool: Pool, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    problems: list[Exception] = [EngineError("no controller"), UnavailableProblem("no database"), RuntimeError("a bug")]
    left = list(problems)

    async def adjust() -> None:
        if left:
            raise left.pop(0)
        raise asyncio.CancelledError

    monkeypatch.setattr(pool.keeper, "adjust", adjust)
    monkeypatch.setattr(rounds, "FAULT_PAUSES", Backoff(0.0, 0.0))
    with pytest.raises(asyncio.CancelledError):
        run(pool.keeper.keep())
    for words in ("pool gpu: no controller", "pool gpu: no database", "RuntimeError: a bug"):
        assert words in caplog.text


def test_an_engine_that_does_not_answer_is_an_error(pool: Pool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rounds, "ENGINE_S", 0.05)
    pool.launcher.silent = True
    with pytest.raises(EngineError, match="the engine did not answer within"):
        pool.adjust()


def test_a_keeper_ends_if_it_is_cancelled_while_the_engine_answers(pool: Pool) -> None:
    """`asyncio.wait_for` of Python 3.11 ignores a cancellation at the moment when it has a result."""

    async def cancel_during_an_answer() -> None:
        keeping = asyncio.create_task(pool.keeper.keep())
        listed = pool.launcher.list

        async def list_and_cancel() -> tuple[LaunchedWorker, ...]:
            keeping.cancel()
            return await listed()

        pool.launcher.list = list_and_cancel  # pyrefly: ignore[method-assign]  # of this launcher only
        ended, _ = await asyncio.wait((keeping,), timeout=5)
        keeping.cancel()
        assert ended == {keeping}
        assert keeping.cancelled()

    run(cancel_during_an_answer())
