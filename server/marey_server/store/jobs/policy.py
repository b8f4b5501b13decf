"""Durations and limits of the queue, configurable by server settings and tests."""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import dataclass

from marey_schemas.backoff import Backoff

SECOND_US = 1_000_000


@dataclass(frozen=True)
class QueuePolicy:
    """Durations of leases and waits, and limits of retries.

    `random_unit` draws from [0, 1); tests replace this function to make the backoff predictable.
    """

    lease_ttl_s: float = 60.0
    heartbeat_s: float = 15.0
    end_grace_s: float = 30.0  # how long a worker may take to stop after a cancel or the end of its time
    first_backoff_s: float = 10.0
    longest_backoff_s: float = 15 * 60.0
    max_interruptions: int = 20
    max_unstarted: int = 10
    """Greatest number of claims of a job whose leases expire before the worker has written anything.

    Such claims do not count as attempts, because the answer to the claim may have been lost. Without this limit, a job
    that kills each worker right after its claim would never end.
    """
    log_limit_bytes: int = 10 * 2**20
    random_unit: Callable[[], float] = random.random

    @property
    def lease_ttl_us(self) -> int:
        """Length of a lease in microseconds."""
        return round(self.lease_ttl_s * SECOND_US)

    @property
    def end_grace_us(self) -> int:
        """Time that a worker has to stop after a cancellation or at its time limit, in microseconds."""
        return round(self.end_grace_s * SECOND_US)

    def backoff_us(self, failures: int) -> int:
        """Return the wait in microseconds before a retry, after the given number of failures.

        The wait after the first failure is `first_backoff_s`. Each further failure makes it four times as long, up to
        `longest_backoff_s`. Up to a quarter of the wait is subtracted at random.
        """
        backoff = Backoff(
            self.first_backoff_s, self.longest_backoff_s, factor=4.0, jitter=0.25, random_unit=self.random_unit
        )
        return round(backoff.delay_s(failures) * SECOND_US)


DEFAULT_POLICY = QueuePolicy()
