"""Wake-ups of waiting requests."""

import asyncio
import threading

import pytest

from marey_server.store.wakeups import Wakeups


def test_a_listener_is_woken_from_another_thread() -> None:
    async def story() -> bool:
        wakeups = Wakeups()
        with wakeups.listen(["work:retarget", "work:export"]) as listener:
            threading.Timer(0.05, wakeups.announce, (["work:export"],)).start()
            return await listener.wait(10)

    assert asyncio.run(story())


def test_what_was_announced_before_the_wait_is_not_missed() -> None:
    async def story() -> tuple[bool, bool]:
        wakeups = Wakeups()
        with wakeups.listen(["job:1"]) as listener:
            wakeups.announce(["job:1"])
            return await listener.wait(10), await listener.wait(0.01)

    assert asyncio.run(story()) == (True, False)


def test_other_topics_wake_nobody_and_nobody_is_left_behind() -> None:
    async def story() -> bool:
        wakeups = Wakeups()
        with wakeups.listen(["job:1"]) as listener:
            wakeups.announce(["job:2"])
            woken = await listener.wait(0.01)
        wakeups.announce(["job:1"])
        assert wakeups._listeners == {}
        return woken

    assert not asyncio.run(story())


def test_a_listener_whose_loop_has_ended_disturbs_nobody() -> None:
    wakeups = Wakeups()

    async def story() -> None:
        wakeups.listen(["job:1"]).__enter__()

    asyncio.run(story())
    wakeups.announce(["job:1"])


@pytest.mark.parametrize("turns", range(5))
def test_a_wait_that_is_woken_and_cancelled_at_once_is_cancelled(turns: int) -> None:
    async def main() -> None:
        wakeups = Wakeups()
        with wakeups.listen(["job"]) as listener:
            waiting = asyncio.create_task(listener.wait(60))
            await asyncio.sleep(0)
            wakeups.announce(["job"])
            for _ in range(turns):
                await asyncio.sleep(0)
            if waiting.cancel():
                with pytest.raises(asyncio.CancelledError):
                    await waiting

    asyncio.run(main())
