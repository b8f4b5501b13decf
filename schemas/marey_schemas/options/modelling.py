"""Options of generative models: how a model is trained, and how samples of it are grouped in a tree."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from marey_schemas.base import Options

Scaling = Literal["jacobian", "root_max", "sfpca", "none"]
InnerProduct = Literal["coefficients", "l2"]
Criterion = Literal["bic", "aic"]
FeatureKind = Literal["end_effectors", "latent"]

MOST_TREE_SAMPLES = 100_000

_Share = Annotated[float, Field(ge=0.01, le=1, allow_inf_nan=False)]


class MixtureOptions(Options):
    """Fit of a mixture of normal distributions to latent vectors."""

    criterion: Criterion = Field("bic", description="Criterion that chooses the number of mixture components.")
    most_mixture_components: int = Field(
        10,
        ge=1,
        le=100,
        description="Greatest number of mixture components tried; n examples in d dimensions allow at most n / 2d.",
    )
    mixture_components: int | None = Field(
        None, ge=1, le=100, description="Exact number of mixture components; absent: the criterion chooses."
    )
    regularisation: float = Field(
        1e-4, ge=1e-12, le=1, allow_inf_nan=False, description="Added to variances, as a share of the mean variance."
    )
    starts: int = Field(
        5, ge=1, le=100, description="Number of starts of expectation maximisation; the best one counts."
    )
    folds: int = Field(
        5, ge=0, le=100, description="Number of parts held out in turn to measure likelihoods; 0: none is."
    )


class ModelOptions(MixtureOptions):
    """Training of a model."""

    scaling: Scaling = Field(
        "jacobian",
        description="Weights of the channels. jacobian: by how far they move the body; sfpca: optimised for the "
        "positions of joints; root_max: root axes to a maximum of 1; none: all the same.",
    )
    inner_product: InnerProduct = Field(
        "coefficients",
        description="Inner product of spatial functions. coefficients: of their spline coefficients; l2: integrals of "
        "products of functions, which do not depend on the knots.",
    )
    spatial_share: _Share = Field(0.95, description="Share of the variance that the spatial components hold.")
    spatial_components: int | None = Field(
        None, ge=0, le=1000, description="Exact number of spatial components, in place of the share."
    )
    spatial_coefficients: int | None = Field(
        None,
        ge=4,
        le=10_000,
        description="Number of coefficients of each channel's spline; absent: a fifth of the frames, at least 7.",
    )
    temporal_share: _Share = Field(0.99, description="Share of the variance that the time components hold.")
    most_temporal_components: int = Field(3, ge=0, le=1000, description="Greatest number of time components.")
    temporal_coefficients: int = Field(
        8, ge=4, le=1000, description="Number of coefficients of the time function's spline."
    )
    temporal_weight: float | None = Field(
        None,
        ge=1e-3,
        le=1e3,
        allow_inf_nan=False,
        description="Weight of time scores in latent vectors; absent: time gets the variance of space.",
    )
    leave_one_out: bool = Field(True, description="Measure how well each example is reconstructed by the others.")
    report_samples: int = Field(
        200, ge=0, le=10_000, description="Number of samples drawn to measure feet and durations."
    )


class TreeOptions(Options):
    """Tree in which samples of a model are grouped."""

    samples: int = Field(10_000, ge=1, le=MOST_TREE_SAMPLES, description="Number of samples drawn from the model.")
    branching: int = Field(4, ge=2, le=64, description="Greatest number of children of a node.")
    leaf_size: int = Field(1, ge=1, le=MOST_TREE_SAMPLES, description="Nodes of at most so many samples are not split.")
    depth: int = Field(64, ge=1, le=64, description="Greatest number of levels below the root.")
    features: FeatureKind = Field(
        "end_effectors",
        description="What is grouped. end_effectors: where hands, feet and head are at the keyframes, the middle and "
        "the end; latent: the spatial scores.",
    )
