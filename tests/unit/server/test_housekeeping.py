"""Periodic work of a server."""

import asyncio
import threading
from pathlib import Path

import pytest

from marey_server.app import create_app
from marey_server.process import housekeeping
from marey_server.process.services import Services
from marey_server.process.settings import Settings
from marey_server.store.database.connections import Database
from marey_server.store.datasets.proposals import WaitingMerges


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
        async with housekeeping.keeping_house(app.services):
            await asyncio.wait_for(both_done.wait(), 30)
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
        async with housekeeping.keeping_house(app.services):
            return await asyncio.to_thread(both_done.wait, 30)

    assert asyncio.run(two_rounds())
    assert rounds[0] is rounds[1]
