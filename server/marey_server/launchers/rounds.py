"""Task that adjusts workers at regular intervals; of several servers, only the leader runs it.

An error of the engine, or of the database, never stops the server: it is logged, and the task tries again later.
"""

from __future__ import annotations

import asyncio
import logging
import secrets
from collections.abc import Awaitable, Callable
from typing import TypeVar

from marey_schemas.backoff import Backoff
from marey_server.access.principal import SYSTEM
from marey_server.errors import ApiProblem
from marey_server.launchers.launcher import EngineError
from marey_server.store import leader
from marey_server.store.database.connections import Database

T = TypeVar("T")

log = logging.getLogger(__name__)

ENGINE_S = 60.0
"""Greatest number of seconds that a call of a method of an engine may take."""
LEAD_TTL_US = 60_000_000
FAULT_PAUSES = Backoff(first_s=10.0, longest_s=300.0, jitter=0.25)


async def repeat(name: str, adjust: Callable[[], Awaitable[None]], round_s: float) -> None:
    """Call `adjust` every `round_s` seconds until the task is cancelled; after an error, wait longer."""
    faults = 0
    while True:
        try:
            await adjust()
            if faults:
                log.info("%s: the engine answers again", name)
            faults = 0
        except (EngineError, ApiProblem) as error:
            faults += 1
            log.warning("%s: %s", name, getattr(error, "detail", error))
        except Exception:
            faults += 1
            log.exception("%s: the workers could not be adjusted", name)
        await asyncio.sleep(FAULT_PAUSES.delay_s(faults) if faults else round_s)


async def ask(call: Awaitable[T]) -> T:
    """Wait for a call of a launcher's method and return its result. Raises `EngineError` after `ENGINE_S` seconds."""
    try:
        async with asyncio.timeout(ENGINE_S):
            return await call
    except TimeoutError:
        raise EngineError(f"the engine did not answer within {ENGINE_S:.0f} s to a request about workers") from None


class ServerLead:
    """Leadership among the servers that share a database: a named lease, which one process holds."""

    def __init__(self, database: Database, name: str) -> None:
        self._database = database
        self._name = name
        self._holder = secrets.token_hex(8)

    async def take(self) -> bool:
        """Become or remain the leader if possible; return whether this process is the leader."""
        lease = (self._name, self._holder, LEAD_TTL_US)
        taken = self._database.submit_write(SYSTEM, leader.take_lead, *lease)
        return await asyncio.wrap_future(taken) is not None

    async def give_up(self) -> None:
        """Stop being the leader, so that another server can become the leader."""
        given = self._database.submit_write(SYSTEM, leader.give_up_lead, self._name, self._holder)
        await asyncio.wrap_future(given)
