"""Turns of clients: few requests begin in each round of the event loop, and clients take turns."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable

from marey_server.process.turns import BEGUN_PER_ROUND, RESERVED_PER_ROUND, Turns
from marey_server.store.database.lanes import Client

ANNA, BEN = Client("anna"), Client("ben")
STRANGER = Client("192.0.2.1", known=False)


class Arrivals:
    """Requests of clients, and the order in which they begin."""

    def __init__(self) -> None:
        self.turns = Turns()
        self.begun: list[str] = []

    def arrive(self, client: Client, name: str, *, reserved: bool = False) -> None:
        """Let a request of a client arrive; its name is recorded when it begins."""
        turn = self.turns.take(client, reserved=reserved)
        if turn is None:
            self.begun.append(name)
        else:
            turn.add_done_callback(lambda _turn: self.begun.append(name))

    async def all_begin(self) -> list[str]:
        """Wait until all waiting requests have begun; return their names in the order in which they began."""
        at_once = len(self.begun)
        while len(self.turns):
            await asyncio.sleep(0)
        await asyncio.sleep(0)
        return self.begun[at_once:]


def run(work: Callable[[Arrivals], Awaitable[None]]) -> None:
    async def main() -> None:
        await work(Arrivals())

    asyncio.run(main())


def test_requests_begin_at_once_while_few_arrive() -> None:
    async def work(arrivals: Arrivals) -> None:
        for _ in range(3):
            for number in range(BEGUN_PER_ROUND):
                arrivals.arrive(ANNA, f"a{number}")
            assert len(arrivals.turns) == 0
            await asyncio.sleep(0)
            await asyncio.sleep(0)

    run(work)


def test_of_many_requests_a_few_begin_in_each_round() -> None:
    async def work(arrivals: Arrivals) -> None:
        for number in range(50):
            arrivals.arrive(ANNA, f"a{number}")
        waiting = len(arrivals.turns)
        assert waiting == 50 - BEGUN_PER_ROUND
        while waiting:
            await asyncio.sleep(0)
            assert waiting - len(arrivals.turns) <= BEGUN_PER_ROUND
            waiting = len(arrivals.turns)

    run(work)


def test_a_client_with_one_request_does_not_wait_for_all_requests_of_another() -> None:
    async def work(arrivals: Arrivals) -> None:
        for number in range(100):
            arrivals.arrive(BEN, f"b{number}")
            arrivals.arrive(STRANGER, f"s{number}")
        arrivals.arrive(ANNA, "anna's")
        assert (await arrivals.all_begin()).index("anna's") < 2 * BEGUN_PER_ROUND

    run(work)


def test_reserved_operations_come_first_but_not_alone() -> None:
    async def work(arrivals: Arrivals) -> None:
        for number in range(40):
            arrivals.arrive(ANNA, "ordinary")
            arrivals.arrive(BEN, "reserved", reserved=True)
            arrivals.arrive(Client(f"192.0.2.{number}", known=False), "reserved", reserved=True)
        first = (await arrivals.all_begin())[: 10 * BEGUN_PER_ROUND]
        assert first.count("reserved") == 10 * RESERVED_PER_ROUND
        assert first.count("ordinary") == 10 * (BEGUN_PER_ROUND - RESERVED_PER_ROUND)

    run(work)


def test_a_request_that_was_cancelled_does_not_stop_the_line() -> None:
    async def work(arrivals: Arrivals) -> None:
        for _ in range(BEGUN_PER_ROUND):
            arrivals.arrive(ANNA, "a")
        gone = arrivals.turns.take(ANNA, reserved=False)
        assert gone is not None
        gone.cancel()
        arrivals.arrive(ANNA, "last")
        assert await arrivals.all_begin() == ["last"]

    run(work)
