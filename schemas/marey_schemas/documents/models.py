"""Generative models of motion: part `model` of an item of the kind `model`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict, Field, ValidationError, model_validator

from marey_schemas.base import Request
from marey_schemas.documents.originals import StoredOriginal, content_digest
from marey_schemas.documents.references import OutputRef, RevisionRef
from marey_schemas.encoding.arrays import ArrayOf
from marey_schemas.names import Digest, ItemName, JointName

MOST_JOINTS = 4096
MOST_KEYFRAMES = 1000
MOST_CANONICAL_FRAMES = 10_000
MOST_BASIS_NUMBERS = 20_000_000
"""Greatest size of the matrix of basis functions kept in memory: canonical frames times spline coefficients."""
MOST_SAMPLES = 1000
Vector = Annotated[NDArray[np.float64], ArrayOf("<f8", ndim=1)]
Matrix = Annotated[NDArray[np.float64], ArrayOf("<f8", ndim=2)]
Stack = Annotated[NDArray[np.float64], ArrayOf("<f8", ndim=3)]


class FunctionalComponentsDocument(Request):
    """Functions of canonical time with D channels: a mean and k principal components, as splines of n coefficients."""

    degree: int = Field(3, ge=0, le=9)
    knots: Vector = Field(description="[n + degree + 1] knots of the splines, in canonical frames.")
    mean: Matrix = Field(description="[n, D] coefficients of the mean.")
    directions: Stack = Field(description="[k, n, D] change of the coefficients per unit of each score.")
    projections: Stack = Field(
        description="[k, n, D]: each score is the inner product of one matrix [n, D] with the coefficients after "
        "subtraction of their mean."
    )
    variances: Vector = Field(description="[k] variances of the examples' scores.")
    energy: Vector = Field(description="[k] share of the variance that the first 1, 2, ... components explain.")

    @model_validator(mode="after")
    def _check_shapes(self) -> Self:
        n, channels = self.mean.shape
        if len(self.knots) != n + self.degree + 1:
            raise ValueError(
                f"knots: there are {len(self.knots)}, but {n} spline coefficients need {n + self.degree + 1}"
            )
        count = len(self.directions)
        for name in ("directions", "projections"):
            if getattr(self, name).shape != (count, n, channels):
                raise ValueError(
                    f"{name}: the array has the shape {getattr(self, name).shape}, but must have {(count, n, channels)}"
                )
        for name in ("variances", "energy"):
            if getattr(self, name).shape != (count,):
                raise ValueError(
                    f"{name}: there are {len(getattr(self, name))} values for {count} components; each "
                    "component needs one"
                )
        frames = float(self.knots[-self.degree - 1] - self.knots[self.degree]) + 1.0
        if not (frames <= MOST_CANONICAL_FRAMES and frames * n <= MOST_BASIS_NUMBERS):
            raise ValueError(
                f"knots: the spline has {frames:g} canonical frames and {n} coefficients; at most "
                f"{MOST_CANONICAL_FRAMES} frames are accepted, and frames times coefficients may be at most "
                f"{MOST_BASIS_NUMBERS:,}"
            )
        return self


class MixtureDocument(Request):
    """K normal distributions over latent vectors of L numbers."""

    weights: Vector = Field(description="[K] positive weights with a sum of 1.")
    means: Matrix = Field(description="[K, L] means of the distributions.")
    covariances: Stack = Field(description="[K, L, L] symmetric, positive definite covariance matrices.")

    @model_validator(mode="after")
    def _check_shapes(self) -> Self:
        count, dimensions = self.means.shape
        if count < 1 or self.weights.shape != (count,):
            raise ValueError(f"weights: there are {len(self.weights)} weights for {count} means; each mean needs one")
        if self.covariances.shape != (count, dimensions, dimensions):
            expected = (count, dimensions, dimensions)
            raise ValueError(f"covariances: the array has the shape {self.covariances.shape}, but must have {expected}")
        if not (self.weights > 0).all() or abs(float(self.weights.sum()) - 1.0) > 1e-6:
            raise ValueError("weights: must be positive and add up to 1")
        return self


class Noted(Request):
    """Base of documents about the origin and the training of a model; they may also have undeclared members."""

    model_config = ConfigDict(extra="allow")


class PredecessorTimeDocument(Request):
    """Time function of a model as the imported file contains it; it depends on k temporal scores of a latent vector.

    Marey's own form of time functions is less general, so that `temporal` only approximates some time functions.
    """

    form: Literal["coefficients", "increments"] = Field(
        description="coefficients: the spline coefficients are cumsum(exp(mean + g·eigen)) - 1. increments: the "
        "exponential of the spline is the number of frames that pass in each step."
    )
    knots: Vector
    degree: int = Field(ge=1, lt=10)
    mean: Vector = Field(description="[n] mean coefficients.")
    eigen: Matrix = Field(description="[k, n] change of the coefficients per unit of each score.")
    content: Digest = Field(description="Digest of the members of the model that were converted from this function.")


class PredecessorOrigin(Noted):
    """Origin of a model that was imported from Marey's predecessor."""

    animated_joints: tuple[JointName, ...] = Field(
        (), max_length=MOST_JOINTS, description="Joints that the model animates."
    )
    original: StoredOriginal | None = Field(None, description="The imported file of the model.")
    tree: StoredOriginal | None = Field(None, description="The imported file of the model's tree.")
    time: PredecessorTimeDocument | None = Field(None, description="The imported time function.")


