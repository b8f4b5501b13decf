"""Metrics of a trial: accuracy, responsiveness and costs, over the whole trial and per regime.

Everything is measured on steps: step k leads from tick k - 1 to tick k. The speed of a step is the distance between its
two positions, divided by its duration. An error is a recorded value minus the reference value. The offset is the
distance between the recorded and the reference position at tick k. A regime is all time with the same desired motion:
the approach, the trial's base speed ("base"), or the speed it switches to ("switched").
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from marey_motion.arrays import Flags, Floats
from marey_motion.errors import MotionError
from marey_motion.evaluation.looks import LooksMeter
from marey_motion.evaluation.result import Metrics, TrialResult
from marey_motion.evaluation.scenario import LEAST_TRAVEL_M_S, TIME_TOLERANCE_S, Reference, Trial
from marey_motion.matching.record import Status, TrialRecord
from marey_schemas.options.evaluation import EvaluationOptions, Grid, settling_s

REGIMES = ("approach", "base", "switched")
RESPONSE_SHARE = 0.1
"""A desired speed counts as reached if the error stays below this share of that speed for `RESPONSE_HOLD_S` seconds.

At a stop, the limit is this share of the greatest desired speed in the trial.
"""
RESPONSE_HOLD_S = 0.5
"""Seconds for which the error must stay below `RESPONSE_SHARE` for the speed to count as reached."""


@dataclass(frozen=True, eq=False)
class TrialSeries:
    """Measurements of each step of a trial: S = T - 1 steps, arrays of shape (S,).

    Parameters
    ----------
    times_s : end of the step, from the start of the trial
    speeds_m_s, turn_rates_rad_s : recorded speed and turn rate of the facing direction
    travel_turn_rates_rad_s : turn rate of the direction of travel; NaN if the character hardly moves
    wanted_speeds_m_s, wanted_turn_rates_rad_s : speed and turn rate of the reference
    offsets_m : distance from the reference at the same tick
    cross_track_m, along_track_m : components of this offset, positive to the left and ahead in the reference's
        direction of travel
    heading_errors_rad : recorded minus desired heading at the same tick
    settled : whether the step is at least `settling_s` away from any change of the desired speed or direction
    changes_speed : whether the desired speed alternates, so that there are responses to measure
    varies : whether the desired speed and turn rate vary all the time, so that the spread of their errors is measured
    regimes : index of the step's regime in `REGIMES`
    pieces : index of the step's period of constant desired speed, -1 for the approach
    """

    rate_hz: float
    times_s: Floats
    speeds_m_s: Floats
    turn_rates_rad_s: Floats
    travel_turn_rates_rad_s: Floats
    wanted_speeds_m_s: Floats
    wanted_turn_rates_rad_s: Floats
    offsets_m: Floats
    cross_track_m: Floats
    along_track_m: Floats
    heading_errors_rad: Floats
    settled: Flags
    changes_speed: bool
    varies: bool
    regimes: NDArray[np.int8]
    pieces: NDArray[np.int64]


def trial_series(trial: Trial, reference: Reference, record: TrialRecord) -> TrialSeries:
    """Compute the recorded and the desired speed and turn rate of each step, and the offset from the reference.

    Parameters
    ----------
    trial : Trial    the trial
    reference : Reference    trajectory of the trial
    record : TrialRecord    T simulated ticks

    Returns
    -------
    TrialSeries    T - 1 steps

    Raises
    ------
    MotionError    if the record belongs to another trial
    """
    ticks, rate = len(record.rows), record.rate_hz
    if ticks != reference.tick_count or rate != reference.rate_hz:
        raise MotionError(
            f"the record of the trial has {ticks} ticks at {rate:g} Hz, but the reference trajectory has "
            f"{reference.tick_count} ticks at {reference.rate_hz:g} Hz; give the record and the reference of one trial",
            where=trial.name,
        )
    steps = np.diff(record.positions, axis=0)
    apart = record.positions[1:] - reference.positions[1:ticks]
    sine, cosine = np.sin(reference.directions[1:ticks]), np.cos(reference.directions[1:ticks])
    pieces = _pieces(trial, np.arange(ticks - 1) / rate)
    speeds = np.hypot(steps[:, 0], steps[:, 1]) * rate
    return TrialSeries(
        rate_hz=rate,
        times_s=np.arange(1, ticks) / rate,
        speeds_m_s=speeds,
        turn_rates_rad_s=np.diff(record.headings) * rate,
        travel_turn_rates_rad_s=_travel_turn_rates(steps, speeds, pieces, rate),
        wanted_speeds_m_s=reference.speeds_m_s[: ticks - 1],
        wanted_turn_rates_rad_s=reference.turn_rates_rad_s[: ticks - 1],
        offsets_m=np.hypot(apart[:, 0], apart[:, 1]),
        cross_track_m=apart[:, 0] * cosine - apart[:, 1] * sine,
        along_track_m=apart[:, 0] * sine + apart[:, 1] * cosine,
        heading_errors_rad=record.headings[1:] - reference.headings[1:ticks],
        settled=_settled(trial, np.arange(ticks - 1) / rate),
        changes_speed=trial.changes_speed,
        varies=bool(trial.path),
        regimes=np.where(pieces < 0, 0, 1 + pieces % 2 * (trial.family != "corners")).astype(np.int8),
        pieces=pieces,
    )


def measure_trial(
    trial: Trial,
    reference: Reference,
    record: TrialRecord,
    options: EvaluationOptions,
    looks: LooksMeter | None = None,
) -> TrialResult:
    """Compute every metric of one trial (docs/explanation/evaluation.md), also per regime if there are several.

    A regime is all time with the same desired motion: the approach, the base speed, or the speed after switches.

    Parameters
    ----------
    trial : Trial    the trial
    reference : Reference    trajectory of the trial
    record : TrialRecord    T simulated ticks
    options : EvaluationOptions    options of the evaluation
    looks : LooksMeter, optional    measurement of feet and smoothness over the database of the record; if None, these
        metrics are left out

    Returns
    -------
    TrialResult    metrics by name

    Raises
    ------
    MotionError    if record and reference belong to different trials
    """
    series = trial_series(trial, reference, record)
    window = np.full(len(series.times_s), True) if options.window == "all" else series.pieces >= 0
    metrics = _metrics(series, record, window)
    if looks is not None:
        metrics |= looks.measure(trial, record, window)
    if options.literal_formulas:
        metrics |= _literal_metrics(series, window, options)
    regimes = {}
    present = np.unique(series.regimes[window]).tolist()
    for regime in present if len(present) > 1 else ():
        regimes[REGIMES[regime]] = _metrics(series, record, window & (series.regimes == regime))
    return TrialResult(trial, metrics, regimes)


def _pieces(trial: Trial, times_s: Floats) -> NDArray[np.int64]:
    """Return, for each time, the index of its period of constant speed and turn rate; -1 during the approach."""
    on_circle = times_s + TIME_TOLERANCE_S - trial.approach_s
    if (every_s := trial.changes_every_s) is not None:
        return np.maximum(np.floor(on_circle / every_s), -1.0).astype(np.int64)
    return np.where(on_circle < 0.0, -1, 0).astype(np.int64)


def _settled(trial: Trial, times_s: Floats) -> Flags:
    """Mark the times that are at least `settling_s` away from any change of the desired motion."""
    if (every_s := trial.changes_every_s) is None:
        return np.full(len(times_s), True)
    margin_s = settling_s(every_s)
    since_s = np.mod(times_s + TIME_TOLERANCE_S - trial.approach_s, every_s)
    return (since_s >= margin_s) & (since_s < every_s - margin_s)


def _travel_turn_rates(steps: Floats, speeds: Floats, pieces: NDArray[np.int64], rate: float) -> Floats:
    """Compute the turn rate of the direction of travel between each step and the one before it.

    The rate is NaN if one of the two steps is too short, or if only one of them belongs to the approach.
    """
    turned = np.diff(np.arctan2(steps[:, 0], steps[:, 1]))
    turned -= 2.0 * np.pi * np.round(turned / (2.0 * np.pi))
    moving = speeds >= LEAST_TRAVEL_M_S
    known = moving[1:] & moving[:-1] & ((pieces[1:] < 0) == (pieces[:-1] < 0))
    return np.concatenate(([np.nan], np.where(known, turned * rate, np.nan)))[: len(steps)]


def _metrics(series: TrialSeries, record: TrialRecord, window: Flags) -> dict[str, float | None]:
    speeds = _speed_metrics(series, window)
    return {
        **speeds,
        **_offset_metrics(series, window),
        **_settled_metrics(series, window, speeds),
        **_response_metrics(series, window),
        **_switch_metrics(record, window),
        **_cost_metrics(record, window),
    }


def _speed_metrics(series: TrialSeries, window: Flags) -> dict[str, float | None]:
    metrics: dict[str, float | None] = {}
    degrees = 180.0 / np.pi
    for name, recorded, wanted, scale in (
        ("v", series.speeds_m_s, series.wanted_speeds_m_s, 1.0),
        ("omega_deg", series.turn_rates_rad_s, series.wanted_turn_rates_rad_s, degrees),
        ("omega_path_deg", series.travel_turn_rates_rad_s, series.wanted_turn_rates_rad_s, degrees),
    ):
        known = window & np.isfinite(recorded)
        bias = _of(np.mean, (recorded - wanted)[known])
        metrics[f"se_{name}"] = None if bias is None else scale * bias
        metrics[f"abs_se_{name}"] = None if bias is None else scale * abs(bias)
        spread = _pooled_spread((recorded - wanted if series.varies else recorded)[known], series.regimes[known])
        metrics[f"dse_{name}"] = None if spread is None else scale * spread
    return metrics


def _pooled_spread(values: Floats, regimes: NDArray[np.int8]) -> float | None:
    """Compute the standard deviation of values around the mean of their own regime; None if there are no values."""
    if not len(values):
        return None
    squares = 0.0
    for regime in np.unique(regimes):
        own = values[regimes == regime]
        squares += float(np.sum((own - np.mean(own)) ** 2))
    return float(np.sqrt(squares / len(values)))


def _offset_metrics(series: TrialSeries, window: Flags) -> dict[str, float | None]:
    offsets = series.offsets_m[window]
    total = _of(np.sum, offsets)
    metrics = {
        "offset_mean": _of(np.mean, offsets),
        "offset_rms": _of(root_mean_square, offsets),
        "offset_max": _of(np.max, offsets),
        "offset_final": float(offsets[-1]) if len(offsets) else None,
        "offset_sum": total,
        "offset_integral": None if total is None else total / series.rate_hz,
    }
    for name, values in (("cross_track", series.cross_track_m[window]), ("along_track", series.along_track_m[window])):
        metrics[f"{name}_mean"] = _of(np.mean, values)
        metrics[f"{name}_rms"] = _of(root_mean_square, values)
        metrics[f"{name}_max"] = _of(np.max, np.abs(values))
    return metrics


def _settled_metrics(series: TrialSeries, window: Flags, speeds: Metrics) -> dict[str, float | None]:
    """Compute error and spread of the speed in settled steps, and the root mean square of the heading error.

    Settled steps are not near a change of the desired motion. `speeds` are the metrics of the whole window; if the
    desired motion does not change, they are used for the settled steps, too. If its direction or turn rate changes, the
    heading and the spread of the turn rate in settled steps are added.
    """
    heading_deg = _degrees(_of(root_mean_square, series.heading_errors_rad[window]))
    if series.settled.all():
        return {"settled_se_v": speeds["se_v"], "settled_dse_v": speeds["dse_v"], "heading_rms_deg": heading_deg}
    settled = window & series.settled
    errors = (series.speeds_m_s - series.wanted_speeds_m_s)[settled]
    metrics = {
        "settled_se_v": _of(np.mean, errors),
        "settled_dse_v": _pooled_spread(series.speeds_m_s[settled], series.regimes[settled]),
        "heading_rms_deg": heading_deg,
    }
    if not series.changes_speed:
        metrics["settled_heading_rms_deg"] = _degrees(_of(root_mean_square, series.heading_errors_rad[settled]))
        spread = _pooled_spread(series.turn_rates_rad_s[settled], series.regimes[settled])
        metrics["settled_dse_omega_deg"] = _degrees(spread)
    return metrics


def _degrees(angle_rad: float | None) -> float | None:
    return None if angle_rad is None else float(np.degrees(angle_rad))


def _response_metrics(series: TrialSeries, window: Flags) -> dict[str, float | None]:
    """Compute mean and median response time to speed switches, and count switches without response.

    The mean is that of the switches with a response. In the median, switches without response count as longer than all
    others; it is None if half of the switches or more have no response.
    """
    times = [
        _response_s(series, first, stop)
        for first, stop in _stretches(series.pieces)
        if series.changes_speed and series.pieces[first] > 0 and window[first] and stop - first >= _hold_steps(series)
    ]
    answered = [time for time in times if time is not None]
    return {
        "response_s": float(np.mean(answered)) if answered else None,
        "response_median_s": _censored_median(answered, len(times)),
        "response_missed": float(len(times) - len(answered)),
    }


def _censored_median(answered: Sequence[float], count: int) -> float | None:
    """Compute the median of `count` times, of which only the `answered` ones are known and all others are longer.

    Returns None if there are no times, or if the median depends on an unknown time.
    """
    middle = sorted(answered)[(count - 1) // 2 : count // 2 + 1] if count else []
    return float(np.mean(middle)) if len(middle) == 1 + (count + 1) % 2 else None


def _stretches(pieces: NDArray[np.int64]) -> list[tuple[int, int]]:
    """Find the ranges [start, stop) of consecutive equal values."""
    bounds = [0, *(np.flatnonzero(np.diff(pieces)) + 1).tolist(), len(pieces)]
    return list(pairwise(bounds))


def _hold_steps(series: TrialSeries) -> int:
    return max(1, round(RESPONSE_HOLD_S * series.rate_hz))


def _response_s(series: TrialSeries, first: int, stop: int) -> float | None:
    """Compute the seconds from a speed switch, at step `first`, until the speed stays correct.

    Returns None if the next switch, at step `stop`, comes first.
    """
    wanted = series.wanted_speeds_m_s[first:stop]
    # The character has responded to a stop when its speed is below the share of the other speed.
    scale = np.where(wanted > 0.0, wanted, series.wanted_speeds_m_s.max())
    right = np.abs(series.speeds_m_s[first:stop] - wanted) < RESPONSE_SHARE * scale
    hold = _hold_steps(series)
    held = np.convolve(right, np.ones(hold), mode="valid") >= hold - 0.5
    return float(np.argmax(held)) / series.rate_hz if held.any() else None


def _switch_metrics(record: TrialRecord, window: Flags) -> dict[str, float | None]:
    """Count the transitions that searches chose; count separately the ends of clips, including restarts of loops.

    `window` marks the steps that count.
    """
    status = record.status[1:][window]
    transitions = float(np.count_nonzero(status == Status.REPLACING))
    return {
        "transitions": transitions,
        "transitions_per_s": transitions * record.rate_hz / len(status) if len(status) else None,
        "clip_ends": float(np.count_nonzero(status == Status.FORCED)),
    }


def _cost_metrics(record: TrialRecord, window: Flags) -> dict[str, float | None]:
    """Compute statistics of the costs that are recorded at the ticks of the window, except the last tick of the record.

    The costs recorded at tick i belong to the row that is displayed at tick i + 1.
    """
    entered = window & (record.status[1:] == Status.REPLACING)
    series = {
        "pose_cost": record.pose_cost[:-1][window],
        "switch_pose_cost": record.pose_cost[:-1][entered],
        "match_cost": record.match_cost[:-1][window],
        "continuing_cost": record.continuing_cost[:-1][window],
    }
    metrics: dict[str, float | None] = {}
    for name, costs in series.items():
        known = costs[np.isfinite(costs)]
        metrics[f"{name}_mean"] = _of(np.mean, known)
        metrics[f"{name}_p95"] = _of(_p95, known)
        metrics[f"{name}_max"] = _of(np.max, known)
    return metrics


def _literal_metrics(series: TrialSeries, window: Flags, grid: Grid) -> Metrics:
    """Compute equations 1 to 4 of Abichequer Sangalli et al. (2022) as printed.

    In these equations, a sum of m + 1 terms is divided by m, and the square of a sum is divided by a count.
    """
    metrics: dict[str, float | None] = {}
    for name, recorded, wanted, settings in (
        ("v", series.speeds_m_s, series.wanted_speeds_m_s, grid.speeds_m_s),
        (
            "omega_deg",
            np.degrees(series.turn_rates_rad_s),
            np.degrees(series.wanted_turn_rates_rad_s),
            grid.turn_rates_deg_s,
        ),
    ):
        values, asked = recorded[window], wanted[window]
        if len(values) < 2:
            metrics[f"se_{name}_literal"] = metrics[f"dse_{name}_literal"] = None
            continue
        static = float(np.sum(values)) / (len(values) - 1) - float(np.mean(asked))
        metrics[f"se_{name}_literal"] = static
        metrics[f"dse_{name}_literal"] = float(np.sqrt(np.sum((values - static + asked) ** 2) / len(settings)))
    return metrics


def _of(measure: Callable[[Floats], np.float64 | float], values: Floats) -> float | None:
    """Apply a measure to values; return None if there are no values."""
    return float(measure(values)) if len(values) else None


def root_mean_square(values: Floats) -> float:
    """Compute the root mean square of values.

    Parameters
    ----------
    values : (N,)    at least one value, in any unit

    Returns
    -------
    float    in the same unit
    """
    return float(np.sqrt(np.mean(values**2)))


def _p95(values: Floats) -> float:
    return float(np.percentile(values, 95.0))
