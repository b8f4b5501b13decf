"""Keyword arguments of methods of the SDK: parameters of jobs that make or measure clips and models.

Written by `make docs` from the declarations of the options; change them there.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal, TypedDict

from marey_schemas.queue.job_params import AlignParams, AnnotateParams, CutParams, ModelParams, TreeParams
from marey_schemas.queue.jobs import ItemInput


class AnnotateKeywords(TypedDict, total=False):
    """Keyword arguments, one for each field of `AnnotateParams`."""

    tags: list[str] | tuple[str, ...]
    """Tags that the results get."""
    layer: str | None
    """Name of the layer; default: the name of the method."""


class CutKeywords(TypedDict, total=False):
    """Keyword arguments, one for each field of `CutParams`."""

    tags: list[str] | tuple[str, ...]
    """Tags that the results get."""
    layer: str | None
    """Layer of the annotations to use; absent: all layers."""
    labels: list[str] | tuple[str, ...]
    """Labels of the segments to cut out; empty: all labels."""
    margin_before_s: float
    """Seconds before each segment that are also cut out, as far as the clip contains them."""
    margin_after_s: float
    """Seconds after each segment that are also cut out, as far as the clip contains them."""
    shortest_s: float
    """Shortest segment to cut out, in seconds."""
    longest_s: float | None
    """Longest segment to cut out, in seconds; absent: no limit."""
    name: str
    """Pattern of the pieces' names; {number:2} counts the segments of a label in a clip from 1, with two digits."""
    by_label: bool
    """Put the pieces of each label into a separate subfolder, which has the name of the label."""


class IndexKeywords(TypedDict, total=False):
    """Keyword arguments, one for each field of `IndexParams`."""

    name: str
    """Name of the index; an index with this name is replaced."""


class AlignKeywords(TypedDict, total=False):
    """Keyword arguments, one for each field of `AlignParams`."""

    tags: list[str] | tuple[str, ...]
    """Tags that the results get."""
    suffix: str
    """Text that is appended to the name of each input to form the name of its result."""
    cost: Literal["turned", "plain"]
    """Cost of a pair of poses. turned: the distance after the best rotation about the vertical and the best shift on
    the ground; plain: the distance without rotation and shift."""
    window: int
    """Number of frames in the window around a pose, an odd number. Two poses are compared by all frames of their
    windows; 1: by the poses alone."""
    reference: str
    """Clip whose time is the canonical time. medoid: the clip nearest to all others (of more than 200 clips, the clip
    of a random sample of 200 that is nearest to all others of the sample); nearest_mean_length: the clip whose length
    is nearest to the mean; or the id of a clip; commands and Python also accept the path of the clip."""
    rate_hz: float | None
    """Rate of the canonical frames, in hertz; absent: the frame rate of the reference if a clip is given as reference,
    else the most common frame rate of the clips."""
    slope_limit: int | None
    """Greatest number of consecutive steps of the alignment path that advance only one of the two clips. With the limit
    n, a frame is matched with at most n + 1 frames. null: no limit."""
    weights: Mapping[str, float]
    """Weight of each joint in the cost, by its own or its standard name; default 1, and 0 for joints that move no part
    of the body."""
    keep_height: bool
    """Keep the heights above the floor; false: the height of the body in the first frame is subtracted from all heights
    of a clip."""
    layer: str | None
    """Layer of the annotations to use; required if a clip has annotations of several layers."""
    labels: list[str] | tuple[str, ...]
    """Labels of the segments and keyframes at which clips are divided; empty: all."""
    mirroring: Literal["none", "add"]
    """Mirrored copies of the clips. none: only the clips themselves are aligned; add: each clip and its mirrored
    copy."""


class EditKeywords(TypedDict, total=False):
    """Keyword arguments, one for each field of `EditParams`."""

    tags: list[str] | tuple[str, ...]
    """Tags that the results get."""
    suffix: str
    """Text that is appended to the name of each input to form the name of its result."""
    in_place: bool
    """Make each result a new revision of its clip; otherwise each result is a new clip."""


class DistancesKeywords(TypedDict, total=False):
    """Keyword arguments, one for each field of `DistancesParams`."""

    cycles: Literal["cut", "whole"]
    """cut: cut a loop of one cycle out of each clip that is no loop, and compare the loops, as people saw them in the
    published experiment; whole: compare the clips from their first to their last frames."""
    loops: list[str] | tuple[str, ...]
    """Clips that are loops, in addition to those tagged `loop`."""
    title: str
    """Title of the report; default: the names of the clips."""
    report: bool
    """Write the report, a self-contained HTML page, and its figures."""


class QualityKeywords(TypedDict, total=False):
    """Keyword arguments, one for each field of `QualityParams`."""

    rate_hz: float
    """Frame rate in hertz at which clips are measured. Clips of a higher rate are resampled; clips of a lower rate are
    refused."""
    floor: Literal["planted", "zero"]
    """Reference from which the heights of feet are measured. planted: the height of the joint while the foot stands on
    the floor, which is the 5th percentile of the heights of the joint in the clip; zero: height 0, as in the
    publications of the measures. Penetration is always measured from height 0."""
    weighted_height_m: float
    """Height in metres from which the speed of a toe does not count in the measure `skate_weighted_m_s`; below, its
    weight grows from 0 to 1 at the floor."""
    near_height_m: float
    """Height in metres below which a toe counts as near the floor, in the measures `skate_height_m_s` and
    `skate_ratio`."""
    skate_speed_m_s: float
    """Speed in metres per second above which a toe near the floor counts as skating, in the measure `skate_ratio`."""
    contact_height_m: float
    """Height in metres below which a slow joint counts as touching the floor, in the measure `contact_consistency`."""
    contact_speed_m_s: float
    """Speed in metres per second below which a low joint counts as touching the floor, in the measure
    `contact_consistency`."""
    knee_least_deg: float
    """Smallest bend of a knee in its natural range, in degrees; negative: overextended. Smaller bends count in the
    measures `limit_excess_deg` and `limit_excess_max_deg`."""
    knee_most_deg: float
    """Greatest bend of a knee in its natural range, in degrees. Greater bends count in the measures `limit_excess_deg`
    and `limit_excess_max_deg`."""
    elbow_most_deg: float
    """Greatest bend of an elbow in its natural range, in degrees. Greater bends count in the measures
    `limit_excess_deg` and `limit_excess_max_deg`."""
    draws: int
    """Number of bootstrap samples of the takes, from which the confidence intervals are computed."""
    title: str
    """Title of the report; default: the number of clips."""
    report: bool
    """Write the report, a self-contained HTML page, and its figures."""


