"""Timing several ways of doing the same thing in turn, so that a drifting machine slows all of them.

What is timed in this process is its processor time, all threads together: on a machine that others use, wall time
tells more about them.
"""

from __future__ import annotations

import gc
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True)
class Timing:
    """Seconds per call."""

    best_s: float
    median_s: float

    def shown(self, per_second: float, unit: str, digits: int = 1) -> str:
        """Median, and the best in parentheses, in another unit, of which a second has `per_second`."""
        return f"{self.median_s * per_second:.{digits}f} ({self.best_s * per_second:.{digits}f}) {unit}"


@dataclass(frozen=True)
class Row:
    """One line of the report.

    `ratio` compares with the peer of the same run, above 1 where Marey is better; None where there is none to compare
    with. `met` is None where there is no goal.
    """

    job: str
    size: str
    ours: str
    peer: str = ""
    ratio: float | None = None
    goal: str = ""
    met: bool | None = None


def time_in_turn(*contenders: Callable[[], object], repeats: int = 7) -> list[Timing]:
    """Call each `repeats` times, in turn, after one warm-up of each (compilation, caches)."""
    for call in contenders:
        call()
    seconds: list[list[float]] = [[] for _ in contenders]
    for _ in range(repeats):
        for call, taken in zip(contenders, seconds, strict=True):
            taken.append(_time_once(call))
    return [Timing(min(taken), statistics.median(taken)) for taken in seconds]


def _time_once(function: Callable[[], object]) -> float:
    gc.collect()
    start = time.process_time()
    function()
    return time.process_time() - start
