"""Comparison of evaluations of the same trials: changes with their confidence intervals.

Trials differ by design and not by chance, so they are not a random sample; replicates differ by chance. Therefore, each
replicate gives one change, the mean over the trials, and the confidence interval is computed from these changes by
Student's t. An interval is not enough for a verdict: of many metrics, one in twenty would seem to change by chance
alone. So the probabilities of the changes are corrected by Holm's method within each family of metrics. The probability
that a family contains any false verdict is then at most 1 - `CONFIDENCE`.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from marey_motion.arrays import Floats
from marey_motion.errors import MotionError
from marey_motion.evaluation.perceived import require_same_metric
from marey_motion.evaluation.provenance import differing_options, require_comparable
from marey_motion.evaluation.result import EvaluationResult
from marey_motion.matching.record import TrialRecord
from marey_schemas.documents.evaluations import CONFIDENCE
from marey_schemas.documents.replicates import LEAST_REPLICATES, mean_interval

SAME_CHANGE = 1e-12
"""Relative difference up to which two values count as equal, because rounding can cause a difference of this size."""

OBJECTIVE = "objective"
"""Name under which the change of an objective (`improvement.objective`), in metres, is reported as `MetricChange`."""

LESS_IS_BETTER = (
    OBJECTIVE,
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
    "pose_error_mean",
    "pose_error_p95",
    "pose_error_nearest",
)
"""Metrics for which a lower value is better.

They form one family in Holm's correction; all other metrics form the second family.
"""


@dataclass(frozen=True)
class MetricChange:
    """Change of one metric, as a mean over trials and replicates.

    Parameters
    ----------
    before, after : means over the trials in which the metric is defined in both evaluations, in the unit of the metric
    change : mean of after - before over these trials
    low, high : bounds of the mean change at `CONFIDENCE`, over the replicates; None if there are too few replicates
    trials : number of trials in which the metric is defined in both evaluations
    replicates : number of replicates with a change
    p : probability of a mean change of this size or more by chance, corrected for the other metrics of its family; None
        if there are too few replicates, or if nothing changed
    """

    metric: str
    before: float
    after: float
    change: float
    low: float | None
    high: float | None
    trials: int
    replicates: int = 1
    p: float | None = None

    @property
    def verdict(self) -> str:
        """Verdict: same, better, worse, changed or unclear.

        "changed" is used if neither lower nor higher values of the metric are better; "unclear" means that chance can
        explain the change, or that there are too few replicates to know.
        """
        if self.low == self.high == 0.0:
            return "same"
        if self.p is None or self.p > 1.0 - CONFIDENCE:
            return "unclear"
        if self.metric not in LESS_IS_BETTER:
            return "changed"
        return "better" if self.change < 0.0 else "worse"


@dataclass(frozen=True)
class TrialChange:
    """A trial whose simulation differs between two evaluations.

    `first_tick` is the first tick that differs; for this, the first replicates are compared tick by tick. The offsets
    before and after are the mean distances from the desired positions in the two evaluations, in metres, over all
    replicates. `same_motion` is true if only the names of displayed clips differ and all numbers are equal.
    """

    trial: str
    first_tick: int
    offset_mean_before: float | None
    offset_mean_after: float | None
    same_motion: bool = False


@dataclass(frozen=True, eq=False)
class Comparison:
    """Differences between two evaluations, of two sets of clips, that ran the same trials.

    Parameters
    ----------
    metrics : changes of the metrics that exist in both evaluations, in alphabetical order
    changed : the trials whose simulations differ, in the order of the suite
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


def compare_several(before: EvaluationResult, others: Sequence[EvaluationResult]) -> tuple[Comparison, ...]:
    """Compare each of several evaluations with the first one, under the same normaliser, options and scenarios.

    Parameters
    ----------
    before : EvaluationResult    the evaluation with which the others are compared
    others : sequence of EvaluationResult    at least one; all with their records

    Returns
    -------
    tuple of Comparison    one for each of `others`; probabilities are corrected for all metrics of all comparisons

    Raises
    ------
    MotionError    if the conditions differ (the error names them), or if an evaluation was read without its records
    """
    found = [_compared(before, after) for after in others]
    changes = iter(corrected([change for one in found for change in one.metrics]))
    return tuple(replace(one, metrics=tuple(next(changes) for _ in one.metrics)) for one in found)


def require_same_conditions(before: EvaluationResult, after: EvaluationResult) -> None:
    """Check that two evaluations can be compared.

    Parameters
    ----------
    before, after : EvaluationResult    the evaluations

    Raises
    ------
    MotionError    if normaliser, options, scenarios, limits or perceptual metric differ; the error names them
    """
    require_comparable(before.provenance, after.provenance, differing_options(before.options, after.options))
    require_same_metric(before.perceived, after.perceived)


def _compared(before: EvaluationResult, after: EvaluationResult) -> Comparison:
    """Compare two evaluations; probabilities are not corrected."""
    require_same_conditions(before, after)
    if not (len(before.records) == len(before.trials) == len(after.trials) == len(after.records)):
        raise MotionError(
            "an evaluation lacks the records of its trials; read both evaluations with their records, or make them "
            "again",
            code="records-missing",
        )
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


