"""Delays between retries: they grow with each failure, and are random so that many callers do not retry at once."""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import dataclass, field

MOST_STEPS = 64
"""Greatest exponent of the growth factor, so that numbers do not overflow."""


@dataclass(frozen=True)
class Backoff:
    """Exponential backoff with jitter.

    Parameters
    ----------
    first_s : seconds to wait after the first failure
    longest_s : longest wait in seconds
    factor : factor by which the wait grows with each failure
    jitter : largest share of a wait that is subtracted at random, from 0 to 1
    random_unit : function that returns a random number in [0, 1); tests replace it to make the waits predictable
    """

    first_s: float
    longest_s: float
    factor: float = 2.0
    jitter: float = 0.5
    random_unit: Callable[[], float] = field(default=random.random, repr=False)

    def delay_s(self, failures: int) -> float:
        """Return the seconds to wait after the given number of failures; the first failure is 1."""
        steps = min(failures - 1, MOST_STEPS)
        return spread(min(self.longest_s, self.first_s * self.factor**steps), self.jitter, self.random_unit)


def spread(seconds: float, share: float, random_unit: Callable[[], float] = random.random) -> float:
    """Return a duration in seconds minus a random part of it; at most the fraction `share` (0 to 1) is subtracted."""
    return seconds * (1.0 - share * random_unit())
