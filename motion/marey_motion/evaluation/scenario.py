"""The trials of an evaluation and their trajectories.

A trial starts at the origin facing +z, goes straight for its approach and then turns at a constant rate. Its speed is
constant or switches between two values at fixed intervals. With switches, the path is a chain of tangent arcs.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from marey_motion.arrays import Floats
from marey_motion.errors import MotionError
from marey_schemas.documents.evaluations import trial_name
from marey_schemas.options.evaluation import EvaluationOptions, Family
from marey_schemas.options.matching import TICK_RATE_HZ

LOOK_AHEAD_S = 1.0
# A boundary belongs to the tick that it falls on, however its time in seconds is rounded.
TIME_TOLERANCE_S = 1e-9
STRAIGHT_DEG_S = 1e-6

_DEFAULTS = EvaluationOptions()


@dataclass(frozen=True)
class Trial:
    """One trajectory to follow: straight for `approach_s`, then a circle, or arcs with alternating speeds.

    Speeds are in m/s; `turn_rate_rad_s` is positive to the left. `switch_speed_m_s` and `switch_every_s` are used by
    the switching family only; its first period of constant speed begins at the end of the approach.
    """

    family: Family
    speed_m_s: float
    turn_rate_rad_s: float
    approach_s: float = _DEFAULTS.approach_s
    duration_s: float = _DEFAULTS.duration_s
    switch_speed_m_s: float = _DEFAULTS.switch_speed_m_s
    switch_every_s: float = _DEFAULTS.switch_every_s

    @property
    def name(self) -> str:
        """Stable name, unique within a suite."""
        return trial_name(self.family, self.speed_m_s, self.turn_rate_rad_s)


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
    speed = f"{trial.speed_m_s:g} m/s"
    if trial.family == "switching":
        speed = f"{trial.speed_m_s:g} m/s switching to {trial.switch_speed_m_s:g}"
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
    headings, speeds_m_s, turn_rates_rad_s : (T + L,) float64    headings in radians, continuous
    """

    rate_hz: float
    tick_count: int
    positions: NDArray[np.float64]
    headings: NDArray[np.float64]
    speeds_m_s: NDArray[np.float64]
    turn_rates_rad_s: NDArray[np.float64]


def suite_trials(options: EvaluationOptions) -> tuple[Trial, ...]:
    """List a trial for every family, speed and turn rate, in the order of the options.

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
            turn_rate_rad_s=float(np.radians(turn_rate)),
            approach_s=options.approach_s,
            duration_s=options.duration_s,
            switch_speed_m_s=options.switch_speed_m_s,
            switch_every_s=options.switch_every_s,
        )
        for family in options.families
        for speed in options.speeds_m_s
        for turn_rate in options.turn_rates_deg_s
    )
    require_names(trials)
    return trials


def require_names(trials: Iterable[Trial]) -> None:
    """Check that trials have different names, since records are stored by name.

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
                f"two trials are called {trial.name}; each trial needs a different name",
                where="grid",
            )
        seen.add(trial.name)


def reference(trial: Trial, rate_hz: float = TICK_RATE_HZ, look_ahead_s: float = LOOK_AHEAD_S) -> Reference:
    """Compute a trial's trajectory in closed form, sampled at t = tick / rate_hz.

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
    MotionError    if the trial has no ticks, or if the interval between its speed switches is not positive
    """
    tick_count = round((trial.approach_s + trial.duration_s) * rate_hz)
    if tick_count < 1 or trial.approach_s < 0.0 or trial.duration_s < 0.0:
        raise MotionError(
            f"a trial with an approach of {trial.approach_s:g} s and a duration of {trial.duration_s:g} s is "
            f"too short: it has no ticks at {rate_hz:g} Hz; make the approach or the duration longer",
            where=trial.name,
        )
    if trial.family == "switching" and not trial.switch_every_s > 0.0:
        raise MotionError("the interval between speed switches must be longer than 0 s", where=trial.name)
    times = np.arange(tick_count + int(np.ceil(look_ahead_s * rate_hz))) / rate_hz
    starts, speeds, turn_rates = _pieces(trial, float(times[-1]))
    origins, headings = _piece_origins(starts, speeds, turn_rates)
    piece = np.searchsorted(starts, times + TIME_TOLERANCE_S, side="right") - 1
    along, turned = _arc(speeds[piece], turn_rates[piece], headings[piece], times - starts[piece])
    return Reference(
        rate_hz=rate_hz,
        tick_count=tick_count,
        positions=origins[piece] + along,
        headings=turned,
        speeds_m_s=speeds[piece],
        turn_rates_rad_s=turn_rates[piece],
    )


def _pieces(trial: Trial, end_s: float) -> tuple[Floats, Floats, Floats]:
    """Compute start times, speeds and turn rates (P,) of the pieces of constant speed and turn rate up to `end_s`."""
    circles = 1
    if trial.family == "switching":
        circles += max(0, int((end_s - trial.approach_s) / trial.switch_every_s))
    starts = np.concatenate(([0.0], trial.approach_s + trial.switch_every_s * np.arange(circles)))
    speeds = np.full(len(starts), trial.speed_m_s)
    speeds[2::2] = trial.switch_speed_m_s
    turn_rates = np.full(len(starts), trial.turn_rate_rad_s)
    turn_rates[0] = 0.0
    return starts, speeds, turn_rates


def _piece_origins(starts: Floats, speeds: Floats, turn_rates: Floats) -> tuple[Floats, Floats]:
    """Compute positions (P, 2) and headings (P,) at the starts of the pieces; each piece continues the previous one."""
    durations = np.diff(starts)
    headings = np.concatenate(([0.0], np.cumsum(turn_rates[:-1] * durations)))
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
