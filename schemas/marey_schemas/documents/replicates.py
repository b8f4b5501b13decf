"""Means of replicates, which are measurements that differ only by chance, with confidence intervals.

Server, client, library and reports use this module. It does not use numpy, because a mean has few replicates.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cache
from typing import NamedTuple

from marey_schemas.documents.evaluations import CONFIDENCE

LEAST_REPLICATES = 3
"""Least number of measurements for an interval. The interval of two would be 12.7 times as wide as their difference."""


class MeanInterval(NamedTuple):
    """Mean of `n` measurements; the ends of its interval are None if there are fewer than `LEAST_REPLICATES`."""

    n: int
    mean: float
    low: float | None
    high: float | None


def mean_interval(values: Sequence[float]) -> MeanInterval:
    """Compute the mean of measurements, and its 95 % confidence interval by Student's t distribution.

    The interval assumes that the measurements are independent and roughly normally distributed.

    Parameters
    ----------
    values : (n,) float    finite measurements, at least one, in any unit

    Returns
    -------
    MeanInterval    in the unit of the measurements; both ends are None for fewer than `LEAST_REPLICATES` values, and
        an end that is too large for a float is None
    """
    count, largest = len(values), max(map(abs, values)) or 1.0
    # Divided by the largest, so that sums and squares of huge values stay finite.
    scaled = [value / largest for value in values]
    mean = math.fsum(scaled) / count
    if count < LEAST_REPLICATES:
        return MeanInterval(count, mean * largest, None, None)
    deviation = math.sqrt(math.fsum((value - mean) ** 2 for value in scaled) / (count - 1))
    half = student_quantile(count - 1) * deviation / math.sqrt(count)
    low, high = ((mean + sign * half) * largest for sign in (-1.0, 1.0))
    return MeanInterval(count, mean * largest, *(end if math.isfinite(end) else None for end in (low, high)))


@cache
def student_quantile(degrees: int) -> float:
    """Compute the distance from 0 within which Student's t with a number of degrees of freedom lies in 95 % of cases.

    Parameters
    ----------
    degrees : int    degrees of freedom, at least 1

    Returns
    -------
    float    the distance, without a unit

    Notes
    -----
    The distribution is that of Abramowitz and Stegun (1964), equations 26.7.3 and 26.7.4; it is inverted by bisection.
    """
    low, high = 1.9, 13.0
    for _ in range(60):
        middle = (low + high) / 2.0
        low, high = (middle, high) if _within(middle, degrees) < CONFIDENCE else (low, middle)
    return (low + high) / 2.0


def _within(distance: float, degrees: int) -> float:
    """Compute the probability that the absolute value of Student's t is less than a distance."""
    angle = math.atan(distance / math.sqrt(degrees))
    odd = degrees % 2
    term = total = 0.0 if degrees == 1 else math.cos(angle) if odd else 1.0
    for step in range(2 + odd, degrees - 1, 2):
        term *= (step - 1) / step * math.cos(angle) ** 2
        total += term
    return 2.0 / math.pi * (angle + math.sin(angle) * total) if odd else math.sin(angle) * total
