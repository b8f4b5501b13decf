"""Clients whose requests are refused often: their refusals are delayed while the event loop is late.

Every request, even a refused one, takes a few milliseconds of the event loop. If two hundred connections send only
refused requests, all other clients wait for seconds. So while the event loop is late, a client that was refused several
times must wait for its next refusal. Meanwhile, the event loop has time for other clients. Such a client is also
treated as a client without a known token, so that its requests begin after the requests of other clients.
"""

from __future__ import annotations

import asyncio
import time

from marey_schemas.lru import LruCache

EVERY_S = 0.05
"""Time in seconds between two measurements of the lateness of the event loop."""
KEPT_SHARE = 0.9
"""Smallest ratio of a measured lateness to the previous one, so that the lateness decreases slowly."""
TOLERATED_S = 0.1
"""Lateness in seconds up to which no refusal is delayed."""
DELAY_PER_LATENESS = 10.0
LONGEST_S = 5.0
FREE_REFUSALS = 10
"""Number of refusals of a client in `WINDOW_S` that are never delayed."""
WINDOW_S = 10.0
CLIENTS_REMEMBERED = 10_000


class RefusalBrake:
    """Delays of refused clients, computed from the lateness of the event loop.

    The lateness is measured only while requests are refused.
    """

    def __init__(self) -> None:
        self.late_s = 0.0
        self._due_s = 0.0
        self._last_refusal_s = 0.0
        self._timer: asyncio.TimerHandle | None = None
        self._refusals: LruCache[str, tuple[float, int]] = LruCache(max_entries=CLIENTS_REMEMBERED)
        """Beginning of the window and number of refusals in it, by client."""

    def delay_s(self, client: str) -> float:
        """Count a refusal of a client, and return the time in seconds that the client must wait for the answer."""
        now_s = self._last_refusal_s = time.monotonic()
        if self._timer is None:
            self._measure_later(now_s)
        since_s, count = self._refusals.get(client) or (now_s, 0)
        if now_s - since_s > WINDOW_S:
            since_s, count = now_s, 0
        self._refusals.put(client, (since_s, count + 1))
        if self.late_s <= TOLERATED_S or count < FREE_REFUSALS:
            return 0.0
        return min(LONGEST_S, DELAY_PER_LATENESS * self.late_s)

    def is_often_refused(self, client: str) -> bool:
        """Return whether a client was refused more than `FREE_REFUSALS` times within `WINDOW_S`."""
        since_s, count = self._refusals.get(client) or (0.0, 0)
        return count > FREE_REFUSALS and time.monotonic() - since_s <= WINDOW_S

    def _measure_later(self, now_s: float) -> None:
        self._due_s = now_s + EVERY_S
        self._timer = asyncio.get_running_loop().call_later(EVERY_S, self._measure)

    def _measure(self) -> None:
        now_s = time.monotonic()
        self.late_s = max(now_s - self._due_s, KEPT_SHARE * self.late_s)
        self._timer = None
        if now_s - self._last_refusal_s < WINDOW_S:
            self._measure_later(now_s)
