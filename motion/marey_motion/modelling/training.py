"""Training of a motion primitive on aligned examples, with a report of its quality."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from marey_motion.alignment.aligned import AlignedSet
from marey_motion.alignment.signs import consistent_poses
from marey_motion.arrays import Floats
from marey_motion.errors import ModelError
from marey_motion.modelling.example_groups import ExampleGroups
from marey_motion.modelling.fpca import Keep, PrincipalExamples, find_components
from marey_motion.modelling.mixture_fitting import FittedMixture, fit_mixture, one_thread
from marey_motion.modelling.primitive import MOST_LOG_SLOPE, MotionPrimitive
from marey_motion.modelling.scaled_fpca import optimised_weights
from marey_motion.modelling.scaling import jacobian_weights, root_max_weights
from marey_motion.modelling.splines import SplineBasis, coefficient_count
from marey_motion.modelling.time_model import equalising_weight, fit_log_slopes
from marey_motion.modelling.training_report import TrainingReport, report_on
from marey_motion.modelling.training_warnings import ModelWarning, warnings_of
from marey_schemas.options.modelling import ModelOptions

Progress = Callable[[int, int | None, str], None]

MOST_EXAMPLES = 5000
LEAST_FRAMES = 5
DURATION_MARGIN = 0.2
LOG_SLOPE_MARGIN = 0.05


@dataclass(frozen=True, eq=False)
class TrainedPrimitive:
    """Model with its report and warnings.

    Parameters
    ----------
    weights : (3 + 4·J,) factors by which channels were multiplied in the analysis; the primitive itself is in the
        original units
    """

    primitive: MotionPrimitive
    report: TrainingReport
    warnings: tuple[ModelWarning, ...]
    options: ModelOptions
    weights: Floats


@dataclass(frozen=True, eq=False)
class FittedExamples:
    """Examples prepared for the model: poses (quaternions with consistent signs), spatial and temporal components."""

    poses: Floats
    spatial: PrincipalExamples
    temporal: PrincipalExamples
    weights: Floats


def _silent(_done: int, _total: int | None, _doing: str) -> None:
    """Ignore a report of progress."""


def train_primitive(
    aligned: AlignedSet,
    options: ModelOptions = ModelOptions(),  # noqa: B008 - frozen
    *,
    name: str = "primitive",
    seed: int = 0,
    threads: int = 1,
    progress: Progress = _silent,
) -> TrainedPrimitive:
    """Train a generative model of aligned examples (Herrmann et al. 2019, section 3).

    The model consists of splines, their principal components, and a mixture of normal distributions.

    Parameters
    ----------
    aligned : AlignedSet    m examples of N frames
    options : ModelOptions    options of the training
    name : str    name of the action
    seed : int    seed of the mixture's starts, the folds and the samples of the report
    threads : int    threads for leave-one-out reconstructions; the result does not depend on their number
    progress : callable    called as progress(steps done, total where known, name of the step)

    Returns
    -------
    TrainedPrimitive    model, report and warnings

    Raises
    ------
    ModelError    if no model can be trained on the examples
    """
    check_examples(aligned)
    with one_thread():
        progress(0, None, "fitting splines")
        fitted = fit_examples(aligned, options)
        weight = options.temporal_weight or equalising_weight(
            fitted.spatial.functions.variances, fitted.temporal.functions.variances
        )
        latents = np.concatenate((_kept_scores(fitted.spatial), weight * _kept_scores(fitted.temporal)), axis=1)
        progress(0, None, "fitting the mixture")
        groups = ExampleGroups.of(aligned)
        mixture = fit_mixture(latents, options, groups=groups, seed=seed)
        primitive = _assemble(name, aligned, fitted, weight, mixture)
        report = report_on(primitive, aligned, fitted.poses, fitted.spatial, fitted.temporal, latents, mixture, groups,
                           options, seed=seed, threads=threads, progress=progress)  # fmt: skip
    return TrainedPrimitive(primitive, report, warnings_of(primitive, report, options), options, fitted.weights)


def check_examples(aligned: AlignedSet) -> None:
    """Check that a model can be trained on examples.

    There must be enough examples and canonical frames. In each example, all numbers must be finite, only rotations of
    joints may vary, and the time function must be strictly increasing.

    Parameters
    ----------
    aligned : AlignedSet    the examples

    Raises
    ------
    ModelError    if a condition is not met; for a condition on each example, the error names the first invalid example
    """
    if not 1 <= len(aligned.clips) <= MOST_EXAMPLES:
        raise ModelError(
            f"there are {len(aligned.clips)} examples; a model needs 1 to {MOST_EXAMPLES:,}", code="example-count"
        )
    frames = aligned.frame_count
    if frames < LEAST_FRAMES:
        raise ModelError(
            f"the examples have {frames} canonical frames; at least {LEAST_FRAMES} are needed", code="too-few-frames"
        )
    shape = (frames, aligned.skeleton.joint_count, 4)
    for clip in aligned.clips:
        motion = clip.motion
        if motion.rotations.shape != shape or clip.time_function.shape != (frames,):
            raise ModelError(
                f"the example has {motion.frame_count} frames, {motion.rotations.shape[1]} joints and a time function "
                f"of {len(clip.time_function)} frames, but the set has {frames} frames and {shape[1]} joints; align "
                "all examples together",
                where=clip.name,
            )
        if motion.translated_joints:
            joint = aligned.skeleton.joint_names[motion.translated_joints[0]]
            raise ModelError(
                f"the joint {joint} moves relative to its parent, but a model contains only rotations of "
                "joints; retarget the clips to a skeleton whose bones have a fixed length",
                code="translated-joints",
                where=clip.name,
            )
        if not (np.isfinite(motion.poses).all() and np.isfinite(clip.time_function).all()):
            raise ModelError("the example contains numbers that are not finite (infinite or NaN)", where=clip.name)
        if not (np.diff(clip.time_function) > 0.0).all():
            raise ModelError("the time function is not strictly increasing; align the examples again", where=clip.name)


def fit_examples(aligned: AlignedSet, options: ModelOptions) -> FittedExamples:
    """Compute the functional components of the poses (spatial) and of the time functions (temporal).

    Parameters
    ----------
    aligned : AlignedSet    the examples
    options : ModelOptions    options of the training

    Returns
    -------
    FittedExamples    poses, components and weights
    """
    frames = aligned.frame_count
    # The reference itself may be among the examples that somebody left out.
    reference = next((clip for clip in aligned.clips if clip.uid == aligned.reference), aligned.clips[0])
    poses = consistent_poses(aligned.poses, reference.motion.poses)
    wanted = options.spatial_coefficients or coefficient_count(frames)
    basis = SplineBasis.clamped(frames, min(wanted, frames))
    coefficients = basis.fit(poses)
    keep = Keep(share=options.spatial_share, count=options.spatial_components)
    weights, keep = channel_weights(aligned, basis, poses, coefficients, keep, options)
    spatial = find_components(basis, coefficients, weights, keep, options.inner_product)
    steps = SplineBasis.clamped(frames - 1, min(options.temporal_coefficients, frames - 1))
    temporal = find_components(
        steps,
        fit_log_slopes(steps, aligned.time_functions),
        np.ones(1),
        Keep(share=options.temporal_share, most=options.most_temporal_components),
        # Coefficients at the ends carry little of the time but vary most; as functions, few components tell durations.
        "l2",
    )
    return FittedExamples(poses, spatial, temporal, weights)


def channel_weights(
    aligned: AlignedSet, basis: SplineBasis, poses: Floats, coefficients: Floats, keep: Keep, options: ModelOptions
) -> tuple[Floats, Keep]:
    """Compute the weights of the chosen scaling, and the number of components to keep.

    Parameters
    ----------
    aligned : AlignedSet    the examples
    basis : SplineBasis    splines with n coefficients
    poses : (m, N, D) float64    poses of D = 3 + 4·J channels; their quaternions have consistent signs
    coefficients : (m, n, D) float64    coefficients of the poses
    keep : Keep    number of components
    options : ModelOptions    options of the training

    Returns
    -------
    weights : (D,) float64    positive
    keep : Keep    number of components under these weights
    """
    if options.scaling == "none":
        return np.ones(poses.shape[2]), keep
    if options.scaling == "root_max":
        return root_max_weights(poses), keep
    jacobian = jacobian_weights(aligned.skeleton, basis.at_frames @ coefficients.mean(axis=0))
    if options.scaling == "jacobian":
        return jacobian, keep
    starts = (jacobian, root_max_weights(poses), np.ones(poses.shape[2]))
    return optimised_weights(aligned.skeleton, basis, coefficients, starts, keep, options.inner_product)


def _kept_scores(principal: PrincipalExamples) -> Floats:
    return principal.scores[:, : principal.functions.count]


def _assemble(
    name: str, aligned: AlignedSet, fitted: FittedExamples, weight: float, mixture: FittedMixture
) -> MotionPrimitive:
    return MotionPrimitive(
        name=name,
        skeleton=aligned.skeleton,
        frame_rate_hz=aligned.frame_rate_hz,
        spatial=fitted.spatial.functions,
        temporal=fitted.temporal.functions,
        temporal_weight=weight,
        mixture=mixture.mixture,
        keyframes=dict(aligned.keyframes),
        duration_range_s=_sampled_range(aligned),
        log_slope_range=_log_slope_range(aligned, fitted.temporal),
        widening=mixture.widening,
    )


def _sampled_range(aligned: AlignedSet) -> tuple[float, float]:
    """Compute the shortest and the longest duration of samples in seconds.

    The range is that of the examples, extended by a fifth at both ends.
    """
    durations = aligned.time_functions[:, -1] / aligned.frame_rate_hz
    return float(durations.min()) * (1.0 - DURATION_MARGIN), float(durations.max()) * (1.0 + DURATION_MARGIN)


def _log_slope_range(aligned: AlignedSet, temporal: PrincipalExamples) -> tuple[float, float]:
    """Compute the least and the greatest logarithm of a time step in motions of the model.

    A time step is the number of real frames from one canonical frame to the next. The range contains the time steps of
    the examples, and of the examples rebuilt from the kept components. It is extended by `LOG_SLOPE_MARGIN` at both
    ends, but never beyond ±`MOST_LOG_SLOPE`.
    """
    functions = temporal.functions
    rebuilt = functions.basis.at_frames @ functions.coefficients(_kept_scores(temporal))[..., 0].T
    given = np.log(np.diff(aligned.time_functions, axis=1))
    least = min(float(rebuilt.min()), float(given.min())) - LOG_SLOPE_MARGIN
    most = max(float(rebuilt.max()), float(given.max())) + LOG_SLOPE_MARGIN
    return max(least, -MOST_LOG_SLOPE), min(most, MOST_LOG_SLOPE)
