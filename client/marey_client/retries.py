"""Retries of requests: the failures that are retried, the number of tries, and the waits between them."""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import dataclass, field

import httpx

from marey_client.asynchronous.interruption import pause
from marey_schemas.backoff import Backoff

NEVER_ARRIVED = (httpx.ConnectError, httpx.ConnectTimeout, httpx.PoolTimeout)
"""Failures after which the server cannot have seen the request."""

TRIES_IN_SILENCE = 3
"""Number of failed tries after which waits are reported; all earlier waits take less than two seconds in total."""

BUSY_STATUSES = frozenset({429, 502, 503, 504})
"""HTTP statuses by which a server refuses a request temporarily, without having processed it."""


@dataclass(frozen=True)
class Retries:
    """Exponential backoff with jitter; the number of tries and the total time are limited.

    Parameters
    ----------
    tries : greatest number of times that a request is sent
    first_s : longest wait before the second try, in seconds; the wait doubles with each further try
    longest_s : limit of the doubled wait, in seconds
    total_s : longest time between the first try and the start of the last one, in seconds
    notice : function that is called with a text before each wait from the third failed try on
    sleep, random_unit : replaceable in tests; `random_unit` returns a random number in [0, 1)
    """

    tries: int = 10
    first_s: float = 0.25
    longest_s: float = 15.0
    total_s: float = 90.0
    notice: Callable[[str], None] | None = field(default=None, repr=False)
    sleep: Callable[[float], None] = field(default=pause, repr=False)
    random_unit: Callable[[], float] = field(default=random.random, repr=False)

    def delay_s(self, tried: int, retry_after_s: float | None) -> float:
        """Return the wait in seconds after `tried` tries: the backoff, plus the wait that the server requested."""
        backoff = Backoff(self.first_s, self.longest_s, random_unit=self.random_unit)
        return backoff.delay_s(tried) + (retry_after_s or 0.0)

    def report_wait(self, url: str, tried: int, elapsed_s: float, *, busy: bool) -> None:
        """Call `notice` with a text on the server and the remaining time, except after the first few failed tries."""
        if self.notice is not None and tried >= TRIES_IN_SILENCE:
            left_s = max(1, round(self.total_s - elapsed_s))
            self.notice(f"{url} {'is busy' if busy else 'does not answer'}; trying again for {left_s} s")


ONCE = Retries(tries=1)


def retry_after_s(response: httpx.Response) -> float | None:
    """Return the header `Retry-After` in seconds; None if the header is missing or is a date."""
    value = response.headers.get("Retry-After", "")
    return float(value) if value.isdigit() else None
