"""When a request is sent again, and how long to wait before."""

from __future__ import annotations

import random
import time
from collections.abc import Callable
from dataclasses import dataclass, field

import httpx

NEVER_ARRIVED = (httpx.ConnectError, httpx.ConnectTimeout, httpx.PoolTimeout)
"""Failures after which the server cannot have seen the request."""

BUSY_STATUSES = frozenset({429, 502, 503, 504})
"""Answers that mean "not now": nothing was done."""


@dataclass(frozen=True)
class Retries:
    """Exponential backoff with full jitter, bounded in number and time.

    Parameters
    ----------
    tries : how often a request is sent at most
    first_s, longest_s : the wait before the second try is at most `first_s`, doubles, and never exceeds `longest_s`
    total_s : no try starts later than this after the first
    sleep, uniform : replaceable in tests
    """

    tries: int = 10
    first_s: float = 0.25
    longest_s: float = 15.0
    total_s: float = 90.0
    sleep: Callable[[float], None] = field(default=time.sleep, repr=False)
    uniform: Callable[[float, float], float] = field(default=random.uniform, repr=False)

    def delay_s(self, tried: int, retry_after_s: float | None) -> float:
        """Seconds to wait after `tried` tries; never less than the server asked for."""
        ceiling = min(self.longest_s, self.first_s * 2 ** (tried - 1))
        return self.uniform(ceiling / 2, ceiling) + (retry_after_s or 0.0)


ONCE = Retries(tries=1)


def retry_after_s(response: httpx.Response) -> float | None:
    """Seconds the server asks to wait, where it says so in seconds."""
    value = response.headers.get("Retry-After", "")
    return float(value) if value.isdigit() else None
