"""Periodic work of a server."""

import asyncio
import os
import threading
import time
from collections.abc import Sequence
from pathlib import Path

import pytest
from tests.support.patience import PATIENCE_S
from tests.support.queue_desk import Desk

from marey_server.app import create_app
from marey_server.process import housekeeping
from marey_server.process.services import Services
from marey_server.process.settings import Settings
from marey_server.store.database.connections import Database
from marey_server.store.database.lanes import Client
from marey_server.store.datasets.proposals import WaitingMerges
from marey_server.store.jobs import late_inputs, propagation
from marey_server.store.jobs.endings import Ended
from marey_server.store.jobs.policy import QueuePolicy
from marey_server.store.transaction import Transaction
from marey_server.store.wakeups import OUTPUTS_TO_COMMIT, wakeups


def test_garbage_is_collected_soon_after_the_start_and_again_later(
    database: Database, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(housekeeping, "FIRST_GARBAGE_S", 0.02)
    monkeypatch.setattr(housekeeping, "GARBAGE_EVERY_S", 0.02)
    app = create_app(Settings(data=tmp_path, port=0), database)

    async def two_rounds() -> list[str]:
        rounds, both_done = [], asyncio.Event()

        async def noted(services: Services, holder: str) -> None:
            rounds.append(holder)
            if len(rounds) == 2:
                both_done.set()

        monkeypatch.setattr(housekeeping, "_collect_garbage", noted)
        async with housekeeping.running_housekeeping(app.services), asyncio.timeout(PATIENCE_S):
            await both_done.wait()
        return rounds

    assert len(asyncio.run(two_rounds())) >= 2


def test_waiting_proposals_are_merged_again_and_again(
    database: Database, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(housekeeping, "LONGEST_TICK_S", 0.02)
    app = create_app(Settings(data=tmp_path, port=0), database)
    rounds, both_done = list[WaitingMerges](), threading.Event()

    def attempt(merges: WaitingMerges) -> int:
        rounds.append(merges)
        if len(rounds) == 2:
            both_done.set()
        return 0

    monkeypatch.setattr(WaitingMerges, "attempt", attempt)

    async def two_rounds() -> bool:
        async with housekeeping.running_housekeeping(app.services):
            return await asyncio.to_thread(both_done.wait, 30)

    assert asyncio.run(two_rounds())
    assert rounds[0] is rounds[1]


def test_housekeeping_leaves_the_compute_threads_to_requests(
    database: Database, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun, may_end = threading.Semaphore(0), threading.Event()

    def occupy(*_: object) -> int:
        begun.release()
        may_end.wait(120)
        return 0

    monkeypatch.setattr(os, "cpu_count", lambda: 2)
    for name in ("LONGEST_TICK_S", "FIRST_GARBAGE_S", "GARBAGE_EVERY_S"):
        monkeypatch.setattr(housekeeping, name, 0.02)
    monkeypatch.setattr(WaitingMerges, "attempt", occupy)
    for name in ("commit_deferred", "retire"):
        monkeypatch.setattr(housekeeping, name, occupy)
    app = create_app(Settings(data=tmp_path, port=0), database)

    async def compute_beside() -> int:
        async with housekeeping.running_housekeeping(app.services):
            try:
                assert await asyncio.to_thread(lambda: all(begun.acquire(timeout=20) for _ in range(3)))
                future = app.services.compute_threads.submit_for(Client("anna"), sum, (1, 2))
                async with asyncio.timeout(PATIENCE_S):
                    return await asyncio.wrap_future(future)
            finally:
                may_end.set()

    assert asyncio.run(compute_beside()) == 3


def test_outputs_that_wait_since_the_last_commit_began_are_committed_at_once(
    database: Database, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls, second = list[Database](), threading.Event()

    def commit(committing: Database) -> int:
        calls.append(committing)
        if len(calls) == 2:
            second.set()
        else:
            wakeups.announce([OUTPUTS_TO_COMMIT])
        return 0

    monkeypatch.setattr(housekeeping, "LONGEST_TICK_S", 3600)
    monkeypatch.setattr(housekeeping, "commit_deferred", commit)
    app = create_app(Settings(data=tmp_path, port=0), database)
    app.services.queue_policy = QueuePolicy(lease_ttl_s=4 * 3600)

    async def two_commits() -> bool:
        async with housekeeping.running_housekeeping(app.services):
            for _ in range(10):
                await asyncio.sleep(0)  # until housekeeping waits
            wakeups.announce([OUTPUTS_TO_COMMIT])
            return await asyncio.to_thread(second.wait, 30)

    assert asyncio.run(two_commits())


def test_copies_of_index_files_that_the_store_has_deleted_are_removed(
    database: Database, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(housekeeping, "FIRST_GARBAGE_S", 0.02)
    app = create_app(Settings(data=tmp_path, port=0), database)
    (copy := app.services.index_files.path(f"sha256:{'0' * 64}")).parent.mkdir()
    copy.write_bytes(b"poses")
    renewed = asyncio.Event()
    monkeypatch.setattr(app.services.children, "renew", renewed.set)

    async def until_removed() -> None:
        async with housekeeping.running_housekeeping(app.services), asyncio.timeout(PATIENCE_S):
            await renewed.wait()  # children keep the files mapped into memory
            assert not copy.exists()

    asyncio.run(until_removed())


def test_ends_that_cannot_be_propagated_do_not_delay_those_of_other_jobs(
    desk: Desk, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(housekeeping, "LONGEST_TICK_S", 0.02)
    monkeypatch.setattr(propagation, "MOST_AT_ONCE", 2)
    pin = late_inputs.pin_late_inputs

    def pin_faultily(tx: Transaction, ids: Sequence[str]) -> list[Ended]:
        if faulty in ids:
            raise RuntimeError("a fault of the server")
        return pin(tx, ids)

    monkeypatch.setattr(late_inputs, "pin_late_inputs", pin_faultily)
    one, other = desk.submit("sum"), desk.submit()
    waiting = [[desk.submit(after=[first]) for _ in range(3)] for first in (one, other)]
    time.sleep(0.002)  # ids sort by their milliseconds: the faulty job is the last to be released
    faulty = desk.submit("square", inputs={"things": [{"job": one}]})
    leases = {lease.job: lease for lease in desk.claim_many()}
    desk.stage(leases[one], "sum")
    for first in (one, other):
        desk.complete(leases[first])
    others = waiting[1]  # in any order, because ids of the same millisecond are random
    assert "waiting" in map(desk.state, others)
    app = create_app(Settings(data=tmp_path, port=0), desk.database)

    async def until_propagated() -> None:
        async with housekeeping.running_housekeeping(app.services), asyncio.timeout(PATIENCE_S):
            while "waiting" in await asyncio.to_thread(lambda: map(desk.state, others)):
                await asyncio.sleep(0.02)

    asyncio.run(until_propagated())
    assert ({desk.state(job) for job in others}, desk.state(faulty)) == ({"queued"}, "waiting")
