"""Coverage during a recording: the data recorded so far, the missing data, and paths to walk to fill the gaps.

A performance arrives as frames, in groups of any size. For a whole clip, the counted windows are the same as those of
`coverage.measure_coverage` at the same frame rate.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from marey_motion.arrays import Floats
from marey_motion.clip import Clip
from marey_motion.errors import MotionError
from marey_motion.evaluation.coverage import (
    SPEED_STEP_M_S,
    TURN_RATE_STEP_DEG_S,
    Hole,
    Windows,
    cell_counts,
    cell_deficits,
    cell_edges,
)
from marey_motion.evaluation.live_windows import LiveWindows
from marey_motion.evaluation.scenario import Reference, Trial, reference
from marey_motion.kinematics import SHORTEST_LATERAL_M, forward_vectors
from marey_motion.matching.body import MatchingBody
from marey_motion.motion import Motion
from marey_schemas.options.evaluation import COVERAGE_LEAST_S, MOST_CELLS, TARGET_PATH_S, Grid

FARTHEST_M = 1e6
"""Distance from the origin, in metres, beyond which positions are invalid or too inexact to compute speeds."""

PATH_RATE_HZ = 5.0
AWAY_DECIMALS = 1
"""Number of decimals to which distances between cells, in widths of a cell, are rounded before they are compared.