class ModelProvenance(Noted):
    """Motions that a model was trained on, and their origin."""

    predecessor: PredecessorOrigin | None = None


class ExampleNotes(Noted):
    """Likelihood and error of one example under a model."""

    log_likelihood: float | None = Field(
        None, allow_inf_nan=False, description="Natural logarithm of the model's density at the example."
    )


class TrainingNotes(Noted):
    """Measured quality of a model: likelihood and error of each training example, and further numbers."""

    examples: tuple[ExampleNotes, ...] = Field((), description="One entry for each training example.")


class MotionPrimitiveDocument(Request):
    """Part `model`: a generative model of one action.

    A latent vector contains the scores of the spatial components, then `temporal_weight` times the scores of the
    temporal components. The value of the spatial functions at a canonical frame is the root translation (m) and local
    quaternions, which must be normalised. The value of the temporal function is ln(dt), where dt is the number of
    frames of real time that pass in one canonical step.
    """

    schema_: Literal["marey/motion-primitive@1"] = Field("marey/motion-primitive@1", alias="schema")
    name: ItemName = Field(description="Name of the action that the model generates.")
    verdict: str = Field("", max_length=2000, description="Assessment of the model in one or two sentences.")
    headline: dict[str, float | int | str | None] = Field(
        default_factory=dict,
        max_length=64,
        description="Headline numbers by name, which lists of items show; null: not defined.",
    )
    skeleton: RevisionRef | OutputRef
    joints: tuple[JointName, ...] = Field(
        min_length=1, max_length=MOST_JOINTS, description="Names of the joints, in the order of their rotations."
    )
    frame_rate_hz: float = Field(
        gt=0, le=100_000, allow_inf_nan=False, description="Rate of the canonical frames, in hertz."
    )
    spatial: FunctionalComponentsDocument
    temporal: FunctionalComponentsDocument
    temporal_weight: float = Field(gt=0, allow_inf_nan=False)
    mixture: MixtureDocument
    keyframes: dict[str, Annotated[int, Field(ge=0)]] = Field(
        default_factory=dict, max_length=MOST_KEYFRAMES, description="Canonical frame of each keyframe, by label."
    )
    duration_range_s: tuple[float, float] | None = Field(
        None, description="Shortest and longest duration of a sample, in seconds; absent: not limited."
    )
    log_slope_range: tuple[float, float] | None = Field(
        None,
        description="Lower and upper limit of the temporal function of samples: the range of the examples, "
        "slightly widened. Absent: only a general limit applies.",
    )
    widening: float = Field(
        1.0,
        ge=1,
        allow_inf_nan=False,
        description="Factor of the covariances of `mixture` for likelihoods, so that about 5% of unseen motions are "
        "less likely than 95% of the widened mixture; samples are drawn from the mixture itself.",
    )
    scaling: dict[str, Any] | None = Field(
        None,
        description="Method and weights of the channels during training; the functions in this document are "
        "unweighted.",
    )
    options: dict[str, Any] | None = Field(None, description="Options of the training; absent: unknown.")
    provenance: ModelProvenance = Field(
        default_factory=ModelProvenance, description="The training examples and their origin."
    )
    training: TrainingNotes | None = Field(None, description="Measured quality of the model; absent: not measured.")

    @model_validator(mode="after")
    def _check_shapes(self) -> Self:
        width = 3 + 4 * len(self.joints)
        if self.spatial.mean.shape[1] != width:
            raise ValueError(
                f"spatial: the mean has {self.spatial.mean.shape[1]} channels, but the joints need {width}"
            )
        if self.temporal.mean.shape[1] != 1:
            raise ValueError(f"temporal: the mean has {self.temporal.mean.shape[1]} channels, but must have 1")
        if self.duration_range_s is not None and not self.duration_range_s[0] <= self.duration_range_s[1]:
            raise ValueError("duration_range_s: the second number must not be less than the first")
        dimensions = len(self.spatial.directions) + len(self.temporal.directions)
        if self.mixture.means.shape[1] != dimensions:
            raise ValueError(
                f"mixture: the means have {self.mixture.means.shape[1]} dimensions, but the model has "
                f"{dimensions} components; the two numbers must be equal"
            )
        if self.log_slope_range is not None and not self.log_slope_range[0] <= self.log_slope_range[1]:
            raise ValueError("log_slope_range: the second number must not be less than the first")
        return self


