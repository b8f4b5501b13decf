"""Metrics of a suite, pooled from the metrics of its trials and their replicates."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from marey_motion.arrays import Floats
from marey_motion.errors import MotionError
from marey_motion.evaluation.judgement import judge_trial
from marey_motion.evaluation.metrics import offset_asymmetry, pooled_metrics
from marey_motion.evaluation.replicates import MeasuredReplicates
from marey_motion.evaluation.result import Metrics, ReplicateValues, TrialResult
from marey_schemas.options.evaluation import EvaluationOptions

TREADING_SHARE = "treading_share"


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
