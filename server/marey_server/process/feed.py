"""Task that wakes waiting requests of this process when the feed has new events.

The feed is the list of changes by all processes that share the database. One task per process reads it after each
commit and after each notification of Postgres. It also reads the feed periodically, in case a notification was lost. So
even many waiting requests cause no work while nothing changes.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from typing import Any, TypeVar

from marey_schemas.backoff import Backoff
from marey_server.access.principal import SYSTEM
from marey_server.errors import ApiProblem
from marey_server.process.services import Services
from marey_server.store import events
from marey_server.store.database.lanes import SERVER
from marey_server.store.transaction import Transaction
from marey_server.store.wakeups import COMMITTED_EVENTS, NUMBERED_EVENTS, wakeups, work_topic

T = TypeVar("T")

LOOK_EVERY_S = 2.0
"""Interval in seconds at which the feed is read without a notification, in case one was lost."""

PAUSE_S = 0.05
"""Least time in seconds between two reads of the feed; under load, one read covers many commits."""

RECONNECT = Backoff(first_s=0.5, longest_s=30.0)

log = logging.getLogger(__name__)


@asynccontextmanager
async def following_feed(services: Services) -> AsyncIterator[None]:
    """Wake waiting requests of this process after changes by any server process, while the `async with` block runs."""
    tasks = [asyncio.create_task(_follow(services))]
    if not services.database.is_sqlite:
        tasks.append(asyncio.create_task(_listen(services)))
    try:
        yield
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


async def _follow(services: Services) -> None:
    """Read the feed repeatedly; a failure is logged, and the next read continues where the last one ended."""
    position = _FeedPosition(services)
    with wakeups.listen([COMMITTED_EVENTS]) as listener:
        while True:
            try:
                await position.announce_news()
            except ApiProblem as error:
                log.warning("the feed of events cannot be read: %s", error.detail)
            except Exception:
                log.exception("the feed of events cannot be read")
            await asyncio.sleep(PAUSE_S)
            await listener.wait(LOOK_EVERY_S)


class _FeedPosition:
    """Position of this process in the feed: the number of the last event that it has read.

    It also contains the time up to which due retries were announced to waiting workers.
    """

    def __init__(self, services: Services) -> None:
        self._services = services
        self._last: int | None = None
        self._due_until_us = 0
        self._look_for_due_at_s = 0.0

    async def announce_news(self) -> None:
        """Wake the requests that wait for an event that was recorded after the last call.

        Also wake the workers that wait for a kind of job, if a retry of such a job has become due.
        """
        await self._services.number_events()
        if self._last is None:
            self._last = await self._read(events.newest_number)
        complete = False
        while not complete:
            news = await self._read(events.read_news, self._last)
            wakeups.announce({*news.topics, NUMBERED_EVENTS} if news.last > self._last else news.topics)
            self._last, complete = news.last, news.complete
        self._services.metrics.operator.note_feed()
        await self._announce_due()

    async def _announce_due(self) -> None:
        """Wake the workers that wait for a kind of job, if a retry of such a job has become due.

        Finding due retries reads the whole queue, so this is done at most every `LOOK_EVERY_S` seconds.
        """
        if time.monotonic() < self._look_for_due_at_s:
            return
        self._look_for_due_at_s = time.monotonic() + LOOK_EVERY_S
        kinds, self._due_until_us = await self._read(events.kinds_due, self._due_until_us)
        wakeups.announce(map(work_topic, kinds))

    async def _read(self, function: Callable[..., T], *args: Any) -> T:
        def run(tx: Transaction) -> T:
            return function(tx, *args)

        return await asyncio.wrap_future(self._services.database.queue_read(SERVER, SYSTEM, run, reserved=True))


async def _listen(services: Services) -> None:
    """Listen to notifications of Postgres about commits of other processes; reconnect if the connection breaks."""
    failures = 0
    while True:
        try:
            async for _ in services.database.notifications(events.CHANNEL):
                failures = 0
                wakeups.announce([COMMITTED_EVENTS])
        except ApiProblem as error:
            failures += 1
            log.warning("no notifications from the database: %s", error.detail)
        except Exception:
            failures += 1
            log.exception("no notifications from the database")
        await asyncio.sleep(RECONNECT.delay_s(max(failures, 1)))