def _metric_changes(before: EvaluationResult, after: EvaluationResult) -> tuple[MetricChange, ...]:
    """Compute the changes of all metrics that both evaluations define in one trial at least, in alphabetical order."""
    pairs = {metric: (_values(before, metric), _values(after, metric)) for metric in _names(before) & _names(after)}
    known = {
        metric: pair for metric, pair in sorted(pairs.items()) if np.any(np.isfinite(pair[0]) & np.isfinite(pair[1]))
    }
    return tuple(paired_change(metric, *pair) for metric, pair in known.items())


def paired_change(metric: str, before: Floats, after: Floats) -> MetricChange:
    """Compute the change of one metric over replicates paired by index, with its interval.

    Parameters
    ----------
    metric : str    name of the metric
    before, after : (T, R) float64    value of each trial in each replicate, in the metric's unit; NaN where the metric
        is not defined. At least one value is defined in both

    Returns
    -------
    MetricChange    mean change, its bounds, and the probability of such a change by chance, which is not yet corrected
        for the number of metrics
    """
    both = np.isfinite(before) & np.isfinite(after)
    defined = both.any(axis=0)
    first, second = (np.mean(side[:, defined], axis=0, where=both[:, defined]) for side in (before, after))
    change = np.mean(_differences(before, after)[:, defined], axis=0, where=both[:, defined])
    count, low, high, p = len(change), None, None, None
    least, most = float(change.min()), float(change.max())
    if least == most == 0.0:
        low = high = 0.0
    elif count >= LEAST_REPLICATES:
        _, _, low, high = mean_interval(change.tolist())
        p = probability(change)
    trials = int(np.count_nonzero(both.any(axis=1)))
    return MetricChange(
        metric, float(first.mean()), float(second.mean()), float(change.mean()), low, high, trials, count, p
    )


def _differences(before: Floats, after: Floats) -> Floats:
    """Subtract `before` from `after`; a difference that rounding can explain becomes 0.

    If clips have other names, sums over the clips have another order and are rounded differently. Such differences are
    not random over the replicates, so a test over the replicates would call some of them significant.
    """
    differences = after - before
    return np.where(np.abs(differences) <= SAME_CHANGE * np.maximum(np.abs(before), np.abs(after)), 0.0, differences)


def probability(changes: Floats) -> float:
    """Compute the probability that chance alone moves the mean of the changes this far from 0, or farther.

    Parameters
    ----------
    changes : (R,) float64    one change per replicate, not all 0

    Returns
    -------
    float    two-sided probability, 0 to 1, by Student's t or, if all changes are equal (as in counts), by the sign test
    """
    from scipy.special import stdtr

    least, most = float(changes.min()), float(changes.max())
    if most - least <= SAME_CHANGE * max(abs(least), abs(most)):
        return float(2.0 ** (1 - len(changes)))
    spread = float(np.std(changes, ddof=1)) / np.sqrt(len(changes))
    return float(2.0 * stdtr(len(changes) - 1, -abs(float(np.mean(changes))) / spread))


def corrected(changes: Sequence[MetricChange]) -> tuple[MetricChange, ...]:
    """Correct the probabilities of changes for the number of metrics in their family, by Holm's method.

    Parameters
    ----------
    changes : sequence of MetricChange    with p-values that are not corrected for multiple comparisons

    Returns
    -------
    tuple of MetricChange    with corrected probabilities, in the same order
    """
    found = list(changes)
    for judged in (True, False):
        own = [place for place, one in enumerate(changes) if (one.metric in LESS_IS_BETTER) == judged]
        for place, one in zip(own, corrected_family([changes[place] for place in own]), strict=True):
            found[place] = one
    return tuple(found)


def corrected_family(changes: Sequence[MetricChange]) -> tuple[MetricChange, ...]:
    """Correct the probabilities of changes for the number of these changes, by Holm's method.

    Parameters
    ----------
    changes : sequence of MetricChange    with p-values that are not corrected for multiple comparisons

    Returns
    -------
    tuple of MetricChange    with corrected probabilities, in the same order
    """
    known = sorted((one.p, place) for place, one in enumerate(changes) if one.p is not None)
    raised: dict[int, float] = {}
    most = 0.0
    for rank, (p, place) in enumerate(known):
        most = max(most, min(1.0, (len(known) - rank) * p))
        raised[place] = most
    return tuple(replace(one, p=raised.get(place)) for place, one in enumerate(changes))


def _names(result: EvaluationResult) -> set[str]:
    if result.replicates is not None:
        return set(result.replicates.names)
    return {name for trial in result.trials for name in trial.metrics}


def _values(result: EvaluationResult, metric: str) -> Floats:
    """Return one metric of each trial in each replicate, (T, R); NaN where it is not defined."""
    if result.replicates is not None:
        return result.replicates.of_trials(metric)
    return np.array([[np.nan if (value := each.metrics.get(metric)) is None else value] for each in result.trials])


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
