"""Evaluations of one suite with different weights of the feature groups, to find out which groups matter."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import count

import numpy as np

from marey_motion.errors import MotionError
from marey_motion.evaluation.compare import OBJECTIVE, MetricChange, corrected_family, paired_change
from marey_motion.evaluation.improvement.effects import confirmation_replicates, estimation_replicates
from marey_motion.evaluation.improvement.objective import headline_means, objective_value
from marey_motion.evaluation.improvement.repeating import RepeatedChange, repeated
from marey_motion.evaluation.improvement.resimulation import Resimulation
from marey_motion.evaluation.pooling import pooled_metrics
from marey_motion.evaluation.result import Metrics
from marey_motion.evaluation.running import CancelCallback
from marey_motion.evaluation.scenario import Trial, suite_trials
from marey_motion.matching.database import MatchingDatabase
from marey_motion.matching.features import feature_layout
from marey_motion.matching.normaliser import UNMATCHED_SCALE
from marey_schemas.options.evaluation import EvaluationOptions
from marey_schemas.options.improvement import SweepOptions
from marey_schemas.options.matching import DatabaseOptions, FeatureWeights

ProgressCallback = Callable[[int, int, str], None]

GROUPS = tuple(FeatureWeights.model_fields)


@dataclass(frozen=True)
class SweepRow:
    """Result of one setting: weights, pooled metrics and headline metrics of the suite, and the objective in metres.

    `confirming` contains the objective in each of the replicates in which a choice of weights is confirmed; all other
    members belong to the replicates of the estimate.
    """

    weights: FeatureWeights
    metrics: Metrics
    headlines: dict[str, float]
    objective: float
    confirming: tuple[float, ...] = ()


@dataclass(frozen=True)
class Influence:
    """Influence of one feature group on the objective, over the settings that differ only in this group's weight.

    Parameters
    ----------
    spread : largest minus least objective, metres
    best_weight : weight with the least objective
    gain : decrease of the objective from the first setting to the best, metres; estimated in the replicates that are
        used to choose the best setting
    confirmed : change of the objective from the first setting to the best in other replicates, corrected for the number
        of groups; None if no setting is better than the first, or if there are no other replicates
    """

    group: str
    spread: float
    best_weight: float
    gain: float
    confirmed: MetricChange | None = None


def vary_each_group(options: DatabaseOptions, factors: Sequence[float]) -> tuple[FeatureWeights, ...]:
    """List the given weights, then variants: in each variant, the weight of one group is multiplied by one factor.

    Parameters
    ----------
    options : DatabaseOptions    weights to start from
    factors : sequence of float    factors

    Returns
    -------
    tuple of FeatureWeights    the settings
    """
    weights = options.weights
    groups = [group for group in GROUPS if group != "extra_joints" or options.extra_joints]
    return (
        weights,
        *(
            weights.model_copy(update={group: getattr(weights, group) * factor})
            for group in groups
            for factor in factors
        ),
    )


def sweep_weights(
    database: MatchingDatabase,
    options: EvaluationOptions,
    settings: Sequence[FeatureWeights],
    *,
    how: SweepOptions,
    trials: Sequence[Trial] | None = None,
    threads: int | None = None,
    progress: ProgressCallback | None = None,
    cancelled: CancelCallback | None = None,
) -> tuple[SweepRow, ...]:
    """Run the suite with each setting of the weights; the features and their standard deviations stay the same.

    Each setting also runs in the replicates of the confirmation, because the best settings are known only after all
    settings have run, and settings may be divided among several tasks. Progress counts runs of trials over all
    settings.

    Parameters
    ----------
    database : MatchingDatabase    the clips
    options : EvaluationOptions    options of the evaluation
    settings : sequence of FeatureWeights    weights to try
    how : SweepOptions    objective that rates each setting, and replicates
    trials : sequence of Trial, optional    trials to run; all trials of the suite if None
    threads : int, optional    threads to use, one per processor if None
    progress : callable, optional    called as progress(done, total, name)
    cancelled : callable, optional    returns True to stop

    Returns
    -------
    tuple of SweepRow    one per setting

    Raises
    ------
    MotionError    if a setting changes a weight that is 0 in the database
    EvaluationCancelled    if cancelled
    """
    wanted = suite_trials(options) if trials is None else tuple(trials)
    parts = [(estimation_replicates(how), options.seed)]
    if how.confirmation_replicates:
        parts.append((confirmation_replicates(how, options), how.confirmation_seed))
    runs = len(settings) * len(wanted) * sum(len(numbers) for numbers, _ in parts)
    ended, report = count(1), progress or (lambda _done, _total, _note: None)
    rows = []
    for weights in settings:
        weighted = reweighted(database, weights)
        estimating, *confirming = (
            Resimulation(
                weighted,
                options,
                trials=wanted,
                replicates=numbers,
                seed=seed,
                threads=threads,
                progress=lambda _done, _total, note: report(next(ended), runs, note),
                cancelled=cancelled,
            ).by_replicate()
            for numbers, seed in parts
        )
        results = [one for replicate in estimating for one in replicate]
        # The price of data is the same for all settings, and left out.
        value = objective_value(how.objective, results, 0.0)
        again = tuple(objective_value(how.objective, one, 0.0) for part in confirming for one in part)
        rows.append(SweepRow(weights, pooled_metrics(results), headline_means(results), value, again))
    return tuple(rows)


def reweighted(database: MatchingDatabase, weights: FeatureWeights) -> MatchingDatabase:
    """Return a copy of a database in which the groups of features have other weights.

    Parameters
    ----------
    database : MatchingDatabase    the clips
    weights : FeatureWeights    the new weights

    Returns
    -------
    MatchingDatabase    with the same rows, scaled by the new weights

    Raises
    ------
    MotionError    if the weight of a group changes from 0, because its scale is then unknown
    """
    options = database.options.model_copy(update={"weights": weights})
    scale = database.normaliser.scale.copy()
    pairs = zip(database.layout.groups, feature_layout(options, database.body).groups, strict=True)
    for before, after in pairs:
        if before.weight == after.weight:
            continue
        if before.weight == 0.0:
            raise MotionError(
                "this weight cannot be varied, because it is 0 in the database; start from a "
                "database in which it is above 0",
                where=before.name,
            )
        own = slice(before.start, before.stop)
        scale[own] = scale[own] * (before.weight / after.weight) if after.weight > 0.0 else UNMATCHED_SCALE
    return replace(database, options=options, normaliser=replace(database.normaliser, scale=scale))


def group_influences(rows: Sequence[SweepRow]) -> tuple[Influence, ...]:
    """Compute the influence of each group that was varied alone, the most influential first.

    Parameters
    ----------
    rows : sequence of SweepRow    results of a sweep, the unchanged weights first

    Returns
    -------
    tuple of Influence    one per group
    """
    base = rows[0].weights.model_dump()
    found = []
    for group in GROUPS:
        own = [row for row in rows if {**row.weights.model_dump(), group: base[group]} == base]
        values = np.array([row.objective for row in own])
        if len({getattr(row.weights, group) for row in own}) > 1:
            best = own[int(np.argmin(values))]
            found.append(
                Influence(
                    group=group,
                    spread=float(values.max() - values.min()),
                    best_weight=getattr(best.weights, group),
                    gain=rows[0].objective - best.objective,
                    confirmed=_confirmed(rows[0], best),
                )
            )
    changes = iter(corrected_family([one.confirmed for one in found if one.confirmed is not None]))
    found = [one if one.confirmed is None else replace(one, confirmed=next(changes)) for one in found]
    return tuple(sorted(found, key=lambda influence: (-influence.spread, influence.group)))


def _confirmed(first: SweepRow, best: SweepRow) -> RepeatedChange | None:
    if best is first or not best.confirming:
        return None
    # The objective is known for the whole suite only, which counts as one trial; new weights change each replicate.
    before, after = np.array([first.confirming]), np.array([best.confirming])
    return repeated(paired_change(OBJECTIVE, before, after), before, after - before)
