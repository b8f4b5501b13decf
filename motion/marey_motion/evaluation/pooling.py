"""Metrics of a suite, pooled over its trials and over their replicates."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from marey_motion.arrays import Floats
from marey_motion.errors import MotionError
from marey_motion.evaluation.judgement import judge_trial
from marey_motion.evaluation.metrics import REGIMES, root_mean_square
from marey_motion.evaluation.replicates import MeasuredReplicates
from marey_motion.evaluation.result import Metrics, ReplicateValues, TrialResult
from marey_schemas.options.evaluation import EvaluationOptions

TREADING_SHARE = "treading_share"
SUMMED = ("transitions", "clip_ends", "response_missed")
"""Metrics that are counts; the suite's value is the sum over its trials."""


@dataclass(frozen=True, eq=False)
class PooledSuite:
    """Metrics of each trial and of the suite as means over the replicates, and the metrics of each replicate."""

    trials: tuple[TrialResult, ...]
    suite: Metrics
    replicates: ReplicateValues | None = None


def pool_suite(
    results: Sequence[TrialResult],
    treading: float | None,
    options: EvaluationOptions,
    further: MeasuredReplicates | None = None,
) -> PooledSuite:
    """Pool the metrics of a suite's trials over the trials and their replicates.

    Parameters
    ----------
    results : sequence of TrialResult    the first replicate of each trial, which is the trial itself
    treading : float or None    share of the chosen jumps of these trials that make the character tread on the spot
    options : EvaluationOptions    number of replicates, families and limits
    further : MeasuredReplicates, optional    the other replicates

    Returns
    -------
    PooledSuite    means over the replicates; if there is only one replicate, the metrics of the trials themselves

    Raises
    ------
    MotionError    if a replicate of a trial is missing
    """
    first = {**suite_metrics(results, options), TREADING_SHARE: treading}
    if options.replicates == 1:
        return PooledSuite(tuple(results), first)
    runs = {} if further is None else further.runs
    several = [runs.get(result.trial.name, ()) for result in results]
    if any(len(own) != options.replicates - 1 for own in several):
        raise MotionError(
            f"each trial needs {options.replicates - 1} further replicates; run those that are missing",
            code="replicates-missing",
        )
    suites: list[Metrics] = [first]
    for one in zip(*several, strict=True):
        jumps = sum(run.jumps for run in one)
        share = sum(run.treading for run in one) / jumps if jumps else None
        suites.append({**suite_metrics([run.outcome for run in one], options), TREADING_SHARE: share})
    outcomes = [(result, *(run.outcome for run in own)) for result, own in zip(results, several, strict=True)]
    values = _values(outcomes, suites, options)
    means = {name: _mean(own.tolist()) for name, own in values.suite.items()}
    return PooledSuite(tuple(map(_mean_result, outcomes)), means, values)


def suite_metrics(results: Sequence[TrialResult], options: EvaluationOptions) -> dict[str, float | None]:
    """Pool the metrics of trials over the whole suite and over each family of trials.

    Parameters
    ----------
    results : sequence of TrialResult    the trials
    options : EvaluationOptions    the families

    Returns
    -------
    dict of str to float or None    metrics by name
    """
    metrics = _pooled_with_asymmetry(results)
    for family in options.families:
        own = [result for result in results if result.trial.family == family]
        metrics |= {f"{family}.{name}": value for name, value in _pooled_with_asymmetry(own).items()}
    return metrics


def _pooled_with_asymmetry(results: Sequence[TrialResult]) -> dict[str, float | None]:
    return {**pooled_metrics(results), "offset_asymmetry": offset_asymmetry(results)}


