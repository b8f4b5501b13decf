"""Perceptual metrics as tables of numbers, from which kernels compute distances between rows of features."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from marey_motion.arrays import Flags, Floats, Ints
from marey_motion.errors import MotionError
from marey_motion.perception.maps import ANGLE_NUMBERS, SHAPING_NUMBERS
from marey_motion.perception.metric import JOINT_CLASSES, Component, PerceptualMetric
from marey_motion.similarity.features import JOINTS, ROTATED_JOINTS
from marey_schemas.documents.metrics import classes_of


class MetricTables(NamedTuple):
    """A perceptual metric as arrays for kernels, for skeletons that have certain joints in common.

    The distance of two rows is the sum over components of constant + Σ weight · F(x), with a term for each class of
    joints; x is the sum of factor · distance over the joints of the class.

    Parameters
    ----------
    rotated : (T,) int64    1 if the term compares rotations, 0 if vectors
    places : (T, 2) int64    number of the rotation or vector of each side; -1 for none
    factors : (T, 2) float64    factor by which the distance of each side is multiplied
    weights : (T,) float64    product of the share of the component, its norm N, and the weight w of the class
    starts : (C + 1,) int64    the terms of component c are [starts[c], starts[c + 1])
    constants : (C,) float64    product of the share and the constant c of each component
    shapings : (C,) int64    shaping F of each component, as a number (`maps.SHAPING_NUMBERS`)
    exponents : (C,) float64    exponent of the shaping `power`
    angle : int    measure of angles, as a number (`maps.ANGLE_NUMBERS`)
    always : bool    whether the constants are added for equal poses, too
    """

    rotated: Ints
    places: Ints
    factors: Floats
    weights: Floats
    starts: Ints
    constants: Floats
    shapings: Ints
    exponents: Floats
    angle: int
    always: bool


def require_searchable(metric: PerceptualMetric) -> None:
    """Check that features can be compared by a metric.

    Parameters
    ----------
    metric : PerceptualMetric    metric

    Raises
    ------
    MotionError    if the metric superposes each pair of poses
    """
    if metric.root_alignment != "mean_heading":
        raise MotionError(
            f"the metric {metric.name!r} superposes each pair of poses (root_alignment {metric.root_alignment}); the "
            "index holds poses with their mean heading removed, so use a metric with root_alignment mean_heading",
            code="metric-not-searchable",
        )


def metric_tables(metric: PerceptualMetric, present: Flags) -> MetricTables | None:
    """Compute the tables of a metric for two skeletons.

    Parameters
    ----------
    metric : PerceptualMetric    metric that `require_searchable` accepts
    present : (15,) bool    which of `JOINTS` both skeletons have; the weights of missing classes are spread over the
        other classes

    Returns
    -------
    MetricTables or None    None if a component has no class that both skeletons have
    """
    known = {joint for joint, found in zip(JOINTS, present, strict=True) if found}
    used = [one for one in zip(metric.shares, metric.components, strict=True) if one[0] > 0]
    terms, starts = [], [0]
    for share, component in used:
        found = _terms(metric, share, component, known)
        if not found:
            return None
        terms += found
        starts.append(len(terms))
    rotated, places, factors, weights = zip(*terms, strict=True)
    return MetricTables(
        np.array(rotated, np.int64),
        np.array(places, np.int64),
        np.array(factors, np.float64),
        np.array(weights, np.float64),
        np.array(starts, np.int64),
        np.array([share * component.constant for share, component in used]),
        np.array([SHAPING_NUMBERS[component.shaping] for _, component in used]),
        np.array([component.exponent for _, component in used]),
        ANGLE_NUMBERS[metric.angle],
        metric.identity == "constant",
    )


_Term = tuple[bool, list[int], list[float], float]


def _terms(metric: PerceptualMetric, share: float, component: Component, known: set[str]) -> list[_Term]:
    """List a component's terms (`rotated`, `places`, `factors`, `weight`): one per joint class of positive weight."""
    turned = component.measurement == "angles"
    names = ROTATED_JOINTS if turned else JOINTS
    first = len(JOINTS) if component.measurement == "velocities" else 0
    scale = {
        "angles": 1.0,
        "positions": 1.0 / metric.length_unit_m,
        "velocities": metric.velocity_interval_s / metric.length_unit_m,
    }[component.measurement]
    sides = {
        name: [names.index(joint) + first for joint in JOINT_CLASSES[name] if joint in known]
        for name in classes_of(component.measurement)
    }
    classes = tuple(name for name, places in sides.items() if places)
    if sum(component.weights.get(name, 0.0) for name in classes) <= 0:
        return []
    terms: list[_Term] = []
    for name, weight in zip(classes, component.shares_of(classes), strict=True):
        if weight > 0:
            places = sides[name]
            factor = scale / len(places) if metric.side_reduce == "mean" else scale
            padded = [*places, -1][:2]
            terms.append((turned, padded, [factor if place >= 0 else 0.0 for place in padded],
                          share * component.norm * float(weight)))  # fmt: skip
    return terms
