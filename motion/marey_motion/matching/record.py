"""The record of a simulated trial, tick by tick."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray


class Status(IntEnum):
    """Relation of the displayed row at a tick to the rows before and after it."""

    KEPT = 0
    """The displayed row continues the clip that was displayed at the previous tick."""
    REPLACING = 1
    """A search chose another frame: the displayed row is the first after a switch."""
    REPLACED = 2
    """The displayed row is the last before a switch; `REPLACING` and `FORCED` have precedence over this status."""
    FORCED = 3
    """The displayed row is the first of the trial, the first of a loop's new round, or the first after a clip's end."""


@dataclass(frozen=True, eq=False)
class TrialRecord:
    """Record of T ticks of a character driven by motion matching.

    Parameters
    ----------
    rate_hz : ticks per second
    rows : (T,) int32    displayed database row; if a search chooses a row at one tick, the successor of this row is
        displayed at the next tick
    positions : (T, 2) float64    root on the ground, metres
    headings : (T,) float64    radians, continuous
    status : (T,) int8    `Status`
    match_cost : (T,) float64    cost of the chosen row; if poses are compared by features, the squared distance between
        normalised features. NaN at ticks without a search
    continuing_cost : (T,) float64    cost of continuing the displayed clip, comparable to `match_cost`; NaN at the
        first tick, at ticks without a search and at the end of the clip
    pose_cost : (T,) float64    distance in metres, summed over the pose joints, from the displayed pose to the pose of
        the row that follows at the next tick. The displayed pose includes the remaining offsets of earlier switches;
        the pose of the following row has no offsets
    """

    rate_hz: float
    rows: NDArray[np.int32]
    positions: NDArray[np.float64]
    headings: NDArray[np.float64]
    status: NDArray[np.int8]
    match_cost: NDArray[np.float64]
    continuing_cost: NDArray[np.float64]
    pose_cost: NDArray[np.float64]
