"""Conversion of comparisons, suggestions and logs of optimisations to plain values and arrays."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, fields
from typing import Any

import numpy as np

from marey_motion.evaluation.compare import Comparison, MetricChange
from marey_motion.evaluation.improvement import reasons
from marey_motion.evaluation.improvement.confirming import Confirmed
from marey_motion.evaluation.improvement.defects import Defects
from marey_motion.evaluation.improvement.duplicates import NearDuplicate
from marey_motion.evaluation.improvement.effects import Effect
from marey_motion.evaluation.improvement.filling import Filling
from marey_motion.evaluation.improvement.optimise import Optimisation
from marey_motion.evaluation.improvement.redundancy import Removal
from marey_motion.evaluation.improvement.suggest import Suggestions
from marey_motion.evaluation.perceived import indistinguishable
from marey_motion.evaluation.similarity import PoseSimilarity
from marey_schemas.documents.metrics import MetricDocument, MetricIdentity

COMPARISON_SCHEMA = "marey/comparison@1"
SUGGESTIONS_SCHEMA = "marey/suggestions@1"
OPTIMISATION_SCHEMA = "marey/optimisation@1"

Tree = dict[str, Any]


def comparison_to_tree(comparison: Comparison) -> Tree:
    """Convert a comparison of two evaluations; the document identifies each evaluation by its set of clips.

    Parameters
    ----------
    comparison : Comparison    the comparison

    Returns
    -------
    dict    plain values and arrays
    """
    sides = {"before": comparison.before, "after": comparison.after}
    return {
        "schema": COMPARISON_SCHEMA,
        **{name: {"dataset": side.provenance.dataset, "clips": len(side.clips)} for name, side in sides.items()},
        "trials": len(comparison.before.trials),
        "metrics": _plain(comparison.metrics),
        "changed": [asdict(change) for change in comparison.changed],
        "removed": list(comparison.removed),
        "added": list(comparison.added),
        "newly_unused": list(comparison.newly_unused),
        "coverage_change_s": comparison.coverage_change_s,
        **{f"perceived_{name}": asdict(side.perceived) for name, side in sides.items() if side.perceived is not None},
    }


def suggestions_to_tree(suggestions: Suggestions) -> Tree:
    """Convert all proposals with their reasons to one document.

    Parameters
    ----------
    suggestions : Suggestions    the proposals

    Returns
    -------
    dict    plain values and arrays
    """
    found = suggestions
    return {
        "schema": SUGGESTIONS_SCHEMA,
        "dataset": found.result.provenance.dataset,
        "normaliser": found.result.provenance.normaliser,
        "options": found.options.model_dump(),
        "chance": {} if found.confirmed is None else dict(found.confirmed.chance),
        "unused": {
            **_unused_effects(found.confirmed),
            "clips": [{**asdict(clip), "reason": reasons.why_unused_clip(clip)} for clip in found.unused.clips],
            "ranges": [
                {**asdict(part), "seconds": part.seconds, "reason": reasons.why_unused_range(part)}
                for part in found.unused.ranges
            ],
            "seconds": found.unused.seconds,
        },
        "redundant": _redundant_to_tree(found),
        "near_duplicates": _duplicates_to_tree(found),
        "similarity": _similarity_to_tree(found.similarity),
        "fillings": [_filling_to_tree(one, found.defects.get(one.source)) for one in found.fillings],
        "quality": {"reason": reasons.why_look(found.fillings, found.defects)},
        "additions": [
            {
                "collection": step.filling.collection,
                "source": step.filling.source,
                "filled_s": step.filled_s,
                "coverage_index": step.coverage_index,
                "confirmed": _plain(step.confirmed),
                "reason": reasons.why_addition(step, found.defects.get(step.filling.source)),
            }
            for step in found.additions
        ],
    }


def _filling_to_tree(filling: Filling, defects: Defects | None) -> Tree:
    """Convert a clip to add; the field `quality` is left out if the quality was not measured."""
    measured = {} if defects is None else {"quality": _plain(defects)}
    return {**_plain(filling), **measured, "reason": reasons.why_filling(filling, defects)}


def _unused_effects(confirmed: Confirmed | None) -> Tree:
    """Convert two confirmed effects: of removing all unused clips, and of removing all unused clips and ranges."""
    effects = (
        {"clips": None, "ranges": None}
        if confirmed is None
        else {"clips": confirmed.unused, "ranges": confirmed.ranges}
    )
    return {
        f"confirmed_{name}": None if effect is None else {**_plain(effect), "reason": reasons.why_unused_again(effect)}
        for name, effect in effects.items()
    }


def _duplicates_to_tree(suggestions: Suggestions) -> Tree:
    limits = _metric_to_tree(suggestions.metric)
    return {
        "threshold_cm": suggestions.duplicates.threshold_cm,
        "pairs": [_pair_to_tree(pair) for pair in suggestions.duplicates.pairs],
        **limits,
        "spared": [
            {"source": source, "reason": reasons.why_duplicate(source, pair, limits.get("most_perceived"))}
            for source, pair in suggestions.spared
        ],
    }


def _pair_to_tree(pair: NearDuplicate) -> Tree:
    """Convert a pair of near-duplicates; without a perceptual metric, the field `perceived` is left out."""
    tree = asdict(pair)
    if pair.perceived is None:
        del tree["perceived"]
    elif not np.isfinite(pair.perceived):
        tree["perceived"] = None
    return tree


def _metric_to_tree(metric: MetricDocument | None) -> Tree:
    """Describe the metric, and the greatest distance of near-duplicates to remove; empty without a metric."""
    return {} if metric is None else {**_identity_to_tree(metric), "most_perceived": indistinguishable(metric)}


def _identity_to_tree(metric: MetricDocument | None) -> Tree:
    return {} if metric is None else {"metric": MetricIdentity.of(metric).model_dump(mode="json")}


def _redundant_to_tree(suggestions: Suggestions) -> Tree:
    trials = len(suggestions.result.trials)

    def reason_for(removal: Removal, confirmed: Effect | None = None) -> Tree:
        return {"reason": reasons.why_redundant(removal, trials, confirmed)}

    return {
        "tried": suggestions.tried[0],
        "needed": suggestions.tried[1],
        "harmless_steps": suggestions.harmless_steps,
        "clips": [{**_removal_to_tree(removal), **reason_for(removal)} for removal in suggestions.redundant],
        "plan": [
            {**_plain(step), "removal": _removal_to_tree(step.removal), **reason_for(step.removal, step.confirmed)}
            for step in suggestions.plan
        ],
        **_identity_to_tree(suggestions.metric),
    }


def _removal_to_tree(removal: Removal) -> Tree:
    """Convert a removal; without a perceptual metric, the fields about lost poses are left out."""
    tree: Tree = _plain(removal)
    return {name: value for name, value in tree.items() if value is not None}


def _similarity_to_tree(similarity: PoseSimilarity) -> Tree:
    """Convert a similarity to plain values. NaN, in cells without frames or with only one source, is written as 0.

    Distances in metres have names that end in `_m`. Distances of a perceptual metric have names without this ending,
    and the field `metric` contains the metric's name and digest.
    """
    values = {field.name: getattr(similarity, field.name) for field in fields(similarity)}
    metric = values.pop("metric")
    named = {"threshold_m": values.pop("threshold"), "distance_m": values.pop("distance")}
    if metric is not None:
        named = {name.removesuffix("_m"): value for name, value in named.items()}
        named["metric"] = metric.model_dump(mode="json")
    values |= named
    return {name: np.nan_to_num(value) if isinstance(value, np.ndarray) else value for name, value in values.items()}


def optimisation_to_tree(optimisation: Optimisation) -> Tree:
    """Convert the log of an optimisation, so that it can be stored and the optimisation continued later.

    Parameters
    ----------
    optimisation : Optimisation    the log

    Returns
    -------
    dict    plain values and arrays
    """
    return {
        "schema": OPTIMISATION_SCHEMA,
        "ended": optimisation.ended,
        "steps": [_plain(step) for step in optimisation.steps],
        "unconfirmed": [_plain(one) for one in optimisation.unconfirmed],
        "total": _plain(optimisation.total),
    }


def _plain(value: Any) -> Any:
    """Convert dataclasses to dictionaries, and tuples to lists; a change of a metric also gets its verdict."""
    if isinstance(value, MetricChange):
        return {**asdict(value), "verdict": value.verdict}
    if hasattr(value, "__dataclass_fields__"):
        return {field.name: _plain(getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, Mapping):
        return {key: _plain(member) for key, member in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    return value
