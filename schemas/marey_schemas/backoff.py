"""Waiting times between tries: longer after each failure, and random, so that many callers do not come back at once."""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import dataclass, field

MOST_STEPS = 64
"""Of growth; after that, no wait is below the longest one that anybody allows."""


@dataclass(frozen=True)
class Backoff:
    """Exponential backoff with jitter.

    Parameters
    ----------
    first_s : seconds to wait after the first failure
    longest_s : seconds that no wait exceeds
    factor : growth of the wait from one failure to the next
    jitter : largest share of a wait that is taken off at random; 1 for any wait from zero on
    random_unit : draws from [0, 1); a test that gives its own makes the waits predictable
    """

    first_s: float
    longest_s: float
    factor: float = 2.0
    jitter: float = 0.5
    random_unit: Callable[[], float] = field(default=random.random, repr=False)

    def delay_s(self, failures: int) -> float:
        """Return the seconds to wait after so many failures, of which the first is 1."""
        steps = min(failures - 1, MOST_STEPS)
        return spread(min(self.longest_s, self.first_s * self.factor**steps), self.jitter, self.random_unit)


def spread(seconds: float, share: float, random_unit: Callable[[], float] = random.random) -> float:
    """Take up to `share` of some seconds off at random."""
    return seconds * (1.0 - share * random_unit())
