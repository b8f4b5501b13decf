"""Motion matching along a desired trajectory."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from marey_motion.arrays import Floats
from marey_motion.errors import MotionError
from marey_motion.kinematics import as_kernel_input
from marey_motion.matching.database import MatchingDatabase
from marey_motion.matching.display import pose_costs
from marey_motion.matching.inertialisation import decay_matrix
from marey_motion.matching.record import TrialRecord
from marey_motion.matching.search import SearchIndex
from marey_schemas.options.matching import FOLLOW_MODES, ControllerOptions


class Trajectory(Protocol):
    """Interface of a trajectory that a character is to follow, sampled at every tick.

    For example, `marey_motion.evaluation.scenario.Reference` implements it.
    """

    @property
    def rate_hz(self) -> float:
        """Ticks per second, as in the database."""

    @property
    def tick_count(self) -> int:
        """Number T of ticks to simulate; the arrays have T + L rows, where L is any number of further ticks, or 0."""

    @property
    def positions(self) -> Floats:
        """Positions (T + L, 2) on the ground, in metres."""

    @property
    def headings(self) -> Floats:
        """Headings (T + L,) in radians, continuous."""

    @property
    def speeds_m_s(self) -> Floats:
        """Speeds (T + L,), in metres per second."""

    @property
    def turn_rates_rad_s(self) -> Floats:
        """Turn rates (T + L,), in radians per second."""


class TrajectoryArrays(NamedTuple):
    """A trajectory as arrays for compiled code, one row per tick; the fields are those of `Trajectory`.

    `tick_s` is the duration of a tick.
    """

    positions: Floats
    headings: Floats
    speeds: Floats
    turn_rates: Floats
    tick_s: float


class ControllerConstants(NamedTuple):
    """Options for compiled code: durations in ticks, and factors that apply once per tick.

    Parameters
    ----------
    follow : number that selects how the path is followed: by time, by position or in open loop (constants in
        `controller_kernels`)
    by_distance : whether poses are compared by the distances between their joints instead of by their features
    period : number of ticks from one search to the next
    window : number of rows on each side of the displayed row that a search may not choose
    bias, margin : `bias` is added to the cost of continuing the displayed clip, and `margin` is subtracted from it; the
        costs of other rows are compared with the result
    blends_root : whether the velocity of the root is blended at a switch
    decay : (2, 2) matrix that advances an offset of the root's velocity, and the offset's change per second, by one
        tick
    holds : whether the root is pulled towards the desired path
    pull, clamp_m : share of the distance from the path that each tick removes, and largest distance that may remain
    tick_s : duration of a tick
    """

    follow: int
    by_distance: bool
    period: int
    window: int
    bias: float
    margin: float
    blends_root: bool
    decay: Floats
    holds: bool
    pull: float
    clamp_m: float
    tick_s: float


class DatabaseArrays(NamedTuple):
    """Arrays of a database that a controller needs in addition to the search index.

    Parameters
    ----------
    successors : (N,) row that follows each row; -1 for the last row of a clip that does not wrap
    steps : (N, 3) step of the root to the next row: metres to the left and forward, and radians to the left
    starts : (C + 1,) first row of each clip, and N
    points : (N, P, 3) positions of the pose joints of each row, in metres, in the frame of the row's root
    offset, scale : (D,) normalised features are (features - offset) / scale
    horizons_s, horizons_ticks : (H,) times ahead at which the trajectory is compared, in seconds and in ticks
    """

    successors: NDArray[np.int64]
    steps: Floats
    starts: NDArray[np.int64]
    points: NDArray[np.float32]
    offset: Floats
    scale: Floats
    horizons_s: Floats
    horizons_ticks: Floats


class _Arrays(NamedTuple):
    rows: NDArray[np.int32]
    positions: Floats
    headings: Floats
    status: NDArray[np.int8]
    match_cost: Floats
    continuing_cost: Floats


def run_trial(
    database: MatchingDatabase,
    index: SearchIndex,
    guide: Trajectory,
    options: ControllerOptions,
    *,
    start_ticks: int = 0,
) -> TrialRecord:
    """Simulate a character that follows a trajectory by motion matching, from the first tick on.

    The same arguments give the same record, to the last bit.

    Parameters
    ----------
    database : MatchingDatabase    N rows
    index : SearchIndex    index of the database's normalised features
    guide : trajectory    T ticks at the database's rate; ground positions in metres, headings in radians
    options : ControllerOptions    options of the controller
    start_ticks : int    ticks by which the trial starts after the row that the first search finds, in the same clip;
        if the clip ends earlier, the trial starts just before its end

    Returns
    -------
    TrialRecord    T ticks

    Raises
    ------
    MotionError    if an option is invalid, if the index or the trajectory does not fit the database, or if the last row
        of a clip that does not wrap is selectable
    """
    from marey_motion.matching import controller_kernels as kernels

    trajectory, constants = trajectory_arrays(guide), controller_constants(options, guide.rate_hz)
    rows = database_arrays(database)
    if guide.rate_hz != database.options.rate_hz:
        raise MotionError(
            f"the trajectory has {guide.rate_hz:g} ticks per second, but the database has "
            f"{database.options.rate_hz:g}; both need the same rate"
        )
    if len(index.rows) != database.row_count:
        raise MotionError(
            f"the search index has {len(index.rows)} rows, but the database has "
            f"{database.row_count}; build the index from this database"
        )
    last = database.starts[1:] - 1
    ends = last[database.selectable[last] & (rows.successors[last] < 0)]
    if len(ends):
        raise MotionError(
            f"row {ends[0]} is the last of its clip, so playback cannot continue from it; mark the row as not "
            "selectable",
            where="selectable",
        )
    ticks = guide.tick_count
    played = _Arrays(
        rows=np.empty(ticks, np.int32),
        positions=np.empty((ticks, 2)),
        headings=np.empty(ticks),
        status=np.empty(ticks, np.int8),
        match_cost=np.empty(ticks),
        continuing_cost=np.empty(ticks),
    )
    kernels.run(index, rows, trajectory, constants, start_ticks, played)
    costs = pose_costs(database, played.rows, options)
    return TrialRecord(rate_hz=guide.rate_hz, pose_cost=costs, **played._asdict())


def controller_constants(options: ControllerOptions, rate_hz: float) -> ControllerConstants:
    """Convert options to constants per tick.

    Parameters
    ----------
    options : ControllerOptions    options of the controller
    rate_hz : float    ticks per second

    Returns
    -------
    named tuple    durations in ticks, and factors that apply once per tick

    Raises
    ------
    MotionError    if searches are less than a tick apart
    """
    period = round(options.search_every_s * rate_hz)
    if period < 1:
        raise MotionError("the period of searches must be at least one tick", where="search_every_s")
    return ControllerConstants(
        follow=FOLLOW_MODES.index(options.follow),
        by_distance=options.selection == "pose_distance",
        period=period,
        window=round(options.reselect_window_s * rate_hz),
        bias=float(options.continuing_bias),
        margin=float(options.switch_margin),
        blends_root=options.root_inertialisation,
        decay=decay_matrix(options.half_life_s, 1.0 / rate_hz),
        holds=options.root_adjustment > 0.0 or options.root_clamp_m is not None,
        pull=1.0 - float(np.exp(-options.root_adjustment / rate_hz)),
        clamp_m=np.inf if options.root_clamp_m is None else float(options.root_clamp_m),
        tick_s=1.0 / rate_hz,
    )


def trajectory_arrays(guide: Trajectory) -> TrajectoryArrays:
    """Collect the arrays of a trajectory.

    Parameters
    ----------
    guide : trajectory    T ticks

    Returns
    -------
    named tuple    arrays in float64, contiguous

    Raises
    ------
    MotionError    if the trajectory has no tick, or if an array has fewer than T rows
    """
    arrays = (guide.positions, guide.headings, guide.speeds_m_s, guide.turn_rates_rad_s)
    positions, headings, speeds, turn_rates = (np.ascontiguousarray(array, dtype=np.float64) for array in arrays)
    if not 1 <= guide.tick_count <= min(map(len, arrays)):
        raise MotionError(
            f"the trajectory has {guide.tick_count} ticks; it needs at least one tick, and at most "
            f"{min(map(len, arrays))} ticks, the length of its shortest array"
        )
    return TrajectoryArrays(positions, headings, speeds, turn_rates, 1.0 / guide.rate_hz)


def database_arrays(database: MatchingDatabase) -> DatabaseArrays:
    """Collect the arrays of a database.

    Parameters
    ----------
    database : MatchingDatabase    N rows

    Returns
    -------
    named tuple    arrays in the types that compiled code takes
    """
    rate_hz = database.options.rate_hz
    ticks = np.round(np.array(database.options.horizons_s) * rate_hz)
    return DatabaseArrays(
        successors=database.root_motion.successors,
        steps=database.root_motion.steps,
        starts=database.starts,
        points=as_kernel_input(database.pose_points),
        offset=database.normaliser.offset,
        scale=database.normaliser.scale,
        horizons_s=ticks / rate_hz,
        horizons_ticks=ticks,
    )
