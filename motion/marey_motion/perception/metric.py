"""Perceptual metrics: weights of joint classes for angles, positions and velocities, and their combination.

The distance of two poses by one measurement is c + N · Σ w F(x), with the sum over joint classes. x is the difference
of the class in the two poses, F is the shaping, and the weights w have the sum 1. The distance of a metric is the mean
of its measurements' distances, weighted by their shares.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from marey_motion.arrays import Floats
from marey_motion.errors import MotionError
from marey_schemas.documents import metrics
from marey_schemas.documents.metrics import (
    METRIC_CODE,
    AngleMeasure,
    Measurement,
    MetricDocument,
    Shaping,
    classes_of,
)

JOINT_CLASSES: Mapping[str, tuple[str, ...]] = {
    "head": ("head",),
    "clavicle": ("left_clavicle", "right_clavicle"),
    "upper_arm": ("left_shoulder", "right_shoulder"),
    "forearm": ("left_elbow", "right_elbow"),
    "hand": ("left_wrist", "right_wrist"),
    "thigh": ("left_hip", "right_hip"),
    "calf": ("left_knee", "right_knee"),
    "toe": ("left_toe", "right_toe"),
}
"""Standard joints of each class. A class named after a bone has the joints at its upper end: forearm has the elbows."""


@dataclass(frozen=True)
class Component:
    """The distance of poses by one measurement.

    Parameters
    ----------
    measurement : str    angles, positions or velocities
    shaping : str    F: euclid x², manhattan x, sigmoid x / (x + 1), power x^exponent
    constant : float    c, which is added for poses that differ, and for equal poses only if the metric's `identity` is
        "constant"
    norm : float    N, by which the weighted mean Σ w F(x) is multiplied
    weights : mapping of str to float    weight of each joint class, with any sum; they are divided by their sum
    exponent : float    exponent of the shaping `power`
    """

    measurement: Measurement
    shaping: Shaping
    constant: float
    norm: float
    weights: Mapping[str, float]
    exponent: float = 1.0

    def __post_init__(self) -> None:
        allowed = classes_of(self.measurement)
        if unknown := [name for name in self.weights if name not in allowed]:
            raise MotionError(
                f"the measured {self.measurement} have no class {unknown[0]}; use {', '.join(allowed)}", where="weights"
            )
        numbers = [self.constant, self.norm, self.exponent, *self.weights.values()]
        if not (np.isfinite(numbers).all() and min(numbers) >= 0 and sum(self.weights.values()) > 0):
            raise MotionError(
                "constant, norm and weights must be finite and at least 0, the exponent finite and above 0, and at "
                "least one weight above 0",
                where=self.measurement,
            )
        if self.exponent == 0:
            raise MotionError("the exponent must be above 0", where="exponent")

    def shares_of(self, classes: tuple[str, ...]) -> Floats:
        """Divide the weights of the given classes by their sum.

        Parameters
        ----------
        classes : tuple of str    K classes that the skeleton has; the other classes are left out

        Returns
        -------
        (K,) float64    non-negative, with the sum 1

        Raises
        ------
        MotionError    if the skeleton has no class with a weight
        """
        found = np.array([self.weights.get(name, 0.0) for name in classes])
        if found.sum() <= 0:
            needed = ", ".join(
                joint for name, weight in self.weights.items() if weight > 0 for joint in JOINT_CLASSES[name]
            )
            raise MotionError(
                f"the joint mapping contains none of the joints with a weight for {self.measurement}: {needed}; map at "
                "least one of them",
                code="mapping-invalid",
            )
        return np.asarray(found / found.sum())


@dataclass(frozen=True)
class PerceptualMetric:
    """A perceptual metric: components with shares, and the conventions by which poses are measured.

    Parameters
    ----------
    name : str    name shown to users
    components : tuple of Component    at most one per measurement
    shares : tuple of float    weights of the components' distances, non-negative, with the sum 1
    angle : str    measure of angles; half_angle is arccos |q · p|, angle is twice as large, one_minus_dot is
        1 - |q · p|, and log_norm, the norm of the logarithm of the rotation from q to p, equals half_angle
    side_reduce : str    whether the difference of a class is the "mean" or the "sum" over left and right joint
    identity : str    zero: equal poses have the distance 0; constant: equal poses have the distance c
    root_alignment : str    mean_heading: the hips are placed at the origin, and the mean heading of one second is
        removed; kovar2d: each pair of poses is superposed by the best rotation about the vertical and the best shift
    length_unit_m : float    metres per unit of length
    velocity_interval_s : float    seconds; velocities are compared as displacements in this time
    """

    name: str
    components: tuple[Component, ...]
    shares: tuple[float, ...]
    angle: AngleMeasure = "half_angle"
    side_reduce: Literal["mean", "sum"] = "mean"
    identity: Literal["zero", "constant"] = "zero"
    root_alignment: Literal["mean_heading", "kovar2d"] = "mean_heading"
    length_unit_m: float = 1.0
    velocity_interval_s: float = 1.0 / 30.0

    def __post_init__(self) -> None:
        measured = [one.measurement for one in self.components]
        if not measured or len(set(measured)) != len(measured) or len(self.shares) != len(measured):
            raise MotionError("a metric needs components of different measurements, and one share for each component")
        if min(self.shares) < 0 or abs(sum(self.shares) - 1.0) > 1e-9:
            raise MotionError("the shares must be at least 0 and have the sum 1", where="shares")
        units = (self.length_unit_m, self.velocity_interval_s)
        if not (np.isfinite(units).all() and min(units) > 0):
            raise MotionError("length_unit_m and velocity_interval_s must be finite and above 0")


def metric_of(document: MetricDocument) -> PerceptualMetric:
    """Make the metric that a document describes.

    Parameters
    ----------
    document : MetricDocument    weights and conventions

    Returns
    -------
    PerceptualMetric    the metric

    Raises
    ------
    MotionError    if the metric was fitted to distances of another version of the computation
    """
    if document.code_version != METRIC_CODE:
        raise MotionError(
            f"the metric {document.name} was made for {document.code_version}, but this version of Marey computes "
            f"{METRIC_CODE}; fit the metric again",
            code="metric-of-other-version",
        )
    return PerceptualMetric(
        document.name,
        tuple(_component_of(one) for one in document.components),
        tuple(one.share for one in document.components),
        document.angle,
        document.side_reduce,
        document.identity,
        document.root_alignment,
        document.length_unit_m,
        document.velocity_interval_s,
    )


def published_metric(shaping: Shaping = "sigmoid") -> PerceptualMetric:
    """Make the metric of Pražák et al., with equal shares of angles, positions and velocities.

    Parameters
    ----------
    shaping : str    euclid, manhattan or sigmoid

    Returns
    -------
    PerceptualMetric    three components; their shares were not published

    Raises
    ------
    MotionError    for the shaping `power`
    """
    return _built_in("published", shaping)


def uniform_metric(shaping: Shaping = "manhattan") -> PerceptualMetric:
    """Make a metric that weights all joint classes equally, for comparison with fitted metrics.

    Parameters
    ----------
    shaping : str    euclid, manhattan or sigmoid, for all components

    Returns
    -------
    PerceptualMetric    three components with c = 0 and N = 1, in equal shares

    Raises
    ------
    MotionError    for the shaping `power`
    """
    return _built_in("uniform", shaping)


def _built_in(origin: str, shaping: Shaping) -> PerceptualMetric:
    if shaping == "power":
        raise MotionError(
            "the built-in metrics do not have this shaping; use euclid, manhattan or sigmoid", where=shaping
        )
    return metric_of(metrics.built_in_metric(f"{origin}/{shaping}"))


def shaped(differences: Floats, shaping: Shaping, exponent: float = 1.0) -> Floats:
    """Apply a shaping F to differences.

    Parameters
    ----------
    differences : (...) float64    x, at least 0
    shaping : str    euclid x², manhattan x, sigmoid x / (x + 1), power x^exponent
    exponent : float    exponent of `power`

    Returns
    -------
    (...) float64    F(x)
    """
    if shaping == "euclid":
        return differences * differences
    if shaping == "sigmoid":
        return differences / (differences + 1.0)
    return differences.copy() if shaping == "manhattan" else np.asarray(differences**exponent)


def _component_of(document: metrics.MetricComponent) -> Component:
    return Component(
        document.measurement,
        document.shaping,
        document.constant,
        document.norm,
        dict(document.weights.items()),
        document.exponent,
    )
