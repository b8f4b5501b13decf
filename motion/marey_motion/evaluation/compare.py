"""Comparison of two evaluations of the same trials: changes with their confidence intervals."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from marey_motion.arrays import Floats
from marey_motion.errors import MotionError
from marey_motion.evaluation.perceived import require_same_metric
from marey_motion.evaluation.provenance import require_comparable
from marey_motion.evaluation.result import EvaluationResult
from marey_motion.matching.record import TrialRecord
from marey_schemas.documents.evaluations import CONFIDENCE, RESAMPLES

BOOTSTRAP_SEED = 0
SAME_CHANGE = 1e-12
"""Relative difference up to which two changes count as equal, because rounding can cause a difference of this size."""

LESS_IS_BETTER = (
    "abs_se_v",
    "abs_se_omega_deg",
    "dse_v",
    "dse_omega_deg",
    "offset_mean",
    "offset_rms",
    "offset_max",
    "offset_final",
    "pose_cost_mean",
    "pose_cost_p95",
    "response_s",
    "response_median_s",
    "heading_rms_deg",
    "foot_skate",
    "foot_depth_p95",
    "treading_per_s",
)
"""Metrics for which a lower value is better; for all other metrics, only the change is reported."""


@dataclass(frozen=True)
class MetricChange:
    """Change of one metric, as a mean over trials.

    Parameters
    ----------
    before, after : means over the trials in which the metric is defined in both evaluations, in the unit of the metric
    change : mean of after - before over these trials
    low, high : bounds of the mean change at `CONFIDENCE`, by bootstrap over trials (bias corrected and accelerated)
    trials : number of these trials; with a single trial, `low` and `high` equal `change`
    """

    metric: str
    before: float
    after: float
    change: float
    low: float
    high: float
    trials: int

    @property
    def verdict(self) -> str:
        """Verdict: same, better, worse, changed or unclear.

        "changed" is used if neither lower nor higher values of the metric are better; "unclear" means that the
        interval contains 0, or that there is only one trial.
        """
        if self.low == self.high == 0.0:
            return "same"
        if self.low <= 0.0 <= self.high or self.trials < 2:
            return "unclear"
        if self.metric not in LESS_IS_BETTER:
            return "changed"
        return "better" if self.change < 0.0 else "worse"


@dataclass(frozen=True)
class TrialChange:
    """A trial whose records in two evaluations differ, with the first tick that differs and the mean offset in both.

    `same_motion` is true if only the names of displayed clips differ and all numbers are equal.
    """

    trial: str
    first_tick: int
    offset_mean_before: float | None
    offset_mean_after: float | None
    same_motion: bool = False


@dataclass(frozen=True, eq=False)
class Comparison:
    """Differences between the evaluations of two sets of clips by the same trials.

    Parameters
    ----------
    metrics : changes of the metrics that exist in both evaluations, in alphabetical order
    changed : the trials whose records differ, in the suite's order
    removed, added : uids of the clips that are only in the first set, or only in the second
    newly_unused : uids of clips that are in both sets, but were used only in the first evaluation
    coverage_change_s : (V, O) float64    seconds of data gained per cell of the coverage map
    """

    before: EvaluationResult
    after: EvaluationResult
    metrics: tuple[MetricChange, ...]
    changed: tuple[TrialChange, ...]
    removed: tuple[str, ...]
    added: tuple[str, ...]
    newly_unused: tuple[str, ...]
    coverage_change_s: NDArray[np.float64]


def compare_results(before: EvaluationResult, after: EvaluationResult) -> Comparison:
    """Compare two evaluations with the same normaliser, options and scenarios.

    Parameters
    ----------
    before, after : EvaluationResult    both with their records

    Returns
    -------
    Comparison    changes of metrics, trials and coverage

    Raises
    ------
    MotionError    if the conditions differ (the error names them), or if an evaluation was read without its records
    """
    require_comparable(before.provenance, after.provenance)
    require_same_metric(before.perceived, after.perceived)
    if not (len(before.records) == len(before.trials) == len(after.trials) == len(after.records)):
        raise MotionError("both evaluations must contain the records of all their trials", code="records-missing")
    uids = {clip.uid for clip in before.clips}, {clip.uid for clip in after.clips}
    used = _used(before), _used(after)
    return Comparison(
        before=before,
        after=after,
        metrics=_metric_changes(before, after),
        changed=_trial_changes(before, after),
        removed=tuple(sorted(uids[0] - uids[1])),
        added=tuple(sorted(uids[1] - uids[0])),
        newly_unused=tuple(sorted((used[0] - used[1]) & uids[1])),
        coverage_change_s=after.coverage.seconds - before.coverage.seconds,
    )


def paired_change(metric: str, before: Sequence[float] | Floats, after: Sequence[float] | Floats) -> MetricChange:
    """Compute the change of one metric over trials paired by index, with its bootstrap interval.

    Parameters
    ----------
    metric : str    name of the metric
    before, after : sequence of float    value of each trial, in the metric's unit

    Returns
    -------
    MetricChange    mean change and its bounds
    """
    first, second = np.asarray(before, dtype=np.float64), np.asarray(after, dtype=np.float64)
    change = second - first
    low, high = _interval(change)
    return MetricChange(metric, float(first.mean()), float(second.mean()), float(change.mean()), low, high, len(change))


def _interval(change: NDArray[np.float64]) -> tuple[float, float]:
    from scipy.stats import bootstrap

    least, most = float(change.min()), float(change.max())
    if most - least <= SAME_CHANGE * max(abs(least), abs(most)):  # nothing to resample; acceleration would be 0 / 0
        return least, most
    found = bootstrap(
        (change,),
        np.mean,
        confidence_level=CONFIDENCE,
        n_resamples=RESAMPLES,
        method="BCa",
        rng=np.random.Generator(np.random.PCG64(BOOTSTRAP_SEED)),
    ).confidence_interval
    return float(found.low), float(found.high)


def _metric_changes(before: EvaluationResult, after: EvaluationResult) -> tuple[MetricChange, ...]:
    changes = []
    for metric in sorted(_names(before) & _names(after)):
        pairs = [
            (first, second)
            for first, second in zip(_values(before, metric), _values(after, metric), strict=True)
            if first is not None and second is not None
        ]
        if pairs:
            changes.append(paired_change(metric, *zip(*pairs, strict=True)))
    return tuple(changes)


def _names(result: EvaluationResult) -> set[str]:
    return {name for trial in result.trials for name in trial.metrics}


def _values(result: EvaluationResult, metric: str) -> list[float | None]:
    return [trial.metrics.get(metric) for trial in result.trials]


def _trial_changes(before: EvaluationResult, after: EvaluationResult) -> tuple[TrialChange, ...]:
    places = _places((before, after))
    changes = []
    for index, trial in enumerate(before.trials):
        moved = _numbers_differ(before.records[index], after.records[index])
        differs = moved | np.any(places[0][index] != places[1][index], axis=1)
        if differs.any():
            metrics = trial.metrics, after.trials[index].metrics
            changes.append(
                TrialChange(
                    trial=trial.trial.name,
                    first_tick=int(np.argmax(differs)),
                    offset_mean_before=metrics[0].get("offset_mean"),
                    offset_mean_after=metrics[1].get("offset_mean"),
                    same_motion=not moved.any(),
                )
            )
    return tuple(changes)


def _places(results: Iterable[EvaluationResult]) -> list[list[NDArray[np.int64]]]:
    """List, for each result and each of its trials, the clip and frame (T, 2) displayed at each tick.

    Clips with the same uid have the same number in all results."""
    numbers: dict[str, int] = {}
    return [[_clip_frames(result, record, numbers) for record in result.records] for result in results]


def _clip_frames(result: EvaluationResult, record: TrialRecord, numbers: dict[str, int]) -> NDArray[np.int64]:
    starts = np.array([clip.start for clip in result.clips], dtype=np.int64)
    clips = np.searchsorted(starts, record.rows, side="right") - 1
    known = np.array([numbers.setdefault(clip.uid, len(numbers)) for clip in result.clips], dtype=np.int64)
    return np.stack((known[clips], record.rows - starts[clips]), axis=1)


def _numbers_differ(first: TrialRecord, second: TrialRecord) -> NDArray[np.bool_]:
    """Mark the ticks (T,) at which two records differ; row numbers are ignored, since they depend on the database."""
    differs: NDArray[np.bool_] = np.any(first.positions != second.positions, axis=1)
    for name in ("headings", "status", "match_cost", "continuing_cost", "pose_cost"):
        one, other = getattr(first, name), getattr(second, name)
        # A cost that is not defined is NaN on both sides.
        differs |= (one != other) & ~(np.isnan(one) & np.isnan(other))
    return differs


def _used(result: EvaluationResult) -> set[str]:
    return {result.clips[usage.clip].uid for usage in result.usage if usage.ticks > 0}
