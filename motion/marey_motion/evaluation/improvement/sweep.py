"""Evaluations of one suite with different weights of the feature groups, to find out which groups matter."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from marey_motion.errors import MotionError
from marey_motion.evaluation.improvement.objective import headline_means, objective_value
from marey_motion.evaluation.looks import LooksMeter
from marey_motion.evaluation.metrics import measure_trial, pooled_metrics
from marey_motion.evaluation.result import Metrics
from marey_motion.evaluation.running import CancelCallback
from marey_motion.evaluation.scenario import Trial, reference, suite_trials
from marey_motion.evaluation.suite import run_suite
from marey_motion.matching.database import MatchingDatabase
from marey_motion.matching.features import feature_layout
from marey_motion.matching.normaliser import UNMATCHED_SCALE
from marey_schemas.options.evaluation import EvaluationOptions
from marey_schemas.options.improvement import ObjectiveOptions
from marey_schemas.options.matching import DatabaseOptions, FeatureWeights

ProgressCallback = Callable[[int, int, str], None]

GROUPS = tuple(FeatureWeights.model_fields)


@dataclass(frozen=True)
class SweepRow:
    """Result of one setting: weights, pooled metrics and headline metrics of the suite, and the objective in metres."""

    weights: FeatureWeights
    metrics: Metrics
    headlines: dict[str, float]
    objective: float


@dataclass(frozen=True)
class Influence:
    """Influence of one feature group on the objective, over the settings that differ only in this group's weight.

    Parameters
    ----------
    spread : largest minus least objective, metres
    best_weight : weight with the least objective
    gain : decrease of the objective from the first setting to the best, metres
    """

    group: str
    spread: float
    best_weight: float
    gain: float


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
    objective: ObjectiveOptions | None = None,
    trials: Sequence[Trial] | None = None,
    threads: int | None = None,
    progress: ProgressCallback | None = None,
    cancelled: CancelCallback | None = None,
) -> tuple[SweepRow, ...]:
    """Run the suite with each setting of the weights; the features and their standard deviations stay the same.

    Progress counts trials over all settings.

    Parameters
    ----------
    database : MatchingDatabase    the clips
    options : EvaluationOptions    options of the evaluation
    settings : sequence of FeatureWeights    weights to try
    objective : ObjectiveOptions, optional    measure of the result; its default weights if None
    trials : sequence of Trial, optional    trials to run; all trials of the suite if None
    threads : int, optional    number of trials to run at once
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
    aim = objective or ObjectiveOptions()
    report = progress or (lambda _done, _total, _note: None)
    looks = LooksMeter(database, options.controller)
    rows = []
    for number, weights in enumerate(settings):
        weighted = reweighted(database, weights)

        def told(done: int, _total: int, note: str, before: int = number * len(wanted)) -> None:
            report(before + done, len(settings) * len(wanted), note)

        records = run_suite(weighted, options, trials=wanted, threads=threads, progress=told, cancelled=cancelled)
        rate = database.options.rate_hz
        results = [
            measure_trial(trial, reference(trial, rate), record, options, looks)
            for trial, record in zip(wanted, records, strict=True)
        ]
        # The price of data is the same for all settings, and left out.
        rows.append(
            SweepRow(weights, pooled_metrics(results), headline_means(results), objective_value(aim, results, 0.0))
        )
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
                )
            )
    return tuple(sorted(found, key=lambda influence: (-influence.spread, influence.group)))