class ModelKeywords(TypedDict, total=False):
    """Keyword arguments, one for each field of `ModelParams`."""

    tags: list[str] | tuple[str, ...]
    """Tags that the results get."""
    criterion: Literal["held_out", "bic", "aic"]
    """Criterion that selects the mixture. held_out: the likelihood of examples of takes that were left out of the fit;
    bic, aic: an information criterion; a mixture of several normal distributions is rejected if left-out examples are
    no more likely under it than under a single one. Without cross-validation, bic replaces held_out."""
    covariance: Literal["full", "tied", "diagonal"] | None
    """Kind of covariance. full: one for each component, shrunk towards its diagonal; tied: one for all components;
    diagonal: one variance for each component and dimension; absent: the criterion selects it."""
    most_mixture_components: int
    """Greatest number of mixture components to try; n examples allow at most n / 5."""
    mixture_components: int | None
    """Exact number of mixture components; absent: the criterion selects it."""
    regularisation: float
    """Regularisation added to variances, as a share of the mean variance."""
    widening: float | None
    """Factor of the covariances for likelihoods, not for samples; absent: the least factor, 1 to 4, with which at most
    about 5% of the left-out examples are less likely than 95% of the mixture's samples."""
    starts: int
    """Number of starts of expectation maximisation; the best result is used."""
    folds: int
    """Number of folds of the cross-validation of likelihoods; all examples of a take are in the same fold. 0: no
    cross-validation."""
    scaling: Literal["jacobian", "root_max", "sfpca", "none"]
    """Weights of the channels. jacobian: by their effect on the body; sfpca: optimised for the positions of joints;
    root_max: root axes scaled to a maximum of 1; none: equal weights."""
    inner_product: Literal["coefficients", "l2"]
    """Inner product of spatial functions. coefficients: of their spline coefficients; l2: of the functions themselves,
    which does not depend on the knots."""
    spatial_share: float
    """Share of the variance that the spatial components explain."""
    spatial_components: int | None
    """Exact number of spatial components, instead of the share of the variance; absent: the share determines it."""
    spatial_coefficients: int | None
    """Number of coefficients of each channel's spline; absent: a fifth of the frames, at least 7."""
    temporal_share: float
    """Share of the variance that the temporal components explain."""
    most_temporal_components: int
    """Greatest number of temporal components."""
    temporal_coefficients: int
    """Number of coefficients of the spline of the temporal function (the time warp)."""
    temporal_weight: float | None
    """Weight of temporal scores in latent vectors; absent: temporal and spatial scores get equal variance."""
    leave_one_out: bool
    """Measure how well a model of the other examples reconstructs each example."""
    report_samples: int
    """Number of samples drawn to measure foot sliding and durations."""
    name: str
    """Name of the model, and also of the action that it generates."""
    report: bool
    """Write the report and its figures."""
    search_check: bool
    """For the report, test searches: leave out every fifth take, train a model on the other takes, and search for
    positions that the hands and feet reach in the left-out takes."""


class TreeKeywords(TypedDict, total=False):
    """Keyword arguments, one for each field of `TreeParams`."""

    samples: int
    """Number of samples drawn from the model."""
    branching: int
    """Greatest number of children of a node."""
    leaf_size: int
    """Greatest number of samples in a node that is not split."""
    depth: int
    """Greatest number of levels below the root."""
    features: Literal["end_effectors", "latent"]
    """Values by which samples are grouped. end_effectors: positions of hands, feet and head at the keyframes, the
    middle and the end; latent: the spatial scores."""


class AnalyseStudyKeywords(TypedDict, total=False):
    """Keyword arguments, one for each field of `AnalyseStudyParams`."""

    title: str
    """Title of the report; default: the title of the study."""
    report: bool
    """Write the report, a self-contained HTML page."""
    draws: int
    """Number of bootstrap samples of the participants, from which the intervals of the weights are computed."""


class ModelPlanKeywords(TypedDict, total=False):
    """Keyword arguments, one for each field of `ModelPlan`."""

    into: str
    """The collection of the model; everything else is stored below it."""
    skeleton: ItemInput | Mapping[str, Any] | None
    """The skeleton that the takes are retargeted to; absent: no retargeting."""
    annotate: AnnotateParams | Mapping[str, Any] | None
    """Parameters of the job that proposes annotations, if none are given."""
    cut: CutParams | Mapping[str, Any] | None
    """Parameters of the job that cuts out examples; absent: every take is an example."""
    align: AlignParams | AlignKeywords
    model: ModelParams | ModelKeywords
    tree: TreeParams | TreeKeywords | None
    """Parameters of the job that makes the tree; null: no tree."""