def checked_model(part: Mapping[str, Any]) -> MotionPrimitiveDocument:
    """Validate a part `model` and return it without provenance and training, whose form differs in older documents."""
    return MotionPrimitiveDocument.model_validate({**part, "provenance": {}, "training": None})


def predecessor_origin(model: Mapping[str, Any]) -> PredecessorOrigin:
    """Return the origin of a model imported from Marey's predecessor, from its part `model`; empty if not recorded.

    The time function is left out, so that the arrays of the part may be references.
    """
    try:
        provenance = ModelProvenance.model_validate(_without_time(model.get("provenance", {})))
    except ValidationError:
        return PredecessorOrigin()
    return provenance.predecessor or PredecessorOrigin()


def _without_time(provenance: Any) -> Any:
    if not (isinstance(provenance, Mapping) and isinstance(provenance.get("predecessor"), Mapping)):
        return provenance
    return {**provenance, "predecessor": {**provenance["predecessor"], "time": None}}


def predecessor_time(model: Mapping[str, Any]) -> PredecessorTimeDocument | None:
    """Return the time function of a model as it was imported from Marey's predecessor.

    Return None if no time function was recorded, or if the time function of the part `model` was changed since the
    import.
    """
    try:
        origin = ModelProvenance.model_validate(model.get("provenance", {})).predecessor
    except ValidationError:
        return None
    time = None if origin is None else origin.time
    return time if time is not None and time.content == content_digest("time", model) else None


def log_likelihoods(model: Mapping[str, Any]) -> tuple[float, ...]:
    """Return the log-likelihoods of the examples from a part `model`; empty if an older document has another form."""
    try:
        examples = TrainingNotes.model_validate(model.get("training") or {}).examples
    except ValidationError:
        return ()
    return tuple(one.log_likelihood for one in examples if one.log_likelihood is not None)
