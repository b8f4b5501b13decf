"""What the server does by itself: takes back overdue leases, serves waiting results, collects garbage.

One process at a time leads; what it does is safe beside others all the same, since every step repeats its conditions
in the statement that takes it.
"""

from __future__ import annotations

import asyncio
import logging
import secrets
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from functools import partial
from typing import Concatenate, ParamSpec, TypeVar

from marey_server.access.principal import SYSTEM
from marey_server.errors import MareyError
from marey_server.services import Services
from marey_server.store import leader, reaper
from marey_server.store.garbage import collect_garbage
from marey_server.store.reaper import StartGrace
from marey_server.store.transaction import Transaction

P = ParamSpec("P")
T = TypeVar("T")

log = logging.getLogger(__name__)

LEAD = "housekeeping"
LEAD_TTL_US = 30_000_000
LONGEST_TICK_S = 5.0
GARBAGE_EVERY_S = 3600.0


@asynccontextmanager
async def keeping_house(services: Services) -> AsyncIterator[None]:
    """Keep house inside the block; at its end, let another process lead."""
    holder = secrets.token_hex(8)
    tick_s = min(LONGEST_TICK_S, services.queue_policy.lease_ttl_s / 4)
    tasks = [
        asyncio.create_task(_repeat(services, tick_s, partial(_tend_queue, services, holder))),
        asyncio.create_task(_repeat(services, GARBAGE_EVERY_S, partial(_collect_garbage, services, holder))),
    ]
    try:
        yield
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        await _write(services, leader.give_up_lead, LEAD, holder)


async def _repeat(services: Services, every_s: float, action: Callable[[], Awaitable[None]]) -> None:
    """Do it now and then. A failure is told and is no reason to stop; a database that was away gets its grace."""
    while True:
        await asyncio.sleep(every_s)
        try:
            await action()
        except MareyError as error:
            services.start_grace.restart()
            log.warning("housekeeping was interrupted: %s", error.detail)
        except Exception:
            log.exception("housekeeping failed")


async def _tend_queue(services: Services, holder: str) -> None:
    leads, may_reap = await _write(services, _look_round, holder, services.start_grace)
    if leads and may_reap:
        await _reap(services)
    while leads and await _write(services, reaper.share_waiting) > 0:
        pass


def _look_round(tx: Transaction, holder: str, grace: StartGrace) -> tuple[bool, bool]:
    """Whether this process leads, and whether workers have had time to renew their leases."""
    return leader.take_lead(tx, LEAD, holder, LEAD_TTL_US) is not None, grace.over(tx.now_us)


async def _reap(services: Services) -> None:
    """Take back every overdue lease, page by page."""
    if await _write(services, reaper.correct_times, services.queue_policy):
        log.warning("the database's clock was set back; times of leases were corrected")
    page = await _write(services, reaper.reap_page, services.queue_policy)
    taken = page.taken
    while page.after is not None:
        page = await _write(services, reaper.reap_page, services.queue_policy, page.after)
        taken += page.taken
    if taken:
        log.warning("took %d jobs back from workers that are not heard of any more", taken)


async def _collect_garbage(services: Services, holder: str) -> None:
    if await _write(services, leader.take_lead, LEAD, holder, LEAD_TTL_US) is not None:
        collected = await asyncio.wrap_future(services.submit(collect_garbage, services.database))
        log.info("collected garbage: %s", collected)


async def _write(
    services: Services, function: Callable[Concatenate[Transaction, P], T], *args: P.args, **kwargs: P.kwargs
) -> T:
    return await asyncio.wrap_future(services.database.submit_write(SYSTEM, function, *args, **kwargs))
