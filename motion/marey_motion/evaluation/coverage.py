"""Coverage of a set of clips: windows of one second, counted over cells of speed and turn rate.

A window never spans two clips. The cells are centred on the points of the trial grid, with edges half-way between
neighbours, so each trial has its own cell. Windows beyond the outermost cells are listed, but not counted in the cells.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from marey_motion.arrays import Floats
from marey_motion.errors import MotionError
from marey_motion.evaluation.result import Coverage
from marey_motion.matching.database import MatchingDatabase
from marey_schemas.options.evaluation import EvaluationOptions

WINDOW_S = 1.0
SPEED_STEP_M_S, TURN_RATE_STEP_DEG_S = 0.25, 25.0
"""Width of a cell if the grid has only one speed, or only one turn rate."""
EDGE_DECIMALS = 9
"""Decimals to which edges of cells are rounded, so that the edges of left and right turns are equal."""


class Windows(NamedTuple):
    """Mean speed, turn rate and velocities in W windows of one second, which start one frame apart; arrays (W,)."""

    speed_m_s: Floats
    turn_rate_rad_s: Floats
    forward_m_s: Floats
    strafe_m_s: Floats


def sliding_windows(positions: Floats, headings: Floats, rate_hz: float) -> Windows:
    """Compute speed, turn rate and signed velocities of a root, in windows of one second that begin at each frame.

    Parameters
    ----------
    positions : (F, 2) float64    (x, z) in metres
    headings : (F,) float64    radians, continuous
    rate_hz : float    frames per second

    Returns
    -------
    Windows    F - rate_hz windows, none for a clip of a second or less. Speed is the path's length per second,
        whatever its direction. Forward and strafe (positive to the left) are mean velocities relative to the facing
        direction half-way through each step.
    """
    span = round(WINDOW_S * rate_hz)
    steps = np.diff(positions, axis=0)
    facing = 0.5 * (headings[1:] + headings[:-1])
    sine, cosine = np.sin(facing), np.cos(facing)
    ahead = steps[:, 0] * sine + steps[:, 1] * cosine
    leftward = steps[:, 0] * cosine - steps[:, 1] * sine
    duration_s = span / rate_hz
    return Windows(
        speed_m_s=_sums(np.hypot(steps[:, 0], steps[:, 1]), span) / duration_s,
        turn_rate_rad_s=(headings[span:] - headings[: max(len(headings) - span, 0)]) / duration_s,
        forward_m_s=_sums(ahead, span) / duration_s,
        strafe_m_s=_sums(leftward, span) / duration_s,
    )


def measure_coverage(database: MatchingDatabase, options: EvaluationOptions) -> Coverage:
    """Measure the windows of all clips, and the seconds of data in each cell of the trial grid.

    Clips of walking in place, as on a treadmill, would count as standing still; these clips are left out.

    Parameters
    ----------
    database : MatchingDatabase    the clips
    options : EvaluationOptions    grid and minimum seconds per cell

    Returns
    -------
    Coverage    windows and seconds per cell
    """
    rate = database.options.rate_hz
    parts = [Windows(*np.empty((4, 0)))]
    owners = [np.empty(0, dtype=np.int32)]
    too_short: list[int] = []
    for index, clip in enumerate(database.clips):
        if clip.in_place:
            continue
        rows = slice(clip.start, clip.stop)
        windows = sliding_windows(database.root_positions[rows], database.root_headings[rows], rate)
        if not len(windows.speed_m_s):
            too_short.append(index)
            continue
        parts.append(windows)
        owners.append(np.full(len(windows.speed_m_s), index, dtype=np.int32))
    joined = Windows(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))
    return coverage_of(joined, np.concatenate(owners), tuple(too_short), options, window_s=1.0 / rate)


def coverage_of(
    windows: Windows,
    owners: NDArray[np.int32],
    too_short: tuple[int, ...],
    options: EvaluationOptions,
    *,
    window_s: float,
) -> Coverage:
    """Make the coverage map of given windows.

    Parameters
    ----------
    windows : Windows    W windows
    owners : (W,) int32    index of the clip of each window
    too_short : tuple of int    indices of clips without a window
    options : EvaluationOptions    grid and minimum seconds per cell
    window_s : float    seconds of data that each window adds to its cell

    Returns
    -------
    Coverage    windows and seconds per cell
    """
    speed_edges = cell_edges(options.speeds_m_s, SPEED_STEP_M_S)
    turn_edges = cell_edges(options.turn_rates_deg_s, TURN_RATE_STEP_DEG_S)
    turn_rates = np.degrees(windows.turn_rate_rad_s)
    seconds = window_s * cell_counts(windows.speed_m_s, speed_edges, turn_rates, turn_edges)
    deficit = cell_deficits(seconds, options.coverage_least_s, window_s)
    return Coverage(
        clip=owners,
        speed_m_s=windows.speed_m_s,
        turn_rate_rad_s=windows.turn_rate_rad_s,
        forward_m_s=windows.forward_m_s,
        strafe_m_s=windows.strafe_m_s,
        speed_edges_m_s=speed_edges,
        turn_rate_edges_deg_s=turn_edges,
        seconds=seconds,
        deficit_s=deficit,
        index=float(np.mean(deficit == 0.0)),
        symmetry=symmetry(windows.speed_m_s, turn_rates, speed_edges, turn_edges),
        too_short=too_short,
    )


def cell_deficits(seconds: Floats, least_s: float, window_s: float) -> Floats:
    """Compute the missing seconds of data in each cell.

    Parameters
    ----------
    seconds : (V, O) float64    seconds in each cell
    least_s : float    seconds wanted in each cell
    window_s : float    seconds of data that each window adds to its cell

    Returns
    -------
    (V, O) float64    seconds; a cell that lacks less than half of `window_s` lacks nothing
    """
    deficits = np.maximum(least_s - seconds, 0.0)
    # Data come in whole windows, so a deficit below half a window is a rounding error.
    return np.where(deficits < 0.5 * window_s, 0.0, deficits)


def cell_edges(values: Sequence[float], step: float) -> Floats:
    """Compute the edges of cells around the values of a grid.

    Inner edges lie half-way between neighbouring values; the outermost values are in the middle of their cells.

    Parameters
    ----------
    values : sequence of float    n increasing values
    step : float    width of the cell of a single value

    Returns
    -------
    (n + 1,) float64    in the unit of the values

    Raises
    ------
    MotionError    if there are no values
    """
    centres = np.unique(np.asarray(values, dtype=np.float64))
    if not len(centres):
        raise MotionError("a grid needs at least one speed and one turn rate", where="grid")
    if len(centres) == 1:
        return np.array([centres[0] - 0.5 * step, centres[0] + 0.5 * step])
    halves = 0.5 * np.diff(centres)
    return np.concatenate(([centres[0] - halves[0]], centres[:-1] + halves, [centres[-1] + halves[-1]]))


def symmetry(speeds: Floats, turn_rates_deg_s: Floats, speed_edges: Floats, turn_edges: Floats) -> float:
    """Compute how equally left and right turns are covered: 1 for equal coverage, 0 if only one side is covered.

    The value is 1 - ½ Σ|h(v, ω) - h(v, -ω)| / Σ h, summed over the cells, where h is the number of windows in the cell
    of speed v and turn rate ω; without data, it is 1.

    The cells are the cells of the map and, if the grid contains only one side, also their mirror images.

    Parameters
    ----------
    speeds : (W,) float64    metres per second
    turn_rates_deg_s : (W,) float64    degrees per second
    speed_edges, turn_edges : (V + 1,), (O + 1,) float64    edges of the cells, in the same units

    Returns
    -------
    float    0 to 1
    """
    sizes = np.asarray(np.unique(np.round(np.abs(turn_edges), EDGE_DECIMALS)), dtype=np.float64)
    bounds = sizes if turn_edges[0] > 0.0 or turn_edges[-1] < 0.0 else np.concatenate(([0.0], sizes[sizes > 0.0]))
    sides = [
        cell_counts(speeds[side], speed_edges, np.abs(turn_rates_deg_s[side]), bounds)
        for side in (turn_rates_deg_s > 0.0, turn_rates_deg_s < 0.0, turn_rates_deg_s == 0.0)
    ]
    left, right, straight = sides
    if 0.0 not in sizes and bounds[0] == 0.0:  # the cell around zero is its own mirror image
        straight[:, 0] += left[:, 0] + right[:, 0]
        left[:, 0] = right[:, 0] = 0.0
    total = float(np.sum(left) + np.sum(right) + np.sum(straight))
    return 1.0 - float(np.sum(np.abs(left - right))) / total if total > 0.0 else 1.0


@dataclass(frozen=True)
class Hole:
    """A cell of the trial grid that lacks data: its centre, its seconds of data, and the seconds that are missing."""

    speed_m_s: float
    turn_rate_deg_s: float
    seconds: float
    deficit_s: float


def _sums(values: Floats, span: int) -> Floats:
    """Return the sums of all runs of `span` consecutive values; empty if there are fewer values."""
    if len(values) < span:
        return np.empty(0)
    totals = np.concatenate(([0.0], np.cumsum(values)))
    return totals[span:] - totals[:-span]


def cell_counts(speeds: Floats, speed_edges: Floats, turn_rates: Floats, turn_edges: Floats) -> Floats:
    """Count the windows in each cell, half-open [lower, upper).

    Parameters
    ----------
    speeds, turn_rates : (W,) float64    speed and turn rate of each window
    speed_edges, turn_edges : (V + 1,), (O + 1,) float64    edges of the cells, in the same units

    Returns
    -------
    (V, O) float64    numbers of windows
    """
    v = np.searchsorted(speed_edges, speeds, side="right") - 1
    w = np.searchsorted(turn_edges, turn_rates, side="right") - 1
    shape = len(speed_edges) - 1, len(turn_edges) - 1
    inside = (v >= 0) & (v < shape[0]) & (w >= 0) & (w < shape[1])
    counts = np.bincount(v[inside] * shape[1] + w[inside], minlength=shape[0] * shape[1])
    return counts.reshape(shape).astype(np.float64)
