"""Quality of a trained model: the variance it explains, its errors, and its samples."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from marey_motion.alignment.aligned import AlignedSet
from marey_motion.arrays import Floats
from marey_motion.importing.landmarks import find_landmarks
from marey_motion.modelling.example_groups import ExampleGroups
from marey_motion.modelling.fpca import PrincipalExamples
from marey_motion.modelling.mixture_fitting import FittedMixture, MixtureCandidate
from marey_motion.modelling.primitive import MotionPrimitive
from marey_motion.modelling.reconstruction import ReconstructionErrors, reconstruction_errors
from marey_motion.modelling.sample_comparison import SampleComparison, compare_samples
from marey_motion.modelling.sample_quality import FootQuality, foot_quality, joint_positions, standing_steps
from marey_schemas.options.modelling import ModelOptions

Progress = Callable[[int, int | None, str], None]

MORE_COMPONENTS_SHOWN = 10
OUTLIER_DEVIATIONS = 5.0
"""Number of robust standard deviations below the median at which an example's likelihood makes it an outlier."""

DEVIATION_OF_MEDIAN = 1.4826
DURATION_SLACK = 0.05


@dataclass(frozen=True)
class ExampleReport:
    """Errors and likelihood of one example in the model.

    Parameters
    ----------
    log_likelihood : natural logarithm of the density of the example
    held_out_log_likelihood : log-likelihood of the example under a mixture fitted without the fold (a part of the
        takes) that contains the example's take; None if it was not computed
    left_out_error_cm : mean distance of the joints from their reconstruction by components of the other takes, with as
        many components as the model has. None if it was not computed, or if all examples come from one take
    outlier : whether the likelihood of the example is much lower than that of the other examples
    """

    uid: str
    name: str
    log_likelihood: float
    held_out_log_likelihood: float | None
    left_out_error_cm: float | None
    duration_s: float
    alignment_cost: float
    outlier: bool


@dataclass(frozen=True)
class Durations:
    """Shortest, mean and longest duration of the examples or of samples, in seconds.

    `outside_share` is the share of these motions that are more than 5 % shorter than the shortest example or more than
    5 % longer than the longest example.
    """

    least_s: float
    mean_s: float
    most_s: float
    outside_share: float


@dataclass(frozen=True, eq=False)
class TrainingReport:
    """Quality of a model.

    Parameters
    ----------
    spatial_energy, temporal_energy : cumulative share of the variance, over all components of the examples
    takes, subjects : number of takes and of performers; 0 performers if they are unknown or fewer than three
    mixture_covariance : kind of covariance: "full", "tied", "diagonal", or "point" for examples that do not vary
    candidates : mixtures compared, with their criteria
    log_likelihood : mean log-likelihood of the examples
    held_out_log_likelihood : mean of the examples' `held_out_log_likelihood`; None if it was not computed
    held_out_low_share : share of the examples that are less likely, under a mixture fitted without their takes, than
        95 % of the samples of this mixture; None if it was not computed
    held_out_subject_log_likelihood, held_out_subject_low_share : mean log-likelihood and share as above, but under
        mixtures fitted without the performer of the example; None if fewer than three performers are known
    examples : reports of the examples, in the order of the aligned set
    time_error_frames : root mean square difference between the examples' time functions and those rebuilt by the model
    """

    spatial_energy: Floats
    temporal_energy: Floats
    takes: int
    subjects: int
    mixture_covariance: str
    candidates: tuple[MixtureCandidate, ...]
    log_likelihood: float
    held_out_log_likelihood: float | None
    held_out_low_share: float | None
    held_out_subject_log_likelihood: float | None
    held_out_subject_low_share: float | None
    examples: tuple[ExampleReport, ...]
    reconstruction: ReconstructionErrors | None
    time_error_frames: float
    training_durations: Durations
    sample_durations: Durations | None
    training_feet: FootQuality | None
    sample_feet: FootQuality | None
    comparison: SampleComparison | None