def pooled_metrics(results: Sequence[TrialResult]) -> dict[str, float | None]:
    """Pool the metrics of several trials; metrics of a regime get the prefix `<regime>.`.

    A maximum is pooled as the largest value of all trials, a root mean square as the root mean square of the trials'
    values, and a count as the sum. Every other metric is pooled as the mean over the trials in which it is defined.
    `dse_…_pooled` is the root mean square of the standard deviations of the trials.

    Parameters
    ----------
    results : sequence of TrialResult    the trials

    Returns
    -------
    dict of str to float or None    metrics by name
    """
    pooled = _pooled([result.metrics for result in results])
    for regime in REGIMES:
        several = [result.regimes[regime] for result in results if regime in result.regimes]
        pooled |= {f"{regime}.{name}": value for name, value in _pooled(several).items()}
    return pooled


def _pooled(several: Sequence[Metrics]) -> dict[str, float | None]:
    names = dict.fromkeys(name for metrics in several for name in metrics)
    pooled: dict[str, float | None] = {}
    for name in names:
        values = np.array([value for metrics in several if (value := metrics.get(name)) is not None])
        pooled[name] = float(_pooling_measure(name)(values)) if len(values) else None
        if name in ("dse_v", "dse_omega_deg", "dse_omega_path_deg"):
            pooled[f"{name}_pooled"] = root_mean_square(values) if len(values) else None
    return pooled


def _pooling_measure(name: str) -> Callable[[Floats], np.float64 | float]:
    if name in SUMMED:
        return np.sum
    if name.endswith("_max"):
        return np.max
    return root_mean_square if name.endswith("_rms") else np.mean


def offset_asymmetry(results: Sequence[TrialResult]) -> float | None:
    """Compute the mean absolute difference of `offset_mean` between trials that differ only in turning left or right.

    Parameters
    ----------
    results : sequence of TrialResult    the trials

    Returns
    -------
    float or None    metres; None if there is no such pair of trials
    """
    offsets = {
        (result.trial.family, result.trial.speed_m_s, round(result.trial.turn_rate_rad_s, 9)): offset
        for result in results
        if (offset := result.metrics["offset_mean"]) is not None
    }
    differences = [
        abs(offset - offsets[family, speed, -turn_rate])
        for (family, speed, turn_rate), offset in offsets.items()
        if turn_rate > 0.0 and (family, speed, -turn_rate) in offsets
    ]
    return float(np.mean(differences)) if differences else None


def _values(
    outcomes: Sequence[Sequence[TrialResult]], suites: Sequence[Metrics], options: EvaluationOptions
) -> ReplicateValues:
    names = tuple(sorted({name for own in outcomes for result in own for name in result.metrics}))
    # Judged one by one, because a mean over replicates can keep a limit that half of them exceed.
    followed = [[judge_trial(result, options.limits).followed for result in own] for own in outcomes]
    return ReplicateValues(
        names=names,
        values=np.array([[_floats(map(result.metrics.get, names)) for result in own] for own in outcomes]),
        followed=np.array(followed),
        suite={name: _floats(own.get(name) for own in suites) for name in dict.fromkeys(n for s in suites for n in s)},
    )


def _floats(values: Iterable[float | None]) -> Floats:
    return np.array([np.nan if value is None else value for value in values])


def _mean_result(outcomes: Sequence[TrialResult]) -> TrialResult:
    regimes = dict.fromkeys(regime for each in outcomes for regime in each.regimes)
    return TrialResult(
        outcomes[0].trial,
        _means([each.metrics for each in outcomes]),
        {regime: _means([each.regimes[regime] for each in outcomes if regime in each.regimes]) for regime in regimes},
    )


def _means(several: Sequence[Metrics]) -> Mapping[str, float | None]:
    names = dict.fromkeys(name for metrics in several for name in metrics)
    return {name: _mean([metrics.get(name) for metrics in several]) for name in names}


def _mean(values: Sequence[float | None]) -> float | None:
    """Compute the mean of the values that are defined; None if there are none."""
    known = [value for value in values if value is not None and np.isfinite(value)]
    return float(np.mean(known)) if known else None
