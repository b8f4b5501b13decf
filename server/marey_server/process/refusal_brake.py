"""Delays of refusals while the event loop is late, for clients whose requests are often refused.

Every request, even a refused one, takes a few milliseconds of the event loop. If two hundred connections send only
refused requests, all other clients wait for seconds. So while the event loop is late, a client that was refused several
times must wait for its next refusal. Meanwhile, the event loop has time for other clients. Such a client is also
treated as a client without a known token, so that its requests begin after the requests of other clients.

A thread that computes gives way to the event loop after some time, in Python by default after 5 ms. The loop waits
this long after almost every system call. While the event loop is late, the server sets a shorter time. Otherwise the
default applies, because a shorter time makes all work some percent slower.
"""

from __future__ import annotations

import asyncio
import contextlib
import sys
import time
from collections.abc import Iterator

from marey_schemas.backoff import spread
from marey_schemas.lru import LruCache

EVERY_S = 0.05
"""Time in seconds between two measurements of the lateness of the event loop."""
KEPT_SHARE = 0.98
"""Smallest ratio of a measured lateness to the previous one, so that the lateness decreases slowly."""
TOLERATED_S = 0.1
"""Lateness in seconds up to which no refusal is delayed, except in a crowd (see `CROWD`)."""
DELAY_PER_LATENESS = 10.0
CROWD = 32
"""Number of requests above which there is a crowd: requests that wait for their turn, and delayed refusals.

In a crowd, refusals of clients with many requests at once are delayed earlier and for longer. Delayed refusals count,
because otherwise the delays would end the crowd, and the end of the delays would bring it back.
"""
FEW_AT_ONCE = 3
"""Number of simultaneous requests up to which a client does not belong to a crowd.

A program that sends one request after another hardly makes the event loop late. It may be refused often without being
hostile: it may ask, for example, which of many items exist.
"""
TOLERATED_OF_CROWD_S = 0.02
DELAY_PER_LATENESS_OF_CROWD = 100.0
LONGEST_S = 5.0
GIVES_WAY_S = 0.0005
"""Time in seconds after which a thread that computes gives way to another one while the event loop is late."""
USUALLY_GIVES_WAY_S = sys.getswitchinterval()
FREE_REFUSALS = 10
"""Number of refusals of a client that are never delayed, if it was not refused before."""
FORGIVEN_EVERY_S = 1.0
"""Time in seconds after which one refusal of a client no longer counts.

Refusals are forgiven one after another. If all were forgiven at once, hostile clients would come back in waves.
"""
MEASURED_S = 10.0
"""Time in seconds after the last refusal for which the lateness is measured."""
CLIENTS_REMEMBERED = 10_000


class RefusalBrake:
    """Delays of refused clients, computed from the lateness of the event loop.

    The lateness is measured only while requests are refused.
    """

    def __init__(self) -> None:
        self.late_s = 0.0
        self._delayed = 0
        """Number of refusals that are being delayed."""
        self._due_s = 0.0
        self._last_refusal_s = 0.0
        self._timer: asyncio.TimerHandle | None = None
        self._refusals: LruCache[str, tuple[float, float]] = LruCache(max_entries=CLIENTS_REMEMBERED)
        """Number of refusals that count, and when it was computed, by client."""

    def delay_s(self, client: str, *, at_once: int = 1, waiting: int = 0) -> float:
        """Count a refusal of a client, and return the time in seconds that the client must wait for the answer.

        `at_once` is the number of requests of this client that are under way, `waiting` the number of requests of all
        clients that wait for their turn.
        """
        now_s = self._last_refusal_s = time.monotonic()
        if self._timer is None:
            self._measure_later(now_s)
        count = self._count(client, now_s) + 1
        self._refusals.put(client, (count, now_s))
        crowd = waiting + self._delayed > CROWD and at_once > FEW_AT_ONCE
        if self.late_s <= (TOLERATED_OF_CROWD_S if crowd else TOLERATED_S) or count <= FREE_REFUSALS:
            return 0.0
        delay_s = (DELAY_PER_LATENESS_OF_CROWD if crowd else DELAY_PER_LATENESS) * self.late_s
        return spread(min(LONGEST_S, delay_s), 0.5)  # delays that end at once bring all back at once

    @contextlib.contextmanager
    def delaying(self) -> Iterator[None]:
        """Count one more refusal that is being delayed, while the `with` block runs."""
        self._delayed += 1
        try:
            yield
        finally:
            self._delayed -= 1

    def is_often_refused(self, client: str) -> bool:
        """Return whether a client is refused often at the moment.

        This means that more than `FREE_REFUSALS` of its refusals still count; each one counts for a limited time.
        """
        return self._count(client, time.monotonic()) > FREE_REFUSALS

    def _count(self, client: str, now_s: float) -> float:
        count, counted_s = self._refusals.get(client) or (0.0, now_s)
        return max(0.0, count - (now_s - counted_s) / FORGIVEN_EVERY_S)

    def _measure_later(self, now_s: float) -> None:
        self._due_s = now_s + EVERY_S
        self._timer = asyncio.get_running_loop().call_later(EVERY_S, self._measure)

    def _measure(self) -> None:
        now_s = time.monotonic()
        self.late_s = max(now_s - self._due_s, KEPT_SHARE * self.late_s)
        self._timer = None
        measures = now_s - self._last_refusal_s < MEASURED_S
        sys.setswitchinterval(GIVES_WAY_S if measures and self.late_s > TOLERATED_OF_CROWD_S else USUALLY_GIVES_WAY_S)
        if measures:
            self._measure_later(now_s)