def report_on(
    primitive: MotionPrimitive,
    aligned: AlignedSet,
    poses: Floats,
    spatial: PrincipalExamples,
    temporal: PrincipalExamples,
    latents: Floats,
    fitted: FittedMixture,
    groups: ExampleGroups,
    options: ModelOptions,
    *,
    seed: int,
    threads: int,
    progress: Progress,
) -> TrainingReport:
    """Measure a model against its examples.

    Parameters
    ----------
    primitive : MotionPrimitive    the model
    aligned : AlignedSet    m examples
    poses : (m, N, 3 + 4·J) float64    poses of the examples; their quaternions have consistent signs
    spatial, temporal : PrincipalExamples    all components of the examples, also those that the model does not keep
    latents : (m, L) float64    latent vectors of the examples
    fitted : FittedMixture    mixture and candidates
    groups : ExampleGroups    takes and performers of the examples
    options : ModelOptions    options of the training
    seed : int    seed of the samples that are drawn from the model
    threads : int    number of threads for the leave-one-out reconstructions
    progress : callable    called as progress(steps done, total where known, name of the step)

    Returns
    -------
    TrainingReport    the measures
    """
    densities = primitive.log_density(latents)
    held_out, of_others = fitted.held_out, fitted.held_out_subjects
    errors = None
    if options.leave_one_out:
        most = primitive.spatial.count + MORE_COMPONENTS_SHOWN
        errors = reconstruction_errors(
            primitive.skeleton, spatial, poses, most, groups=groups, threads=threads, progress=progress
        )
    progress(0, None, "drawing samples")
    durations = aligned.time_functions[:, -1] / aligned.frame_rate_hz
    span = (float(durations.min()), float(durations.max()))
    sampled = primitive.sample(options.report_samples, seed) if options.report_samples else None
    feet, sample_feet = _feet(primitive, aligned, poses, sampled)
    time_error = primitive.time_functions(latents) - aligned.time_functions
    return TrainingReport(
        spatial_energy=spatial.energy,
        temporal_energy=temporal.energy,
        takes=groups.take_count,
        subjects=groups.subject_count,
        mixture_covariance=fitted.covariance,
        candidates=fitted.candidates,
        log_likelihood=float(densities.mean()),
        held_out_log_likelihood=None if held_out is None else float(held_out.log_likelihoods.mean()),
        held_out_low_share=None if held_out is None else held_out.low_share,
        held_out_subject_log_likelihood=None if of_others is None else float(of_others.log_likelihoods.mean()),
        held_out_subject_low_share=None if of_others is None else of_others.low_share,
        examples=_examples(
            primitive, aligned, densities, None if held_out is None else held_out.log_likelihoods, errors, durations
        ),
        reconstruction=errors,
        time_error_frames=float(np.sqrt((time_error**2).mean())),
        training_durations=_durations(durations, span),
        sample_durations=None if sampled is None else _durations(primitive.durations_s(sampled), span),
        training_feet=feet,
        sample_feet=sample_feet,
        comparison=None if sampled is None else compare_samples(primitive, poses, durations, groups.takes, sampled),
    )


def _examples(
    primitive: MotionPrimitive,
    aligned: AlignedSet,
    densities: Floats,
    held_out: Floats | None,
    errors: ReconstructionErrors | None,
    durations: Floats,
) -> tuple[ExampleReport, ...]:
    judged = densities if held_out is None else held_out
    middle = np.median(judged)
    spread = DEVIATION_OF_MEDIAN * np.median(np.abs(judged - middle))
    outlying = judged < middle - OUTLIER_DEVIATIONS * spread if spread > 0.0 else np.zeros(len(judged), dtype=bool)
    kept = primitive.spatial.count
    left_out = (
        None if errors is None or errors.left_out_each_cm is None else errors.left_out_each_cm[:, _at(errors, kept)]
    )
    return tuple(
        ExampleReport(
            uid=clip.uid,
            name=clip.name,
            log_likelihood=float(densities[index]),
            held_out_log_likelihood=None if held_out is None else float(held_out[index]),
            left_out_error_cm=None if left_out is None else float(left_out[index]),
            duration_s=float(durations[index]),
            alignment_cost=float(clip.cost),
            outlier=bool(outlying[index]),
        )
        for index, clip in enumerate(aligned.clips)
    )


def _at(errors: ReconstructionErrors, components: int) -> int:
    """Find the index of a number of components in the arrays of `errors`; the last index if fewer were measured."""
    return min(components, len(errors.components) - 1)


def _durations(durations: Floats, span: tuple[float, float]) -> Durations:
    outside = (durations < span[0] * (1.0 - DURATION_SLACK)) | (durations > span[1] * (1.0 + DURATION_SLACK))
    return Durations(float(durations.min()), float(durations.mean()), float(durations.max()), float(outside.mean()))


def _feet(
    primitive: MotionPrimitive, aligned: AlignedSet, poses: Floats, sampled: Floats | None
) -> tuple[FootQuality | None, FootQuality | None]:
    """Measure the feet in the examples and in the samples; None for both if the skeleton has no known feet."""
    joints = find_landmarks(primitive.skeleton).ground_joints
    if not joints:
        return None, None
    toes = joint_positions(primitive.skeleton, poses, joints)
    standing = standing_steps(toes, aligned.time_functions, primitive.frame_rate_hz)
    training = foot_quality(toes, aligned.time_functions, primitive.frame_rate_hz, standing)
    if sampled is None:
        return training, None
    drawn = joint_positions(primitive.skeleton, primitive.poses(sampled), joints)
    return training, foot_quality(drawn, primitive.time_functions(sampled), primitive.frame_rate_hz, standing)
