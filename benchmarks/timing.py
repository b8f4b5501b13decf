"""Timing of several functions in turn, so that a change of the machine's speed affects all of them.

Functions in this process are measured by their processor time, summed over all threads. Wall time would also depend on
other programs on the machine.
"""

from __future__ import annotations

import gc
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True)
class Timing:
    """Best and median processor time of a call, in seconds."""

    best_s: float
    median_s: float

    def shown(self, per_second: float, unit: str, digits: int = 1) -> str:
        """Return the median as text, with the best in parentheses; one second equals `per_second` of the unit."""
        return f"{self.median_s * per_second:.{digits}f} ({self.best_s * per_second:.{digits}f}) {unit}"


@dataclass(frozen=True)
class Row:
    """One line of the report.

    `ratio` compares Marey with another library in the same run; it is above 1 if Marey is better, and None if there is
    no other library. `met` is None if there is no goal.
    """

    job: str
    size: str
    ours: str
    peer: str = ""
    ratio: float | None = None
    goal: str = ""
    met: bool | None = None


def time_in_turn(*contenders: Callable[[], object], repeats: int = 7) -> list[Timing]:
    """Call each function once as a warm-up, then all functions in turn, `repeats` times.

    Returns one timing for each function, in the same order.
    """
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
