"""Analysis of a study: the difference table, its order and groups, and metrics that are fitted to it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import combinations
from typing import Any

import numpy as np

from marey_motion.arrays import Floats
from marey_motion.errors import MotionError
from marey_motion.perception.fitting import (
    FitQuality,
    PairDifferences,
    bootstrap_weights,
    fit_component,
    fit_power,
    fit_quality,
    fit_shares,
    leave_one_motion_out,
    predict,
)
from marey_motion.perception.judging import (
    DifferenceTable,
    Judgements,
    difference_table,
    pair_counts_by_participant,
    triangle_violations,
)
from marey_motion.perception.measuring import MeasuredClip, classes_measured
from marey_motion.perception.metric import Component, PerceptualMetric, uniform_metric
from marey_motion.perception.ordering import MotionOrder, order_motions
from marey_motion.perception.registration import differences_along_curve
from marey_schemas.documents.metrics import SHAPINGS, MetricDocument, Shaping

INTERVAL = (0.025, 0.975)
"""Quantiles of the resampled weights that are the lower and the upper end of each interval."""
FEWEST_FOR_INTERVALS = 5
"""Least number of participants for intervals: the quantiles need 40 different draws, and four people have only 35."""

Progress = Callable[[float, float, str], None]


@dataclass(frozen=True, eq=False)
class ComponentFit:
    """A component that was fitted to the table of perceived differences.

    Parameters
    ----------
    component : Component    constant, norm and weights
    quality : FitQuality    agreement with the table
    predicted : (R,) float64    fitted differences
    left_out : (R,) float64, optional    differences predicted by `leave_one_motion_out`; None for the shaping `power`,
        and if there are too few motions
    intervals : dict    95 % interval of each weight, as a share of the sum of all weights, over resampled participants;
        empty for the shaping `power`, without draws of participants, and if there are too few participants or answers
    """

    component: Component
    quality: FitQuality
    predicted: Floats
    left_out: Floats | None
    intervals: Mapping[str, tuple[float, float]]


@dataclass(frozen=True, eq=False)
class FittedMetric:
    """A metric of several components with one shaping; components and shares were fitted to the perceived differences.

    Parameters
    ----------
    metric : PerceptualMetric    components and shares
    parts : tuple of ComponentFit    the components, in the same order
    quality : FitQuality    agreement with the table
    left_out_rmse : float, optional    root mean square error for motions that were left out of the fit; None for the
        shaping `power`, and if there are too few motions
    """

    metric: PerceptualMetric
    parts: tuple[ComponentFit, ...]
    quality: FitQuality
    left_out_rmse: float | None


@dataclass(frozen=True, eq=False)
class StudyAnalysis:
    """Results of the analysis of a study's judgements.

    Parameters
    ----------
    judgements : Judgements    answered trials
    table : DifferenceTable    perceived differences
    violated, checked : int    numbers of triangle inequalities that the table violates, and that were checked
    order : MotionOrder, optional    order and groups; None if they could not be computed
    fits : tuple of FittedMetric    one for each shaping that could be fitted, best first
    refusals : tuple of str    for each result that could not be computed, its name and the reason
    """

    judgements: Judgements
    table: DifferenceTable
    violated: int
    checked: int
    order: MotionOrder | None
    fits: tuple[FittedMetric, ...]
    refusals: tuple[str, ...]

    @property
    def participants(self) -> int:
        """Number of participants with an answered trial."""
        return len(np.unique(self.judgements.participants))

    @property
    def chosen_share(self) -> float:
        """Share of the shown pairs that were chosen; always 1/6, because one of the six pairs of a trial is chosen."""
        return float(self.table.chosen.sum() / self.table.shown.sum())

    @property
    def missing(self) -> list[tuple[int, int]]:
        """Pairs of motions that were never shown together."""
        ones, others = np.triu_indices(self.judgements.motion_count, 1)
        return [(int(i), int(j)) for i, j in zip(ones, others, strict=True) if self.table.shown[i, j] == 0]


def measure_pairs(clips: Sequence[MeasuredClip], progress: Progress) -> list[PairDifferences]:
    """Measure, for all pairs of clips, the differences of each joint class along the pair's registration curve.

    Parameters
    ----------
    clips : sequence of MeasuredClip    n clips of one skeleton
    progress : function    called with the number of pairs done, the number of all pairs, and a note

    Returns
    -------
    list of PairDifferences    one for each kind of difference that the metric measures, with the pairs in the order of
        `numpy.triu_indices`

    Raises
    ------
    MotionError    if two clips cannot be compared
    """
    metric = uniform_metric()
    pairs = list(combinations(range(len(clips)), 2))
    frames: list[tuple[Floats, ...]] = []
    for done, (one, other) in enumerate(pairs):
        progress(done, len(pairs), "registering pairs of motions")
        frames.append(differences_along_curve(clips[one], clips[other], metric))
    return [
        PairDifferences(
            component.measurement,
            classes_measured(clips[0], component.measurement),
            np.array(pairs),
            tuple(each[number] for each in frames),
        )
        for number, component in enumerate(metric.components)
    ]


def analyse_study(
    judgements: Judgements, pairs: Sequence[PairDifferences], *, name: str, draws: int, seed: int
) -> StudyAnalysis:
    """Analyse the judgements of a study: compute the table, order the motions, and fit metrics.

    Parameters
    ----------
    judgements : Judgements    answered trials
    pairs : sequence of PairDifferences    differences of all pairs of motions by each measurement; if empty, no metric
        is fitted
    name : str    name of the study, for the names of the metrics
    draws : int    number of draws of participants for the intervals of weights
    seed : int    seed of these draws and of the groups

    Returns
    -------
    StudyAnalysis    table, order, groups and fits
    """
    table = difference_table(judgements)
    violated, checked = triangle_violations(table.differences)
    refusals: list[str] = []
    order = _order(table, seed, refusals)
    fits = [
        fit
        for shaping in (SHAPINGS if pairs else ())
        if (fit := _fit(judgements, table, pairs, shaping, name, draws, seed, refusals)) is not None
    ]
    fits.sort(key=lambda fit: fit.quality.rmse)
    return StudyAnalysis(judgements, table, violated, checked, order, tuple(fits), tuple(refusals))


def _order(table: DifferenceTable, seed: int, refusals: list[str]) -> MotionOrder | None:
    try:
        return order_motions(table.differences, seed)
    except MotionError as error:
        refusals.append(f"order and groups: {error}")
        return None


def _fit(
    judgements: Judgements,
    table: DifferenceTable,
    pairs: Sequence[PairDifferences],
    shaping: Shaping,
    name: str,
    draws: int,
    seed: int,
    refusals: list[str],
) -> FittedMetric | None:
    """Fit one component for each measurement, and then their shares; None if no component could be fitted.

    The reasons for components that could not be fitted are appended to `refusals`.
    """
    perceived = table.differences[np.triu_indices(len(table.differences), 1)]
    parts, fitted = [], []
    for differences in pairs:
        try:
            parts.append(_fit_component(judgements, differences, perceived, shaping, draws, seed))
            fitted.append(differences)
        except MotionError as error:
            refusals.append(f"{differences.measurement} with {shaping}: {error}")
    if not parts:
        return None
    shares = fit_shares([part.predicted for part in parts], perceived)
    metric = PerceptualMetric(f"{name}, {shaping}", tuple(part.component for part in parts), shares)
    quality = fit_quality(_mixed([part.predicted for part in parts], shares), perceived)
    left_out = None if shaping == "power" else _left_out(fitted, perceived, shaping)
    left_out_rmse = None if left_out is None else fit_quality(left_out, perceived).rmse
    return FittedMetric(metric, tuple(parts), quality, left_out_rmse)


def _mixed(predicted: Sequence[Floats], shares: Sequence[float]) -> Floats:
    return np.asarray(np.column_stack(predicted) @ np.asarray(shares))


def _fit_component(
    judgements: Judgements, differences: PairDifferences, perceived: Floats, shaping: Shaping, draws: int, seed: int
) -> ComponentFit:
    if shaping == "power":
        component = fit_power(differences, perceived)
        left_out, intervals = None, dict[str, tuple[float, float]]()
    else:
        component = fit_component(differences, perceived, shaping)
        left_out = _left_out([differences], perceived, shaping)
        intervals = _intervals(judgements, differences, shaping, draws, seed)
    predicted = predict(component, differences)
    return ComponentFit(component, fit_quality(predicted, perceived), predicted, left_out, intervals)


def _left_out(parts: Sequence[PairDifferences], perceived: Floats, shaping: Shaping) -> Floats | None:
    try:
        return leave_one_motion_out(parts, perceived, shaping)
    except MotionError:  # without a motion, too few pairs are left for a fit
        return None


def _intervals(
    judgements: Judgements, differences: PairDifferences, shaping: Shaping, draws: int, seed: int
) -> dict[str, tuple[float, float]]:
    """Return the 95 % interval of each weight, as a share of the sum of all weights, over draws of participants.

    Returns an empty dictionary without draws, and if there are too few participants or answers.
    """
    if not draws or len(np.unique(judgements.participants)) < FEWEST_FOR_INTERVALS:
        return {}
    shown, chosen = pair_counts_by_participant(judgements)
    try:
        drawn = bootstrap_weights(differences, shown, chosen, shaping, draws=draws, seed=seed)[:, 1:]
    except MotionError:  # some draws of participants know too few pairs
        return {}
    sums = drawn.sum(axis=1)
    if not (sums > 0).any():
        return {}
    low, high = np.quantile(drawn[sums > 0] / sums[sums > 0, None], INTERVAL, axis=0)
    return {each: (float(a), float(b)) for each, a, b in zip(differences.classes, low, high, strict=True)}


# -- documents ---------------------------------------------------------------------------------------------------------


def metric_to_tree(analysis: StudyAnalysis, fit: FittedMetric, study: Mapping[str, object]) -> dict[str, Any]:
    """Return a fitted metric as a document of the schema `marey/perceptual-metric@1`.

    Parameters
    ----------
    analysis : StudyAnalysis    the analysis to which the metric belongs
    fit : FittedMetric    the metric
    study : mapping    reference to the revision of the study

    Returns
    -------
    dict    the document; numbers that are unknown are None
    """
    components = [
        {
            "measurement": part.component.measurement,
            "shaping": part.component.shaping,
            "exponent": part.component.exponent,
            "constant": part.component.constant,
            "norm": part.component.norm,
            "weights": dict(part.component.weights),
            "share": share,
            "intervals": {name: list(ends) for name, ends in part.intervals.items()},
        }
        for part, share in zip(fit.parts, fit.metric.shares, strict=True)
    ]
    known = np.count_nonzero(np.triu(analysis.table.shown, 1))
    quality = {
        "motions": analysis.judgements.motion_count,
        "participants": analysis.participants,
        "trials": len(analysis.judgements.shown),
        "pairs": int(known),
        "rmse": fit.quality.rmse,
        "r2": _number(fit.quality.r2),
        "spearman": _number(fit.quality.spearman),
        "noise_ceiling": analysis.table.noise_ceiling,
        "left_out_rmse": _number(fit.left_out_rmse),
    }
    tree = {
        "name": fit.metric.name,
        "origin": "fitted",
        "study": dict(study),
        "components": components,
        "fit": quality,
    }
    return MetricDocument.model_validate(tree).stored()


def analysis_to_tree(analysis: StudyAnalysis, study: Mapping[str, object]) -> dict[str, Any]:
    """Return an analysis as a document; it contains nothing about single participants.

    Parameters
    ----------
    analysis : StudyAnalysis    the analysis
    study : mapping    reference to the revision of the study

    Returns
    -------
    dict    the document; unknown differences are None
    """
    order, table = analysis.order, analysis.table
    ordered = None
    if order is not None:
        ordered = {
            "order": order.order.tolist(),
            "projections": order.projections.tolist(),
            "groups": order.groups.tolist(),
            "membership": order.membership.tolist(),
        }
    return {
        "schema": "marey/study-analysis@1",
        "study": dict(study),
        "participants": analysis.participants,
        "trials": len(analysis.judgements.shown),
        "motions": analysis.judgements.motion_count,
        "differences": [[_number(one) for one in row] for row in table.differences.tolist()],
        "shown": table.shown.tolist(),
        "chosen": table.chosen.tolist(),
        "chosen_share": analysis.chosen_share,
        "missing": [list(pair) for pair in analysis.missing],
        "triangles": {"checked": analysis.checked, "violated": analysis.violated},
        "noise_ceiling": table.noise_ceiling,
        "order": ordered,
        "fits": [_fit_to_tree(analysis, fit, study) for fit in analysis.fits],
        "refusals": list(analysis.refusals),
    }


def _fit_to_tree(analysis: StudyAnalysis, fit: FittedMetric, study: Mapping[str, object]) -> dict[str, Any]:
    return {
        "shaping": fit.parts[0].component.shaping,
        "metric": metric_to_tree(analysis, fit, study),
        "quality": {name: _number(value) for name, value in asdict(fit.quality).items()},
        "components": {
            part.component.measurement: {name: _number(value) for name, value in asdict(part.quality).items()}
            for part in fit.parts
        },
    }


def _number(value: float | None) -> float | None:
    return None if value is None or not np.isfinite(value) else value