Of two equally distant cells, the cell that lacks more seconds comes first.
"""


@dataclass(frozen=True)
class PerformerState:
    """Position of the performer in the newest frame, and mean motion in the newest window.

    `window` is None until a window exists. The position is on the ground, in metres. The heading is in radians, 0 along
    +z and positive to the left; strafe is positive to the left.
    """

    x_m: float
    z_m: float
    heading_rad: float
    window: Windows | None


@dataclass(frozen=True, eq=False)
class Target:
    """A cell that lacks data, and a path to walk that fills the cell.

    `path` is in metres in the performer's frame: it starts at (0, 0) with heading 0, x to the left and z ahead.
    """

    hole: Hole
    path: Reference


class OnlineCoverage:
    """Seconds of data in each cell of a grid, updated during a performance.

    Parameters
    ----------
    rate_hz : frame rate of the performance, 10 to 240
    grid : the trial grid, with the same cells as in `coverage.measure_coverage`
    least_s : seconds wanted in each cell
    seconds : (V, O) seconds of data that exist already, for example an evaluation's `Coverage.seconds`

    Attributes
    ----------
    frame_count : frames received, over all takes
    counts : (V, O) int64    windows of this performance in each cell

    Raises
    ------
    MotionError    if the frame rate is out of range, the grid has too many cells, or `seconds` has another shape
    """

    def __init__(
        self,
        rate_hz: float,
        grid: Grid | None = None,
        *,
        least_s: float = COVERAGE_LEAST_S,
        seconds: Floats | None = None,
    ) -> None:
        self.grid, self.least_s = grid or Grid(), least_s
        self.speed_edges_m_s = cell_edges(self.grid.speeds_m_s, SPEED_STEP_M_S)
        self.turn_rate_edges_deg_s = cell_edges(self.grid.turn_rates_deg_s, TURN_RATE_STEP_DEG_S)
        shape = len(self.speed_edges_m_s) - 1, len(self.turn_rate_edges_deg_s) - 1
        if shape[0] * shape[1] > MOST_CELLS:
            raise MotionError(
                f"the grid has {shape[0]} x {shape[1]} cells; at most {MOST_CELLS} are allowed, so choose fewer "
                "speeds or turn rates",
                where="grid",
            )
        self._before = np.zeros(shape) if seconds is None else np.array(seconds, dtype=np.float64)
        if self._before.shape != shape:
            raise MotionError(
                f"the seconds per cell must have the shape {shape} of the grid, not {self._before.shape}",
                where="seconds",
            )
        self._live = LiveWindows(rate_hz)
        self.counts = np.zeros(shape, dtype=np.int64)
        self.frame_count = 0

    # -- frames --------------------------------------------------------------------------------------------------------

    def add_frames(self, body: MatchingBody, clip: Clip) -> Windows:
        """Add the next frames of the performance.

        A take begins with the first frame in which hips and shoulders define a facing direction.

        Parameters
        ----------
        body : MatchingBody    joints of the clip's skeleton
        clip : Clip    frames at `rate_hz`

        Returns
        -------
        Windows    the windows that these frames complete

        Raises
        ------
        MotionError    if a frame is too far from the origin; no frame is added
        """
        positions = Motion.of(clip).positions(body.skeleton)
        _require_near(positions)
        return self._add(positions[:, body.torso, ::2], forward_vectors(positions, body.lefts, body.rights))

    def add_roots(self, positions: Floats, headings: Floats) -> Windows:
        """Add the next frames, given as unsmoothed positions of the torso and headings of the body.

        Parameters
        ----------
        positions : (n, 2) float64    (x, z) in metres
        headings : (n,) float64    radians

        Returns
        -------
        Windows    the windows that these frames complete

        Raises
        ------
        MotionError    if a shape or a value is invalid, or if a position is too far from the origin; no frame is added
        """
        if positions.shape != (len(headings), 2):
            raise MotionError(
                f"{len(headings)} headings need positions of the shape ({len(headings)}, 2), not {positions.shape}",
                where="roots",
            )
        if not np.all(np.isfinite(headings)):
            raise MotionError("a heading is infinite or not a number", where="roots")
        _require_near(positions)
        return self._add(positions, np.stack((np.sin(headings), np.cos(headings)), axis=-1))

    def end_take(self) -> Windows:
        """End the take, such as at a pause or after lost frames. No window spans the end of a take.

        Returns
        -------
        Windows    the windows of the take's last frames
        """
        return self._count(self._live.end_take())

    def _add(self, positions: Floats, facing: Floats) -> Windows:
        newest = self._live.newest_frame
        directions = _directions(facing, None if newest is None else newest[2:])
        self.frame_count += len(positions)
        begun = positions[len(positions) - len(directions) :]
        return self._count(self._live.receive(np.hstack((begun, directions))))

    def _count(self, windows: Windows) -> Windows:
        counts = cell_counts(
            windows.speed_m_s, self.speed_edges_m_s, np.degrees(windows.turn_rate_rad_s), self.turn_rate_edges_deg_s
        )
        self.counts += counts.astype(np.int64)
        return windows

    # -- coverage ------------------------------------------------------------------------------------------------------

    @property
    def delay_s(self) -> float:
        """Delay of the newest window behind the newest frame, in seconds: half the width of the direction filter."""
        return self._live.delay_s

    @property
    def seconds(self) -> Floats:
        """Seconds of data in each cell of the grid, (V, O): V intervals of speed, O intervals of turn rate."""
        return self._before + self.counts / self._live.rate_hz

    @property
    def deficit_s(self) -> Floats:
        """Seconds that each cell lacks, (V, O)."""
        return cell_deficits(self.seconds, self.least_s, 1.0 / self._live.rate_hz)

    @property
    def index(self) -> float:
        """Share of the cells with enough data."""
        return float(np.mean(self.deficit_s == 0.0))

    @property
    def performer(self) -> PerformerState | None:
        """Position and motion of the performer; None outside a take."""
        newest = self._live.newest_frame
        if newest is None:
            return None
        x, z, facing_x, facing_z = newest.tolist()
        return PerformerState(x, z, float(np.arctan2(facing_x, facing_z)), self._live.newest_window)

    def targets(self, count: int, *, path_s: float = TARGET_PATH_S) -> tuple[Target, ...]:
        """List cells that lack data, the cell nearest to the performer's current speed and turn rate first.

        Distances are counted in cells. Before the first window of a take, they are measured from standing still.

        Parameters
        ----------
        count : int    largest number of cells
        path_s : float    duration of each path, seconds

        Returns
        -------
        tuple of Target    the cells, each with a path at the speed and turn rate of the cell
        """
        seconds, deficits = self.seconds, self.deficit_s
        speeds, turn_rates = np.unique(self.grid.speeds_m_s), np.unique(self.grid.turn_rates_deg_s)
        window = self._live.newest_window
        speed, turn_rate = (0.0, 0.0) if window is None else (window.speed_m_s, np.degrees(window.turn_rate_rad_s))
        away = np.hypot(
            ((speeds - speed) / np.median(np.diff(self.speed_edges_m_s)))[:, None],
            (turn_rates - turn_rate) / np.median(np.diff(self.turn_rate_edges_deg_s)),
        )
        v, w = np.nonzero(deficits > 0.0)
        nearest = np.lexsort((w, v, -deficits[v, w], np.round(away[v, w], AWAY_DECIMALS)))[:count]
        return tuple(
            _target(Hole(float(speeds[a]), float(turn_rates[b]), float(seconds[a, b]), float(deficits[a, b])), path_s)
            for a, b in zip(v[nearest], w[nearest], strict=True)
        )

    # -- state ---------------------------------------------------------------------------------------------------------

    def as_tree(self) -> dict[str, Any]:
        """Save the state for `from_tree`.

        Returns
        -------
        dict    plain values and arrays, less than 64 kB
        """
        return {
            "speeds_m_s": list(self.grid.speeds_m_s),
            "turn_rates_deg_s": list(self.grid.turn_rates_deg_s),
            "least_s": self.least_s,
            "before_s": self._before.copy(),
            "counts": self.counts.astype(np.int32),
            "frame_count": self.frame_count,
            "live": self._live.as_tree(),
        }

    @classmethod
    def from_tree(cls, tree: Mapping[str, Any]) -> OnlineCoverage:
        """Restore exactly the state that `as_tree` saved, to the last bit.

        Parameters
        ----------
        tree : mapping    plain values and arrays

        Returns
        -------
        OnlineCoverage    coverage that continues with the next frame
        """
        grid = Grid(speeds_m_s=tree["speeds_m_s"], turn_rates_deg_s=tree["turn_rates_deg_s"])
        online = cls(tree["live"]["rate_hz"], grid, least_s=tree["least_s"], seconds=tree["before_s"])
        online._live = LiveWindows.from_tree(tree["live"])
        online.counts[...] = tree["counts"]
        online.frame_count = tree["frame_count"]
        return online


def _require_near(positions: Floats) -> None:
    if not float(np.max(np.abs(positions), initial=0.0)) <= FARTHEST_M:
        raise MotionError(
            f"a position is not a number, or it is more than {FARTHEST_M:g} m from the origin", where="positions"
        )


def _directions(facing: Floats, before: Floats | None) -> Floats:
    """Normalise facing directions (n, 2); where the vector is too short, the direction of the frame before is used.

    `before` (2,) is the direction of the frame before the first. If it is None, leading frames without a direction are
    left out, so that only the last m directions (m, 2) are returned.
    """
    length = np.hypot(facing[:, 0], facing[:, 1])
    known = length >= SHORTEST_LATERAL_M
    directions: Floats = facing / np.where(known, length, 1.0)[:, None]
    if before is not None:
        known, directions = np.concatenate(([True], known)), np.vstack((before, directions))
    last_known = np.maximum.accumulate(np.where(known, np.arange(len(known)), -1))
    directions = directions[last_known[last_known >= 0]]
    return directions if before is None else directions[1:]


def _target(hole: Hole, path_s: float) -> Target:
    circle = Trial("circle", hole.speed_m_s, float(np.radians(hole.turn_rate_deg_s)), 0.0, path_s)
    return Target(hole, reference(circle, PATH_RATE_HZ, look_ahead_s=1.0 / PATH_RATE_HZ))
