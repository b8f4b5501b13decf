"""Perceptual metrics: part `metric` of an item of the kind `metric`, and the built-in metrics, which need no item.

The distance of two different poses by one component of a metric is c + N · Σ w F(x). The sum is over joint classes: x
is the difference of a class by the component's measurement, and w the share of the class in all weights. The component
defines the function F, the constant c and the factor N. The distance of the metric is the mean of the components'
distances, weighted by their shares.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Annotated, Any, Literal, Self, get_args

from pydantic import AfterValidator, Field, WithJsonSchema, model_validator

from marey_schemas.base import Request
from marey_schemas.documents.references import OutputRef, RevisionRef
from marey_schemas.encoding.canonical import document_digest
from marey_schemas.names import Digest, form

Measurement = Literal["angles", "positions", "velocities"]
Shaping = Literal["euclid", "manhattan", "sigmoid", "power"]
AngleMeasure = Literal["half_angle", "angle", "one_minus_dot", "log_norm"]
JointClass = Literal["head", "clavicle", "upper_arm", "forearm", "hand", "thigh", "calf", "toe"]

MEASUREMENTS: tuple[Measurement, ...] = get_args(Measurement)
SHAPINGS: tuple[Shaping, ...] = get_args(Shaping)
JOINT_CLASS_NAMES: tuple[JointClass, ...] = get_args(JointClass)
WITHOUT_ANGLES: tuple[JointClass, ...] = ("hand", "toe")
"""Joint classes for which Pražák et al. (2009) give no weights of angles."""
METRIC_RATE_HZ = 60.0
"""Frame rate at which the built-in metrics measure clips; clips of other rates are resampled."""
METRIC_CODE = "perceptual-metric@1"
"""Version of the computation of distances; it changes whenever the same metric may give other distances."""

_Amount = Annotated[float, Field(ge=0, le=1e9, allow_inf_nan=False)]
_Share = Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)]
_Positive = Annotated[float, Field(gt=0, le=1e6, allow_inf_nan=False)]
_Number = Annotated[float, Field(allow_inf_nan=False)]

PUBLISHED: Mapping[Measurement, Mapping[Shaping, tuple[float | None, ...]]] = {
    "angles": {
        "euclid": (23.335, 0.508, 659.272, 0.000, 0.000, 0.006, 0.000, None, 0.669, 0.325, None),
        "manhattan": (18.448, 0.324, 19.537, 0.041, 0.003, 0.061, 0.000, None, 0.622, 0.273, None),
        "sigmoid": (18.004, 0.312, 20.016, 0.039, 0.008, 0.076, 0.000, None, 0.614, 0.263, None),
    },
    "positions": {
        "euclid": (17.117, 0.290, 206.509, 0.062, 0.000, 0.551, 0.181, 0.000, 0.000, 0.050, 0.156),
        "manhattan": (13.423, 0.069, 9.909, 0.020, 0.000, 0.362, 0.429, 0.000, 0.000, 0.000, 0.189),
        "sigmoid": (13.264, 0.059, 10.375, 0.015, 0.000, 0.344, 0.455, 0.000, 0.000, 0.000, 0.184),
    },
    "velocities": {
        "euclid": (25.779, 0.431, 1914.283, 0.000, 0.000, 0.000, 0.000, 0.605, 0.000, 0.298, 0.098),
        "manhattan": (22.039, 0.193, 36.885, 0.000, 0.000, 0.000, 0.000, 0.551, 0.000, 0.298, 0.151),
        "sigmoid": (21.993, 0.189, 36.532, 0.000, 0.000, 0.000, 0.000, 0.564, 0.000, 0.306, 0.157),
    },
}
"""Figure 5 of Pražák et al. (2009), by measurement and function F.

The numbers are its column "difference", which is not used, then c, N, and the weights of `JOINT_CLASS_NAMES`.
"""

_TEXT_AND_TABLE = (
    "The text of the paper says that velocities use hands, thighs and calves; its table has hand, calf and toe, and no "
    "thigh. The table is used."
)
_NO_SHARES = "The paper prints no shares of angles, positions and velocities; each has a third."
_MOST_ROUNDING = 0.0025
"""Greatest deviation of the sum of printed weights from 1 that their rounding explains."""

PUBLISHED_ERROR = 0.05
"""Standard error of a published perceived difference: in 1,827 trials, each of the 210 pairs was shown 52 times."""

_BUILT_IN_PATTERN = form(
    r"^(published|uniform)/(?:(angles|positions|velocities)-)?(euclid|manhattan|sigmoid)$",
    "name a built-in metric, such as published/sigmoid, or published/angles-sigmoid",
)


def _require_built_in(name: str) -> str:
    if not is_built_in(name):
        raise ValueError(f"{name!r} is not the name of a built-in metric; `marey metric ls` lists them")
    return name


BuiltInMetric = Annotated[
    str, AfterValidator(_require_built_in), WithJsonSchema({"type": "string", "pattern": _BUILT_IN_PATTERN})
]
"""Name of a metric that needs no item, such as `published/sigmoid` or `published/positions-manhattan`.

