"""Effects of changes of a set of clips on its trials: estimated in some replicates, confirmed in others.

If the best of many candidates is chosen by its estimated effect, the estimate is probably too large (selection bias).
So the effect is measured again in replicates that were not used for the choice.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from marey_motion.arrays import Floats
from marey_motion.evaluation.compare import OBJECTIVE, MetricChange, corrected_family, paired_change
from marey_motion.evaluation.improvement.objective import HEADLINES, headline_means, metric_weights, objective_value
from marey_motion.evaluation.improvement.repeating import repeated
from marey_motion.evaluation.improvement.resimulation import Resimulation, Sources
from marey_motion.evaluation.result import TrialResult
from marey_schemas.options.evaluation import EvaluationOptions
from marey_schemas.options.improvement import ConfirmedEffects, ObjectiveOptions

Replicates = Sequence[Sequence[TrialResult]]
"""Results of all trials, for each replicate."""


@dataclass(frozen=True)
class Effect:
    """Effect of one change of a set of clips: the differences between replicates before and after it, paired by number.

    Parameters
    ----------
    objective : change of the objective, metres; without its term for the amount of data, unless the effect was computed
        with amounts of data
    headlines : change of each headline metric, by name, in its unit

    Changes that were computed from trials are `RepeatedChange`; they also have an interval that contains most changes
    measured with other seeds.
    """

    objective: MetricChange
    headlines: Mapping[str, MetricChange]

    @property
    def improves(self) -> bool:
        """True if the objective falls by more than chance explains; False also if there are too few replicates."""
        return self.objective.verdict == "better"


def estimation_replicates(options: ConfirmedEffects) -> range:
    """Return the numbers of the replicates in which effects are estimated.

    Parameters
    ----------
    options : ConfirmedEffects    numbers of replicates

    Returns
    -------
    range    from 0 to `options.estimation_replicates` - 1
    """
    return range(options.estimation_replicates)


def confirmation_replicates(options: ConfirmedEffects, evaluation: EvaluationOptions, turn: int = 0) -> range:
    """Return the numbers of the replicates in which effects are confirmed; no choice was based on these replicates.

    All replicates of the evaluation are excluded, too, because a clip is unused only if none of them displays it.

    Parameters
    ----------
    options : ConfirmedEffects    numbers of replicates
    evaluation : EvaluationOptions    options of the evaluation whose set is improved
    turn : int    0 for the first confirmation, 1 for a second confirmation in different replicates

    Returns
    -------
    range    numbers of replicates that neither the estimate nor the evaluation uses, whatever the seeds are
    """
    chosen_from = max(options.estimation_replicates, evaluation.replicates)
    first = chosen_from + turn * options.confirmation_replicates
    return range(first, first + options.confirmation_replicates)


def effect_between(
    objective: ObjectiveOptions, before: Replicates, after: Replicates, data_s: tuple[float, float] = (0.0, 0.0)
) -> Effect:
    """Compute the effect of a change from the trials before and after it.

    Parameters
    ----------
    objective : ObjectiveOptions    weights of the objective
    before, after : sequence of sequence of TrialResult    the same replicates in the same order
    data_s : pair of float    seconds of data before and after, whose price is part of the objective

    Returns
    -------
    Effect    the effect; its probabilities are not yet corrected for the number of effects that are reported together
    """
    means = [[headline_means(one) for one in side] for side in (before, after)]
    values = [
        np.array([[objective_value(objective, one, seconds) for one in side]])
        for side, seconds in zip((before, after), data_s, strict=True)
    ]
    addends = {name: tuple(_addends(side, name) for side in (before, after)) for name in HEADLINES}
    headlines = {}
    for name, (old, new) in addends.items():
        first, second = (np.array([[one[name] for one in side]]) for side in means)
        headlines[name] = repeated(paired_change(name, first, second), old, new - old)
    weights = metric_weights(objective)
    old, new = (
        sum((weight * addends[name][side] for name, weight in weights.items()), np.zeros(())) for side in (0, 1)
    )
    return Effect(repeated(paired_change(OBJECTIVE, values[0], values[1]), old, new - old), headlines)


def _addends(results: Replicates, name: str) -> Floats:
    """Return what each of T trials adds to the mean of a headline metric in each of R replicates, (T, R).

    A trial in which the metric is not defined adds 0.
    """
    found = np.array(
        [[np.nan if (value := one.metrics.get(name)) is None else value for one in own] for own in results]
    )
    known = np.isfinite(found)
    shares = np.where(known, found, 0.0) / np.maximum(known.sum(axis=1, keepdims=True), 1)
    return np.ascontiguousarray(shares.T)


def effect_of(
    simulation: Resimulation, objective: ObjectiveOptions, before: Sources, after: Sources, *, with_data: bool = False
) -> Effect:
    """Compute the effect of adding clips to a set or removing clips, by simulating the trials before and after.

    Parameters
    ----------
    simulation : Resimulation    the trials, and the replicates in which they run
    objective : ObjectiveOptions    weights of the objective
    before, after : frozenset of str    uids of the source clips that are not in the set, before and after the change
    with_data : bool    whether the objective includes the price of the data

    Returns
    -------
    Effect    the effect; its probabilities are not yet corrected for the number of effects that are reported together
    """
    data_s = (simulation.seconds(before), simulation.seconds(after)) if with_data else (0.0, 0.0)
    return effect_between(objective, simulation.by_replicate(before), simulation.by_replicate(after), data_s)


def corrected_effects(effects: Sequence[Effect]) -> tuple[Effect, ...]:
    """Correct the probabilities of several effects that are reported together, each metric for the number of effects.

    Parameters
    ----------
    effects : sequence of Effect    with uncorrected probabilities

    Returns
    -------
    tuple of Effect    with corrected probabilities, in the same order
    """
    objectives = corrected_family([effect.objective for effect in effects])
    headlines = {name: corrected_family([effect.headlines[name] for effect in effects]) for name in HEADLINES}
    return tuple(
        replace(effect, objective=objectives[place], headlines={name: headlines[name][place] for name in HEADLINES})
        for place, effect in enumerate(effects)
    )


def corrected_for(effect: Effect, tried: int) -> Effect:
    """Correct the probabilities of one of several effects that are tested one after another until one is confirmed.

    Parameters
    ----------
    effect : Effect    with uncorrected probabilities
    tried : int    number of effects that may be tested

    Returns
    -------
    Effect    with all probabilities multiplied by `tried`, at most 1; intervals are not corrected
    """

    def raised(change: MetricChange) -> MetricChange:
        return change if change.p is None else replace(change, p=min(1.0, tried * change.p))

    headlines = {name: raised(change) for name, change in effect.headlines.items()}
    return replace(effect, objective=raised(effect.objective), headlines=headlines)


def chance_of(simulation: Resimulation, removed: Sources) -> dict[str, float]:
    """Measure how far chance alone moves the headline metrics of a set from one replicate to the next.

    Parameters
    ----------
    simulation : Resimulation    the trials
    removed : frozenset of str    sources that are not in the set

    Returns
    -------
    dict of str to float    standard deviation of each headline metric over the replicates, in the unit of the metric;
        empty if there is one replicate only
    """
    means = [headline_means(one) for one in simulation.by_replicate(removed)]
    return {name: float(np.std([one[name] for one in means], ddof=1)) for name in HEADLINES} if len(means) > 1 else {}
