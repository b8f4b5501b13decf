"""Forked programs in an event loop, as tests of servers and clusters use them."""

import asyncio
import os

from tests.support.awaited_programs import AwaitedProgram
from tests.support.forked_programs import ForkedProgram


def test_who_asks_for_the_status_does_not_take_it_from_who_waits() -> None:
    async def end() -> tuple[int | None, int, int | None]:
        ended, ending = os.pipe()
        program = AwaitedProgram(ForkedProgram(1, ended, None), None)
        await asyncio.sleep(0)  # it now waits for the end
        os.write(ending, (7).to_bytes(4, "little"))
        os.close(ending)
        before = program.returncode  # asked in the same round of the event loop in which the program has ended
        async with asyncio.timeout(30):
            return before, await program.wait(), program.returncode

    assert asyncio.run(end()) == (None, 7, 7)
