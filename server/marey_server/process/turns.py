"""Line of requests whose headers have arrived: few begin in each round of the event loop, and clients take turns.

In each round, the event loop first handles everything that has arrived, then looks at the network again; a request
takes several rounds. Suppose that two hundred connections send requests without a pause. If all of them begin at once,
each round takes two hundred times as long as a request, and all clients wait for several rounds. If a few begin in each
round, a round takes some milliseconds, and a client waits for one request of every other client.
"""

from __future__ import annotations

import asyncio

from marey_server.store.database.lanes import Client, FairLine

BEGUN_PER_ROUND = 2
"""Number of requests that begin in one round of the event loop if more are waiting."""
RESERVED_PER_ROUND = 1
"""Number of places in a round that are offered to reserved operations, such as heartbeats, before other requests.

The other places are offered to reserved operations only if no other request is waiting.
"""
_ENDLESS = 2**62
"""Limit of a line; it is never reached, because the number of connections is limited already."""


class Turns:
    """Queue of requests that wait for their turn. In each round of the event loop, a limited number of them begins."""

    def __init__(self) -> None:
        self._reserved: FairLine[asyncio.Future[None]] = FairLine(_ENDLESS, _ENDLESS)
        self._ordinary: FairLine[asyncio.Future[None]] = FairLine(_ENDLESS, _ENDLESS)
        self._left = BEGUN_PER_ROUND
        self._in_round = False

    def __len__(self) -> int:
        return len(self._reserved) + len(self._ordinary)

    def take(self, client: Client, *, reserved: bool) -> asyncio.Future[None] | None:
        """Return a future that ends when it is the request's turn, or None if the request may begin at once.

        With `reserved`, the request waits in the line of reserved operations, such as heartbeats. In each round, this
        line has `RESERVED_PER_ROUND` places of its own.
        """
        if not self._in_round:
            self._in_round = True
            asyncio.get_running_loop().call_soon(self._begin_round)
        if self._left and not len(self):
            self._left -= 1
            return None
        turn: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        (self._reserved if reserved else self._ordinary).put(client, turn)
        return turn

    def _begin_round(self) -> None:
        self._left = BEGUN_PER_ROUND
        self._in_round = len(self) > 0
        if self._in_round:
            asyncio.get_running_loop().call_soon(self._begin_round)
        for number in range(BEGUN_PER_ROUND):
            first, second = self._reserved, self._ordinary
            if number >= RESERVED_PER_ROUND:
                first, second = second, first
            turn = first.take() or second.take()
            if turn is None:
                return
            self._left -= 1
            if not turn.done():  # cancelled by a server that stops
                turn.set_result(None)