`published/` uses the weights of Pražák et al. (2009), `uniform/` equal weights, c = 0 and N = 1. A name without a
measurement combines angles, positions and velocities in equal shares.
"""


class MetricComponent(Request):
    """Distance of poses by one measurement, and its share of the metric."""

    measurement: Measurement
    shaping: Shaping = Field(
        description="The function F of x, the difference of a joint class. euclid: x²; manhattan: x; sigmoid: x / (x "
        "+ 1); power: x^exponent."
    )
    exponent: float = Field(1.0, gt=0, le=10, allow_inf_nan=False, description="Exponent of the shaping `power`.")
    constant: _Amount = Field(description="The constant c, which is added to the distance of poses that differ.")
    norm: _Amount = Field(description="The factor N, by which the weighted mean of F is multiplied.")
    weights: dict[JointClass, _Amount] = Field(
        min_length=1,
        description="Weight of each joint class. The weights can have any sum, because they are divided by their sum.",
    )
    share: _Share = Field(description="Share of the component in the metric; the shares have the sum 1.")
    intervals: dict[JointClass, tuple[_Number, _Number]] = Field(
        default_factory=dict,
        description="95 % interval of each weight as a share of all weights, from bootstrap samples of the "
        "participants; empty: unknown.",
    )

    @model_validator(mode="after")
    def _check_classes(self) -> Self:
        if self.measurement == "angles" and (wrong := [name for name in WITHOUT_ANGLES if name in self.weights]):
            raise ValueError(
                f"weights: the measurement angles has no weight for the joint class {wrong[0]}; remove this weight"
            )
        if not sum(self.weights.values()) > 0:
            raise ValueError("weights: at least one weight must be above 0")
        return self


class MetricFit(Request):
    """Agreement of a fitted metric with the judgements that it was fitted to."""

    motions: int = Field(ge=3, description="Number of motions.")
    participants: int = Field(ge=1, description="Number of people who judged.")
    trials: int = Field(ge=1, description="Number of answered trials.")
    pairs: int = Field(ge=1, description="Number of pairs of motions with a known difference.")
    rmse: _Amount = Field(description="Root mean square of fitted minus perceived differences.")
    r2: _Number | None = Field(
        None, description="Share of the variance that the fit explains; null: the perceived differences do not vary."
    )
    spearman: _Number | None = Field(
        None,
        description="Spearman's rank correlation of fitted and perceived differences; null: one of them does not vary.",
    )
    noise_ceiling: _Amount | None = Field(
        None,
        description="Standard error of the perceived differences, which is due to chance. A fit with a smaller error "
        "describes noise. Null: unknown, because too few pairs were judged repeatedly.",
    )
    left_out_rmse: _Amount | None = Field(
        None,
        description="Root mean square error for motions that were left out of the fit, one motion at a time "
        "(cross-validation). Null: unknown.",
    )


class MetricDocument(Request):
    """Part `metric` of a metric: weights, conventions of the measurement, and origin."""

    schema_: Literal["marey/perceptual-metric@1"] = Field("marey/perceptual-metric@1", alias="schema")
    name: str = Field(min_length=1, max_length=300, description="Name that is shown to people.")
    origin: Literal["published", "uniform", "fitted"] = Field(
        description="published: the weights of Pražák et al. (2009); uniform: equal weights; fitted: weights "
        "fitted to the judgements of a study."
    )
    study: RevisionRef | OutputRef | None = Field(
        None, description="The study whose judgements a fitted metric comes from; absent for other metrics."
    )
    components: tuple[MetricComponent, ...] = Field(
        min_length=1, max_length=len(MEASUREMENTS), description="At most one component for each measurement."
    )
    angle: AngleMeasure = Field(
        "half_angle",
        description="Measure of angles. half_angle: arccos |q · p|; angle: twice as large; one_minus_dot: 1 - |q · p|; "
        "log_norm: norm of the logarithm of the rotation, equal to half_angle.",
    )
    side_reduce: Literal["mean", "sum"] = Field(
        "mean",
        description="Whether the difference of a joint class is the mean or the sum of the differences of "
        "the left and right joints.",
    )
    identity: Literal["zero", "constant"] = Field(
        "zero", description="Distance of equal poses. zero: 0; constant: c, the constant that each component adds."
    )
    root_alignment: Literal["mean_heading", "kovar2d"] = Field(
        "mean_heading",
        description="Method by which position and heading on the ground are removed. mean_heading: the hips are "
        "moved to the origin, and the mean heading of one second is removed; kovar2d: the two poses "
        "of each pair are superposed by the best rotation about the vertical and shift.",
    )
    length_unit_m: _Positive = Field(1.0, description="Metres in one unit of length.")
    velocity_interval_s: _Positive = Field(
        1.0 / 30.0, description="Seconds in one unit of time: velocities are displacements within this time."
    )
    frame_rate_hz: float = Field(
        METRIC_RATE_HZ, ge=1, le=1000, allow_inf_nan=False, description="Frame rate at which clips are measured."
    )
    code_version: str = Field(METRIC_CODE, max_length=64, description="Version of the computation of distances.")
    fit: MetricFit | None = Field(
        None, description="Agreement with the judgements; null if the metric was not fitted to judgements."
    )
    notes: tuple[Annotated[str, Field(max_length=1000)], ...] = Field(
        (), max_length=32, description="Remarks that people should know before they use the metric."
    )

    @model_validator(mode="after")
    def _check_components(self) -> Self:
        if len({one.measurement for one in self.components}) != len(self.components):
            raise ValueError("components: two components have the same measurement; keep one of them")
        total = sum(one.share for one in self.components)
        if abs(total - 1.0) > 1e-6:
            raise ValueError(f"components: the shares have the sum {total:g}; it must be 1")
        return self

    @property
    def judgement_error(self) -> float:
        """The standard error of the judgements behind the weights; `PUBLISHED_ERROR` if it is unknown."""
        known = None if self.fit is None else self.fit.noise_ceiling
        return PUBLISHED_ERROR if known is None else known

    def identity_digest(self) -> Digest:
        """Return the digest of everything that determines distances: two metrics with equal digests are the same."""
        without = {"schema_", "name", "origin", "study", "fit", "notes"}
        tree = self.model_dump(mode="json", exclude=without)
        for component in tree["components"]:
            del component["intervals"]
        return document_digest(tree)

    def stored(self) -> dict[str, Any]:
        """Return the document as JSON, in the form in which it is stored."""
        return self.model_dump(mode="json", by_alias=True)


class MetricIdentity(Request):
    """The metric of a result. Results can be compared only if their metrics have the same digest."""

    name: str = Field(max_length=300, description="Name that is shown to people.")
    digest: Digest = Field(description="Digest of everything that determines distances.")

    @classmethod
    def of(cls, metric: MetricDocument) -> MetricIdentity:
        """Return the identity (name and digest) of a metric."""
        return cls(name=metric.name, digest=metric.identity_digest())


def built_in_names() -> tuple[str, ...]:
    """Return the names of the built-in metrics, which no project has to store."""
    shapings = tuple(PUBLISHED["angles"])
    ways = [*shapings, *(f"{measurement}-{shaping}" for measurement in MEASUREMENTS for shaping in shapings)]
    return tuple(f"{origin}/{way}" for origin in ("published", "uniform") for way in ways)


def is_built_in(name: str) -> bool:
    """Return whether there is a built-in metric (which needs no item) with this name."""
    return re.fullmatch(_BUILT_IN_PATTERN, name) is not None


def built_in_metric(name: str) -> MetricDocument:
    """Return the built-in metric with this name. Raises `KeyError` if there is none."""
    found = re.fullmatch(_BUILT_IN_PATTERN, name)
    if found is None:
        raise KeyError(name)
    origin, measurement, printed = found.groups()
    measurements = [one for one in MEASUREMENTS if measurement in (None, one)]
    shaping = next(one for one in PUBLISHED["angles"] if one == printed)
    make = _published_component if origin == "published" else _uniform_component
    components = tuple(make(one, shaping, 1.0 / len(measurements)) for one in measurements)
    notes = _published_notes(components) if origin == "published" else ()
    stated = "published" if origin == "published" else "uniform"
    return MetricDocument(name=name, origin=stated, components=components, notes=notes)


def _published_component(measurement: Measurement, shaping: Shaping, share: float) -> MetricComponent:
    _, constant, norm, *weights = PUBLISHED[measurement][shaping]
    given = {name: weight for name, weight in zip(JOINT_CLASS_NAMES, weights, strict=True) if weight is not None}
    return MetricComponent(
        measurement=measurement, shaping=shaping, constant=constant or 0.0, norm=norm or 0.0, weights=given, share=share
    )


def classes_of(measurement: Measurement) -> tuple[str, ...]:
    """Return the joint classes that a measurement compares; angles leave out `hand` and `toe`."""
    return tuple(name for name in JOINT_CLASS_NAMES if measurement != "angles" or name not in WITHOUT_ANGLES)


def _published_notes(components: tuple[MetricComponent, ...]) -> tuple[str, ...]:
    notes = []
    for component in components:
        total = sum(component.weights.values())
        if abs(total - 1.0) > _MOST_ROUNDING:
            notes.append(
                f"The printed weights of {component.measurement} have the sum {total:.3f}; they are divided by it."
            )
        if component.measurement == "velocities":
            notes.append(_TEXT_AND_TABLE)
    return (*notes, _NO_SHARES) if len(components) > 1 else tuple(notes)


def _uniform_component(measurement: Measurement, shaping: Shaping, share: float) -> MetricComponent:
    weights = dict.fromkeys(classes_of(measurement), 1.0)
    given = {"measurement": measurement, "shaping": shaping, "constant": 0.0, "norm": 1.0}
    return MetricComponent.model_validate({**given, "weights": weights, "share": share})
