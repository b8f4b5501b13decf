"""Motion matching played along a wished trajectory."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from marey_motion.errors import MotionError
from marey_motion.matching.database import MatchingDatabase
from marey_motion.matching.options import ControllerOptions
from marey_motion.matching.record import TrialRecord
from marey_motion.matching.search import SearchIndex

Floats = NDArray[np.float64]


class Guide(Protocol):
    """A trajectory to follow, sampled at every tick: `marey_motion.evaluation.scenario.Reference` is one."""

    @property
    def rate_hz(self) -> float:
        """Ticks per second; the database's."""

    @property
    def tick_count(self) -> int:
        """T, ticks to play; the arrays have at least as many rows."""

    @property
    def positions(self) -> Floats:
        """(T + L, 2) metres on the ground."""

    @property
    def headings(self) -> Floats:
        """(T + L,) radians, continuous."""

    @property
    def speeds_m_s(self) -> Floats:
        """(T + L,)."""

    @property
    def turn_rates_rad_s(self) -> Floats:
        """(T + L,)."""


class Wish(NamedTuple):
    """A guide as compiled code takes it."""

    positions: Floats
    headings: Floats
    speeds: Floats
    turn_rates: Floats
    tick_s: float


class Rules(NamedTuple):
    """Options as compiled code takes them: durations in ticks."""

    follow: int
    by_pose: bool
    period: int
    window: int
    bias: float
    margin: float
    decay_per_s: float
    blends_root: bool
    holds: bool
    adjustment_per_s: float
    clamp_m: float
    tick_s: float


class Scales(NamedTuple):
    """What brings a wished trajectory onto the scale of the features."""

    offset: Floats
    scale: Floats
    horizons_s: Floats
    horizons_ticks: Floats


FOLLOW_CODES = {"time": 0, "path": 1, "open_loop": 2}


def run_trial(database: MatchingDatabase, index: SearchIndex, guide: Guide, options: ControllerOptions) -> TrialRecord:
    """Let motion matching follow a guide from its first tick on.

    `index` is that of the database's normalised features. Raises `MotionError` for options that make no sense, or a
    guide of another rate than the database's.
    """
    from marey_motion.matching import controller_kernels as kernels

    rules = rules_of(options, database.options.rate_hz)
    wish = wish_of(guide, database)
    record = _empty_record(guide)
    kernels.run(
        index, database.root_motion, database.pose_points, database.starts, wish, rules, scales_of(database), record
    )
    return TrialRecord(rate_hz=guide.rate_hz, **record._asdict())


class _Arrays(NamedTuple):
    rows: NDArray[np.int32]
    positions: Floats
    headings: Floats
    status: NDArray[np.int8]
    match_cost: Floats
    continuing_cost: Floats
    pose_cost: Floats


def _empty_record(guide: Guide) -> _Arrays:
    ticks = guide.tick_count
    return _Arrays(
        rows=np.empty(ticks, np.int32),
        positions=np.empty((ticks, 2)),
        headings=np.empty(ticks),
        status=np.empty(ticks, np.int8),
        match_cost=np.empty(ticks),
        continuing_cost=np.empty(ticks),
        pose_cost=np.zeros(ticks),
    )


def rules_of(options: ControllerOptions, rate_hz: float) -> Rules:
    """The options in ticks. Raises `MotionError` naming the one that makes no sense."""
    period = round(options.search_every_s * rate_hz)
    if period < 1:
        raise MotionError("the search period must be at least one tick", where="search_every_s")
    if not options.half_life_s > 0.0:
        raise MotionError("the half-life of a blend must be longer than 0 s", where="half_life_s")
    if options.switch_margin < 0.0:
        raise MotionError("a negative margin would switch to worse rows", where="switch_margin")
    if options.reselect_window_s < 0.0 or options.root_adjustment < 0.0:
        raise MotionError("must not be negative", where="reselect_window_s, root_adjustment")
    return Rules(
        follow=FOLLOW_CODES[options.follow],
        by_pose=options.selection == "pose_distance",
        period=period,
        window=round(options.reselect_window_s * rate_hz),
        bias=float(options.continuing_bias),
        margin=float(options.switch_margin),
        decay_per_s=2.0 * np.log(2.0) / options.half_life_s,
        blends_root=options.root_inertialisation,
        holds=options.root_adjustment > 0.0 or options.root_clamp_m is not None,
        adjustment_per_s=float(options.root_adjustment),
        clamp_m=np.inf if options.root_clamp_m is None else float(options.root_clamp_m),
        tick_s=1.0 / rate_hz,
    )


def wish_of(guide: Guide, database: MatchingDatabase) -> Wish:
    """The guide's arrays. Raises `MotionError` when its rate is not the database's."""
    if guide.rate_hz != database.options.rate_hz:
        raise MotionError(
            f"the trajectory has {guide.rate_hz:g} ticks per second, the database {database.options.rate_hz:g}"
        )
    arrays = (guide.positions, guide.headings, guide.speeds_m_s, guide.turn_rates_rad_s)
    positions, headings, speeds, turn_rates = (np.ascontiguousarray(array, dtype=np.float64) for array in arrays)
    return Wish(positions, headings, speeds, turn_rates, 1.0 / guide.rate_hz)


def scales_of(database: MatchingDatabase) -> Scales:
    """The database's normaliser and look-ahead."""
    horizons = np.array(database.options.horizons_s)
    ticks = np.round(horizons * database.options.rate_hz)
    return Scales(database.normaliser.offset, database.normaliser.scale, ticks / database.options.rate_hz, ticks)
