"""How often sign-in may be tried."""

from __future__ import annotations

import math
import time
from collections.abc import Callable

from marey_schemas.lru import LruCache
from marey_server.errors import TooManyRequests

REMEMBERED = 10_000


class TryLimit:
    """So many tries per minute and key: a bucket that fills again steadily.

    Only the latest `REMEMBERED` keys are kept, so that guesses at many names do not fill the memory.
    """

    def __init__(self, per_minute: int, *, clock: Callable[[], float] = time.monotonic) -> None:
        self._per_minute = per_minute
        self._clock = clock
        self._buckets: LruCache[str, tuple[float, float]] = LruCache(max_entries=REMEMBERED)

    def take(self, key: str) -> None:
        """Count one try. Raises `TooManyRequests`, saying when the next is allowed."""
        now = self._clock()
        left, since = self._buckets.get(key) or (float(self._per_minute), now)
        left = min(float(self._per_minute), left + (now - since) * self._per_minute / 60)
        if left < 1:
            self._buckets.put(key, (left, now))
            wait_s = math.ceil((1 - left) * 60 / self._per_minute)
            raise TooManyRequests(f"Too many tries; wait {wait_s} s.", headers={"Retry-After": str(wait_s)})
        self._buckets.put(key, (left - 1, now))
