"""Descriptions of speeds, turn rates and missing data in an animator's words."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from marey_motion.arrays import Floats
from marey_motion.evaluation.result import Coverage
from marey_motion.evaluation.scenario import STRAIGHT_DEG_S
from marey_reports.drawing.words import span


class CoverageGap(NamedTuple):
    """Rectangle of neighbouring cells of speed and turn rate that lack data, and the seconds to record there.

    Parameters
    ----------
    turn_rates_deg_s, speeds_m_s : centres of the outermost cells, lowest first
    missing_s : seconds of data missing in all cells of the rectangle together
    """

    turn_rates_deg_s: tuple[float, float]
    speeds_m_s: tuple[float, float]
    missing_s: float

    @property
    def words(self) -> str:
        """Description of the range, such as "left turns of 75 to 100 degrees a second at 2 to 3 m/s"."""
        return f"{turning(*self.turn_rates_deg_s)} at {span(*self.speeds_m_s)} m/s"


def find_holes(coverage: Coverage) -> list[CoverageGap]:
    """Combine the cells without enough data into few rectangles, the rectangle that lacks most data first.

    First, neighbouring cells of equal speed are joined to runs; a run contains only left turns, only right turns or
    only straight motion. Then, runs over the same turn rates at neighbouring speeds are joined to rectangles.
    """
    lacking = coverage.deficit_s > 0.0
    speeds, turns = (_centres(edges) for edges in (coverage.speed_edges_m_s, coverage.turn_rate_edges_deg_s))
    sides = np.where(np.abs(turns) <= STRAIGHT_DEG_S, 0.0, np.sign(turns))
    done: list[tuple[int, int, int, int]] = []  # first and last column, first and last row
    for row in range(len(lacking)):
        for first, last in _runs(lacking[row], sides):
            before = next((hole for hole in done if hole[:2] == (first, last) and hole[3] == row - 1), None)
            if before is not None:
                done[done.index(before)] = (first, last, before[2], row)
            else:
                done.append((first, last, row, row))
    holes = [
        CoverageGap(
            (float(turns[first]), float(turns[last])),
            (float(speeds[low]), float(speeds[high])),
            float(coverage.deficit_s[low : high + 1, first : last + 1].sum()),
        )
        for first, last, low, high in done
    ]
    return sorted(holes, key=lambda hole: (-hole.missing_s, hole))


def turning(low_deg_s: float, high_deg_s: float) -> str:
    """Describe a range of turn rates to one side, or straight motion, in words."""
    least, most = sorted((abs(low_deg_s), abs(high_deg_s)))
    if most <= STRAIGHT_DEG_S:
        return "straight ahead"
    side = "left" if low_deg_s + high_deg_s > 0.0 else "right"
    return f"{side} turns of {span(least, most)} degrees a second"


def _centres(edges: Floats) -> Floats:
    return np.round(0.5 * (edges[:-1] + edges[1:]), 9)


def _runs(lacking: NDArray[np.bool_], sides: Floats) -> list[tuple[int, int]]:
    """Find runs of neighbouring cells that lack data and have the same side; return the first and last cell of each.

    `sides` contains, for each cell, whether it has left turns, right turns or straight motion.
    """
    runs: list[tuple[int, int]] = []
    for column in np.flatnonzero(lacking).tolist():
        if runs and runs[-1][1] == column - 1 and sides[column] == sides[column - 1]:
            runs[-1] = (runs[-1][0], column)
        else:
            runs.append((column, column))
    return runs
