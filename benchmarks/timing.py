"""Timing two ways of doing the same thing in turn, so that a drifting machine slows both."""

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


@dataclass(frozen=True)
class Row:
    """One line of the report.

    `ratio` compares with the peer of the same run, above 1 where Marey is better; None where the goal is absolute.
    """

    job: str
    size: str
    ours: str
    peer: str
    ratio: float | None
    goal: str
    met: bool


def time_in_turn(ours: Callable[[], object], peer: Callable[[], object], repeats: int = 7) -> tuple[Timing, Timing]:
    """Call both `repeats` times, alternating, after one warm-up of each (compilation, caches)."""
    ours()
    peer()
    mine: list[float] = []
    theirs: list[float] = []
    for _ in range(repeats):
        mine.append(_time_once(ours))
        theirs.append(_time_once(peer))
    return _summary(mine), _summary(theirs)


def time_alone(ours: Callable[[], object], repeats: int = 7) -> Timing:
    """Call `repeats` times after one warm-up."""
    ours()
    return _summary([_time_once(ours) for _ in range(repeats)])


def _time_once(function: Callable[[], object]) -> float:
    gc.collect()
    start = time.perf_counter()
    function()
    return time.perf_counter() - start


def _summary(seconds: list[float]) -> Timing:
    return Timing(min(seconds), statistics.median(seconds))
