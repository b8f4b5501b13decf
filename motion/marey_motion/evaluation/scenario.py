"""The trials of an evaluation and their trajectories.

A trial starts at the origin facing +z, goes straight for its approach, and then follows the course of its family. A
course is a chain of arcs with constant speed and turn rate; corners and changes of speed are at fixed intervals. The
course of a trial along a take is the path of the take.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from marey_motion.arrays import Floats
from marey_motion.errors import MotionError
from marey_schemas.documents.evaluations import ANGLED_FAMILIES, trial_name
from marey_schemas.options.evaluation import EvaluationOptions, Family
from marey_schemas.options.matching import TICK_RATE_HZ

LOOK_AHEAD_S = 1.0
# Tolerance, so that rounding of times in seconds does not move a boundary to the next tick.
TIME_TOLERANCE_S = 1e-9
STRAIGHT_DEG_S = 1e-6
KEY_RATE_HZ = 10.0
"""Keys per second of the path of a take; roots are smoothed over half a second, so more keys would add no detail."""
LEAST_TRAVEL_M_S = 0.05
"""Speed, in metres per second, below which the direction of travel of a step is not defined."""

_DEFAULTS = EvaluationOptions()


@dataclass(frozen=True)
class Trial:
    """One trajectory to follow: straight for `approach_s`, then the course of its family.

    Speeds are in m/s; turn rates and angles are positive to the left. Families that change speed or direction do so
    every `switch_every_s` seconds; the first of these periods begins at the end of the approach. `switch_speed_m_s` is
    the second speed: 0 in `stopping` trials, ignored in families with one speed. `angle_rad` is the angle of the
    corners, or from the heading to the direction of travel.

    A trial along a take has three more members: `left_out` is the uid of the take, which the trial must not use;
    `label` is the name of the take; and `path` contains its keys, x and z in metres and heading in radians,
    `KEY_RATE_HZ` per second, from (0, 0, 0) on. The speed of such a trial is the mean speed of the path.
    """

    family: Family
    speed_m_s: float
    turn_rate_rad_s: float
    approach_s: float = _DEFAULTS.approach_s
    duration_s: float = _DEFAULTS.duration_s
    switch_speed_m_s: float = _DEFAULTS.switch_speed_m_s
    switch_every_s: float = _DEFAULTS.switch_every_s
    angle_rad: float = 0.0
    left_out: str = ""
    label: str = ""
    path: tuple[tuple[float, float, float], ...] = ()

    @property
    def name(self) -> str:
        """Stable name, unique within a suite."""
        return trial_name(self.family, self.speed_m_s, self.turn_rate_rad_s, self.angle_rad, self.label)

    @property
    def changes_speed(self) -> bool:
        """Whether the desired speed alternates between two values."""
        return self.family in ("switching", "stopping")

    @property
    def changes_every_s(self) -> float | None:
        """Seconds from one change of the desired speed, turn rate or direction to the next; None without changes."""
        if self.family == "eights":
            return 2.0 * np.pi / abs(self.turn_rate_rad_s)
        return self.switch_every_s if self.changes_speed or self.family == "corners" else None


def demand(trial: Trial) -> str:
    """Describe the desired motion of a trial in words.

    Parameters
    ----------
    trial : Trial    the trial

    Returns
    -------
    str    a phrase for people
    """
    turn = float(np.degrees(trial.turn_rate_rad_s))
    speed, angle = f"{trial.speed_m_s:g} m/s", f"{abs(float(np.degrees(trial.angle_rad))):.4g}"
    around = np.isclose(abs(trial.angle_rad), np.pi)
    side = f" to the {'left' if trial.angle_rad > 0.0 else 'right'}"
    if trial.family == "takes":
        return f"path of “{trial.label}”, which is left out"
    if trial.family == "corners":
        return f"path with corners of {angle} degrees{'' if around else side} at {speed}"
    if trial.family == "strafing":
        if around:
            return f"straight line backwards at {speed}"
        return f"straight line at {speed}, {angle} degrees{side} of the facing direction"
    if trial.family == "eights":
        return f"figure of eight at {abs(turn):.4g} deg/s and {speed}"
    if trial.changes_speed:
        stops = trial.family == "stopping"
        speed += " with stops" if stops else f" switching to {trial.switch_speed_m_s:g}"
    if abs(turn) <= STRAIGHT_DEG_S:
        return f"straight line at {speed}"
    return f"{'left' if turn > 0 else 'right'} turn of {abs(turn):.4g} deg/s at {speed}"


@dataclass(frozen=True, eq=False)
class Reference:
    """A trial's trajectory, sampled at every tick and at L ticks beyond the end of the trial.

    Parameters
    ----------
    tick_count : number T of ticks of the trial itself; the arrays have L more rows, for the look-ahead
    positions : (T + L, 2) float64    metres on the ground
    headings : (T + L,) float64    facing direction in radians; continuous, except at corners
    speeds_m_s : (T + L,) float64    speed of the step that follows each tick
    turn_rates_rad_s : (T + L,) float64    turn rate of this step; a corner is turned within one step
    directions : (T + L,) float64    direction of travel in radians; differs from the heading while strafing, and along
        takes
    """

    rate_hz: float
    tick_count: int
    positions: NDArray[np.float64]
    headings: NDArray[np.float64]
    speeds_m_s: NDArray[np.float64]
    turn_rates_rad_s: NDArray[np.float64]
    directions: NDArray[np.float64]


def suite_trials(options: EvaluationOptions) -> tuple[Trial, ...]:
    """List a trial for every family, speed, and turn rate or angle, in the order of the options.

    Parameters
    ----------
    options : EvaluationOptions    grid and families

    Returns
    -------
    tuple of Trial    the suite

    Raises
    ------
    MotionError    if two trials have the same name, for example because their speeds differ by less than a millionth
    """
    trials = tuple(
        Trial(
            family=family,
            speed_m_s=float(speed),
            turn_rate_rad_s=0.0 if family in ANGLED_FAMILIES else float(np.radians(course)),
            approach_s=options.approach_s,
            duration_s=options.duration_s,
            switch_speed_m_s=0.0 if family == "stopping" else options.switch_speed_m_s,
            switch_every_s=options.switch_every_s,
            angle_rad=float(np.radians(course)) if family in ANGLED_FAMILIES else 0.0,
        )
        for family in options.families
        for speed in options.speeds_m_s
        for course in options.courses_deg(family)
    )
    require_names(trials)
    return trials


def require_names(trials: Iterable[Trial]) -> None:
    """Check that trials have different names, since their results are stored by name.

    Parameters
    ----------
    trials : iterable of Trial    the trials

    Raises
    ------
    MotionError    if two trials have the same name
    """
    seen: set[str] = set()
    for trial in trials:
        if trial.name in seen:
            raise MotionError(
                f"two trials are called {trial.name}, because two values of the grid are equal or nearly equal; remove "
                "one of these values",
                where="grid",
            )
        seen.add(trial.name)


def reference(trial: Trial, rate_hz: float = TICK_RATE_HZ, look_ahead_s: float = LOOK_AHEAD_S) -> Reference:
    """Compute a trial's trajectory, sampled at the times tick / rate_hz.

    Parameters
    ----------
    trial : Trial    the trial
    rate_hz : float    ticks per second
    look_ahead_s : float    seconds beyond the end of the trial

    Returns
    -------
    Reference    positions in metres, headings in radians

    Raises
    ------
    MotionError    if a duration is negative, if the trial has no ticks, or if the time between changes is not positive
    """
    tick_count = round((trial.approach_s + trial.duration_s) * rate_hz)
    if trial.approach_s < 0.0 or trial.duration_s < 0.0:
        raise MotionError(
            f"the approach takes {trial.approach_s:g} s and the rest of the trial {trial.duration_s:g} s; "
            "neither may be negative",
            where=trial.name,
        )
    if tick_count < 1:
        raise MotionError(
            f"a trial with an approach of {trial.approach_s:g} s and a duration of {trial.duration_s:g} s is "
            f"too short: it has no ticks at {rate_hz:g} Hz; make the approach or the duration longer",
            where=trial.name,
        )
    if (every_s := trial.changes_every_s) is not None and not every_s > 0.0:
        raise MotionError("the time between changes of speed or direction must be above 0 s", where=trial.name)
    times = np.arange(tick_count + int(np.ceil(look_ahead_s * rate_hz))) / rate_hz
    if trial.path:
        return _along_keys(trial, times, rate_hz, tick_count)
    starts, speeds, turn_rates, corners = _pieces(trial, float(times[-1]))
    origins, directions = _piece_origins(starts, speeds, turn_rates, corners)
    piece = np.searchsorted(starts, times + TIME_TOLERANCE_S, side="right") - 1
    along, travelled = _arc(speeds[piece], turn_rates[piece], directions[piece], times - starts[piece])
    asked_rates, faced = turn_rates[piece], travelled
    if trial.family == "strafing":
        faced = np.zeros(len(times))
    elif trial.family == "corners":
        entered = np.flatnonzero(np.diff(piece))
        asked_rates[entered] += corners[piece[entered + 1]] * rate_hz
    return Reference(
        rate_hz=rate_hz,
        tick_count=tick_count,
        positions=origins[piece] + along,
        headings=faced,
        speeds_m_s=speeds[piece],
        turn_rates_rad_s=asked_rates,
        directions=travelled,
    )


def _along_keys(trial: Trial, times: Floats, rate_hz: float, tick_count: int) -> Reference:
    """Compute the trajectory of a trial along a take: a cubic spline through the keys `trial.path`.

    The approach is straight, with the velocity at the first key.
    """
    from scipy.interpolate import CubicSpline

    curve = CubicSpline(np.arange(len(trial.path)) / KEY_RATE_HZ, np.array(trial.path))
    # One more row, from which the last step is computed.
    since_s = np.append(times, times[-1] + 1.0 / rate_hz) - trial.approach_s
    found = curve(np.clip(since_s, 0.0, (len(trial.path) - 1) / KEY_RATE_HZ))
    positions, headings = found[:, :2] + np.minimum(since_s, 0.0)[:, None] * curve(0.0, 1)[:2], found[:, 2]
    steps = np.diff(positions, axis=0)
    speeds = np.hypot(steps[:, 0], steps[:, 1]) * rate_hz
    travelled = np.where(speeds >= LEAST_TRAVEL_M_S, np.arctan2(steps[:, 0], steps[:, 1]), headings[:-1])
    return Reference(
        rate_hz=rate_hz,
        tick_count=tick_count,
        positions=(positions - positions[0])[:-1],
        headings=headings[:-1],
        speeds_m_s=speeds,
        turn_rates_rad_s=np.diff(headings) * rate_hz,
        directions=np.unwrap(travelled),
    )


def _pieces(trial: Trial, end_s: float) -> tuple[Floats, Floats, Floats, Floats]:
    """Compute the pieces of constant speed and turn rate up to `end_s`.

    Returns their start times, speeds and turn rates, and the corner at the start of each piece in radians; (P,) each.
    """
    every_s, count = trial.changes_every_s, 1
    if every_s is not None:
        count += max(0, int((end_s - trial.approach_s) / every_s))
    starts = np.concatenate(([0.0], trial.approach_s + (every_s or 0.0) * np.arange(count)))
    # Documents write 2.0 as 2, so the members of a stored trial can be integers.
    speeds = np.full(len(starts), trial.speed_m_s, np.float64)
    turn_rates = np.full(len(starts), trial.turn_rate_rad_s, np.float64)
    turn_rates[0] = 0.0
    corners = np.zeros(len(starts))
    if trial.changes_speed:
        speeds[2::2] = trial.switch_speed_m_s
        # A standing character does not turn.
        turn_rates[2::2] *= trial.switch_speed_m_s > 0.0
    elif trial.family == "eights":
        turn_rates[2::2] *= -1.0
    elif trial.family == "corners":
        corners[2:] = trial.angle_rad
    elif trial.family == "strafing":
        corners[1] = trial.angle_rad
    return starts, speeds, turn_rates, corners


def _piece_origins(starts: Floats, speeds: Floats, turn_rates: Floats, corners: Floats) -> tuple[Floats, Floats]:
    """Compute positions (P, 2) and directions (P,) at the starts of the pieces; each continues the previous one."""
    durations = np.diff(starts)
    headings = np.concatenate(([0.0], np.cumsum(turn_rates[:-1] * durations))) + np.cumsum(corners)
    steps, _ = _arc(speeds[:-1], turn_rates[:-1], headings[:-1], durations)
    return np.concatenate((np.zeros((1, 2)), np.cumsum(steps, axis=0))), headings


def _arc(speed: Floats, turn_rate: Floats, heading: Floats, elapsed: Floats) -> tuple[Floats, Floats]:
    """Compute the displacement (..., 2) and heading after moving for `elapsed` seconds from `heading`.

    The chord of an arc with angle a is the arc's length times sin(a/2)/(a/2), in the direction half-way through the
    turn. This formula needs no special case for a turn rate of zero.
    """
    turn = turn_rate * elapsed
    chord = speed * elapsed * np.sinc(turn / (2.0 * np.pi))
    direction = heading + 0.5 * turn
    return np.stack((chord * np.sin(direction), chord * np.cos(direction)), axis=-1), heading + turn
