"""Refusals are delayed while the event loop is late."""

from __future__ import annotations

import asyncio
import contextlib
import sys
import time
from collections.abc import Callable, Coroutine
from typing import Any
from unittest import mock

import pytest

from marey_server.process import refusal_brake
from marey_server.process.refusal_brake import (
    CROWD,
    FEW_AT_ONCE,
    FORGIVEN_EVERY_S,
    FREE_REFUSALS,
    GIVES_WAY_S,
    LONGEST_S,
    TOLERATED_OF_CROWD_S,
    TOLERATED_S,
    USUALLY_GIVES_WAY_S,
    RefusalBrake,
)


def in_a_loop(function: Callable[[], Coroutine[Any, Any, None]]) -> Callable[[], None]:
    """Return a synchronous test function that runs an asynchronous one in an event loop."""

    def run() -> None:
        asyncio.run(function())

    run.__name__ = function.__name__
    return run


def refused(brake: RefusalBrake, client: str, times: int) -> list[float]:
    return [brake.delay_s(client) for _ in range(times)]


@in_a_loop
async def test_nobody_waits_while_the_event_loop_is_on_time() -> None:
    assert set(refused(RefusalBrake(), "a", 10 * FREE_REFUSALS)) == {0.0}


@in_a_loop
async def test_a_client_waits_after_its_free_refusals_the_longer_the_later_the_loop_is() -> None:
    brake = RefusalBrake()
    refused(brake, "a", FREE_REFUSALS)
    delays = []
    with mock.patch.object(refusal_brake, "spread", lambda longest_s, _: longest_s):  # random delays may overlap
        for late_s in (1.2 * TOLERATED_S, 3 * TOLERATED_S, 1e3):
            brake.late_s = late_s
            delays += refused(brake, "a", 1)
    assert 0 < delays[0] < delays[1] < delays[2] <= LONGEST_S
    assert refused(brake, "b", FREE_REFUSALS) == [0.0] * FREE_REFUSALS


@in_a_loop
async def test_lateness_is_measured_while_there_are_refusals() -> None:
    brake = RefusalBrake()
    brake.delay_s("a")
    await asyncio.sleep(0)
    time.sleep(0.3)
    while not brake.late_s:
        await asyncio.sleep(0.01)
    assert brake.late_s > 0.1


@in_a_loop
async def test_threads_give_way_sooner_while_refusals_are_measured_and_the_loop_is_late() -> None:
    usual_s, brake = USUALLY_GIVES_WAY_S, RefusalBrake()
    brake.delay_s("a")
    brake.late_s = 10 * TOLERATED_OF_CROWD_S
    await until(lambda: sys.getswitchinterval() != usual_s)
    assert sys.getswitchinterval() == pytest.approx(GIVES_WAY_S)
    with mock.patch.object(refusal_brake, "MEASURED_S", 0.0):
        await until(lambda: sys.getswitchinterval() == usual_s)


async def until(condition: Callable[[], bool]) -> None:
    """Wait until a condition is true; fail after 20 s."""
    async with asyncio.timeout(20):
        while not condition():
            await asyncio.sleep(0.01)


@in_a_loop
async def test_a_client_with_many_requests_at_once_waits_earlier_and_longer_if_a_crowd_waits() -> None:
    brake = RefusalBrake()
    refused(brake, "a", FREE_REFUSALS)
    brake.late_s = 1.5 * TOLERATED_OF_CROWD_S
    assert brake.delay_s("a", at_once=FEW_AT_ONCE + 1, waiting=CROWD) == 0
    assert brake.delay_s("a", at_once=FEW_AT_ONCE, waiting=CROWD + 1) == 0
    brake.late_s = 1.2 * TOLERATED_S
    alone = brake.delay_s("a", at_once=FEW_AT_ONCE, waiting=CROWD + 1)
    assert 0 < alone < brake.delay_s("a", at_once=FEW_AT_ONCE + 1, waiting=CROWD + 1)


@in_a_loop
async def test_delayed_refusals_belong_to_the_crowd() -> None:
    brake = RefusalBrake()
    refused(brake, "a", FREE_REFUSALS)
    brake.late_s = 1.5 * TOLERATED_OF_CROWD_S
    with contextlib.ExitStack() as delays:
        for _ in range(CROWD + 1):
            delays.enter_context(brake.delaying())
        assert brake.delay_s("a", at_once=FEW_AT_ONCE + 1) > 0
        assert brake.delay_s("a", at_once=FEW_AT_ONCE) == 0
    assert brake.delay_s("a", at_once=FEW_AT_ONCE + 1) == 0


@in_a_loop
async def test_delays_differ_so_that_hostile_requests_do_not_come_back_in_waves() -> None:
    brake = RefusalBrake()
    refused(brake, "a", FREE_REFUSALS)
    brake.late_s = 1e3
    delays = refused(brake, "a", 100)
    assert max(delays) - min(delays) > 0.4 * LONGEST_S


def test_refusals_are_forgiven_one_after_another(monkeypatch: pytest.MonkeyPatch) -> None:
    async def main() -> None:
        brake = RefusalBrake()
        refused(brake, "a", FREE_REFUSALS)
        brake.late_s = 1e3
        assert all(refused(brake, "a", 2))
        later_s = time.monotonic() + 4.5 * FORGIVEN_EVERY_S
        monkeypatch.setattr(time, "monotonic", lambda: later_s)
        delays = refused(brake, "a", 4)
        assert delays[:2] == [0.0, 0.0]
        assert all(delays[2:])
        monkeypatch.undo()

    asyncio.run(main())


def test_a_client_is_often_refused_until_refusals_are_forgiven(monkeypatch: pytest.MonkeyPatch) -> None:
    async def main() -> None:
        brake = RefusalBrake()
        refused(brake, "a", FREE_REFUSALS)
        assert not brake.is_often_refused("a")
        refused(brake, "a", 1)
        assert brake.is_often_refused("a")
        assert not brake.is_often_refused("b")
        later_s = time.monotonic() + 2 * FORGIVEN_EVERY_S
        monkeypatch.setattr(time, "monotonic", lambda: later_s)
        assert not brake.is_often_refused("a")
        monkeypatch.undo()

    asyncio.run(main())
