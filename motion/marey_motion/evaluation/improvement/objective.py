"""The objective of an optimisation: one number that rates a set of clips; lower is better."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from marey_motion.arrays import Floats
from marey_motion.evaluation.metrics import trial_series
from marey_motion.evaluation.result import TrialResult
from marey_motion.evaluation.scenario import Reference, Trial
from marey_motion.matching.record import Status, TrialRecord
from marey_schemas.options.evaluation import EvaluationOptions
from marey_schemas.options.improvement import ObjectiveOptions

HEADLINES = ("offset_mean", "abs_se_v", "abs_se_omega_deg", "pose_cost_mean", "transitions_per_s")
"""Headline metrics: the metrics that are reported for a changed set of clips."""


def objective_value(weights: ObjectiveOptions, results: Sequence[TrialResult], seconds: float) -> float:
    """Compute the objective, in metres, of a set of clips of `seconds` seconds from its trials.

    Parameters
    ----------
    weights : ObjectiveOptions    weights of the terms
    results : sequence of TrialResult    the trials
    seconds : float    seconds of data

    Returns
    -------
    float    metres: sum of the mean offset, speed error, turn rate error, pose cost and seconds, each times its weight
    """
    means = headline_means(results)
    return sum(weight * means[name] for name, weight in metric_weights(weights).items()) + weights.seconds * seconds


def metric_weights(weights: ObjectiveOptions) -> dict[str, float]:
    """Return the weight of each headline metric that is part of the objective.

    Parameters
    ----------
    weights : ObjectiveOptions    weights of the terms

    Returns
    -------
    dict of str to float    metres per unit of the metric, by metric
    """
    return {
        "offset_mean": weights.offset,
        "abs_se_v": weights.abs_se_v,
        "abs_se_omega_deg": weights.abs_se_omega_deg,
        "pose_cost_mean": weights.pose_cost,
    }


def headline_means(results: Sequence[TrialResult]) -> dict[str, float]:
    """Compute the mean of each headline metric over the trials in which it is defined; 0 if there are no such trials.

    Parameters
    ----------
    results : sequence of TrialResult    the trials

    Returns
    -------
    dict of str to float    by metric, in its unit
    """
    means = {}
    for name in HEADLINES:
        values = [value for result in results if (value := result.metrics.get(name)) is not None]
        means[name] = float(np.mean(values)) if values else 0.0
    return means


def measure_headlines(
    trial: Trial, reference: Reference, record: TrialRecord, options: EvaluationOptions
) -> TrialResult:
    """Compute only the headline metrics of a trial, which is faster than computing all of them.

    Parameters
    ----------
    trial : Trial    the trial
    reference : Reference    trajectory of the trial
    record : TrialRecord    simulated ticks of the trial
    options : EvaluationOptions    options of the evaluation

    Returns
    -------
    TrialResult    the headline metrics of the whole trial; each equals the value of `metrics.measure_trial` bit for bit
    """
    series = trial_series(trial, reference, record)
    window = np.full(len(series.times_s), True) if options.window == "all" else series.pieces >= 0
    replacing = np.count_nonzero(record.status[1:][window] == Status.REPLACING)
    costs = record.pose_cost[:-1][window]
    steps = np.count_nonzero(window)
    speed_error = _mean((series.speeds_m_s - series.wanted_speeds_m_s)[window])
    turn_error = _mean((series.turn_rates_rad_s - series.wanted_turn_rates_rad_s)[window])
    metrics = {
        "offset_mean": _mean(series.offsets_m[window]),
        "abs_se_v": None if speed_error is None else abs(speed_error),
        "abs_se_omega_deg": None if turn_error is None else 180.0 / np.pi * abs(turn_error),
        "pose_cost_mean": _mean(costs[np.isfinite(costs)]),
        "transitions_per_s": float(replacing) * record.rate_hz / steps if steps else None,
    }
    return TrialResult(trial, metrics, {})


def _mean(values: Floats) -> float | None:
    return float(np.mean(values)) if len(values) else None
