"""Options of generative models: training, and grouping of samples in a tree."""

from __future__ import annotations

from typing import Annotated, Literal, get_args

from pydantic import Field

from marey_schemas.base import Options

Scaling = Literal["jacobian", "root_max", "sfpca", "none"]
InnerProduct = Literal["coefficients", "l2"]
DEFAULT_INNER_PRODUCT: InnerProduct = "coefficients"
Criterion = Literal["held_out", "bic", "aic"]
CovarianceKind = Literal["full", "tied", "diagonal"]
COVARIANCE_KINDS: tuple[CovarianceKind, ...] = get_args(CovarianceKind)
FeatureKind = Literal["end_effectors", "latent"]

MOST_TREE_SAMPLES = 100_000

_Share = Annotated[float, Field(ge=0.01, le=1, allow_inf_nan=False)]


class MixtureOptions(Options):
    """Options of the fit of a mixture of normal distributions to latent vectors."""

    criterion: Criterion = Field(
        "held_out",
        description="Criterion that selects the mixture. held_out: the likelihood of examples of takes that were left "
        "out of the fit; bic, aic: an information criterion; a mixture of several normal distributions is rejected "
        "if left-out examples are no more likely under it than under a single one. Without cross-validation, bic "
        "replaces held_out.",
    )
    covariance: CovarianceKind | None = Field(
        None,
        description="Kind of covariance. full: one for each component, shrunk towards its diagonal; tied: one for all "
        "components; diagonal: one variance for each component and dimension; absent: the criterion selects it.",
    )
    most_mixture_components: int = Field(
        10,
        ge=1,
        le=100,
        description="Greatest number of mixture components to try; n examples allow at most n / 5.",
    )
    mixture_components: int | None = Field(
        None, ge=1, le=100, description="Exact number of mixture components; absent: the criterion selects it."
    )
    regularisation: float = Field(
        1e-4,
        ge=1e-12,
        le=1,
        allow_inf_nan=False,
        description="Regularisation added to variances, as a share of the mean variance.",
    )
    widening: float | None = Field(
        None,
        ge=1,
        le=100,
        allow_inf_nan=False,
        description="Factor of the covariances for likelihoods, not for samples; absent: the least factor, 1 to 4, "
        "with which at most about 5% of the left-out examples are less likely than 95% of the mixture's samples.",
    )
    starts: int = Field(
        5, ge=1, le=100, description="Number of starts of expectation maximisation; the best result is used."
    )
    folds: int = Field(
        5,
        ge=0,
        le=100,
        description="Number of folds of the cross-validation of likelihoods; all examples "
        "of a take are in the same fold. 0: no cross-validation.",
    )


class ModelOptions(MixtureOptions):
    """Options of the training of a generative model."""

    scaling: Scaling = Field(
        "jacobian",
        description="Weights of the channels. jacobian: by their effect on the body; sfpca: optimised for "
        "the positions of joints; root_max: root axes scaled to a maximum of 1; none: equal "
        "weights.",
    )
    inner_product: InnerProduct = Field(
        DEFAULT_INNER_PRODUCT,
        description="Inner product of spatial functions. coefficients: of their spline coefficients; l2: of "
        "the functions themselves, which does not depend on the knots.",
    )
    spatial_share: _Share = Field(0.95, description="Share of the variance that the spatial components explain.")
    spatial_components: int | None = Field(
        None,
        ge=0,
        le=1000,
        description="Exact number of spatial components, instead of the share of the "
        "variance; absent: the share determines it.",
    )
    spatial_coefficients: int | None = Field(
        None,
        ge=4,
        le=10_000,
        description="Number of coefficients of each channel's spline; absent: a fifth of the frames, at least 7.",
    )
    temporal_share: _Share = Field(0.99, description="Share of the variance that the temporal components explain.")
    most_temporal_components: int = Field(3, ge=0, le=1000, description="Greatest number of temporal components.")
    temporal_coefficients: int = Field(
        8, ge=4, le=1000, description="Number of coefficients of the spline of the temporal function (the time warp)."
    )
    temporal_weight: float | None = Field(
        None,
        ge=1e-3,
        le=1e3,
        allow_inf_nan=False,
        description="Weight of temporal scores in latent vectors; absent: temporal and spatial scores get "
        "equal variance.",
    )
    leave_one_out: bool = Field(
        True, description="Measure how well a model of the other examples reconstructs each example."
    )
    report_samples: int = Field(
        200, ge=0, le=10_000, description="Number of samples drawn to measure foot sliding and durations."
    )


class TreeOptions(Options):
    """Options of a tree that groups samples of a model."""

    samples: int = Field(10_000, ge=1, le=MOST_TREE_SAMPLES, description="Number of samples drawn from the model.")
    branching: int = Field(4, ge=2, le=64, description="Greatest number of children of a node.")
    leaf_size: int = Field(
        1, ge=1, le=MOST_TREE_SAMPLES, description="Greatest number of samples in a node that is not split."
    )
    depth: int = Field(64, ge=1, le=64, description="Greatest number of levels below the root.")
    features: FeatureKind = Field(
        "end_effectors",
        description="Values by which samples are grouped. end_effectors: positions of hands, feet and head "
        "at the keyframes, the middle and the end; latent: the spatial scores.",
    )
