"""Warnings about a trained model."""

from __future__ import annotations

from dataclasses import dataclass

from marey_motion.modelling.primitive import MotionPrimitive
from marey_motion.modelling.sample_quality import FootQuality
from marey_motion.modelling.training_report import ExampleReport, TrainingReport
from marey_schemas.options.modelling import ModelOptions
from marey_schemas.wording import listed

FEW_EXAMPLES_PER_DIMENSION = 2
DEEP_BELOW_FLOOR_CM = 2.0
SLIDING_RATIO = 2.0
SLIDING_M_S = 0.1
MANY_OUTSIDE = 0.1
OVERFITTED_RATIO = 2.0
MANY_UNLIKELY = 0.15
LEAST_ERROR_CM = 0.5


@dataclass(frozen=True)
class ModelWarning:
    """Warning about a model: a stable code and a description."""

    code: str
    message: str


def warnings_of(primitive: MotionPrimitive, report: TrainingReport, options: ModelOptions) -> tuple[ModelWarning, ...]:
    """List the warnings about a model: about its examples, then its mixture, then its samples.

    Parameters
    ----------
    primitive : MotionPrimitive    the model
    report : TrainingReport    its measures
    options : ModelOptions    options of the training

    Returns
    -------
    tuple of ModelWarning    a code and a message for each warning
    """
    return (*_of_examples(primitive, report, options), *_of_mixture(report), *_of_samples(report))


def _of_examples(primitive: MotionPrimitive, report: TrainingReport, options: ModelOptions) -> list[ModelWarning]:
    count, found = len(report.examples), []
    if primitive.dimensions == 0:
        found.append(
            ModelWarning("no-variation", f"all {count} examples are the same motion, so the model can only repeat it")
        )
    elif count < FEW_EXAMPLES_PER_DIMENSION * primitive.dimensions:
        found.append(
            ModelWarning(
                "too-few-examples",
                f"there are only {count} examples for {primitive.dimensions} dimensions, so their likelihoods are "
                f"hardly meaningful; add examples, or keep less than {options.spatial_share:.0%} of the variance",
            )
        )
    found += _of_time_components(primitive, report, options)
    errors = report.reconstruction
    if errors is not None and errors.left_out_cm is not None and primitive.spatial.count < len(errors.components):
        training, left_out = (curve[primitive.spatial.count] for curve in (errors.training_cm, errors.left_out_cm))
        if left_out > max(OVERFITTED_RATIO * training, LEAST_ERROR_CM):
            found.append(
                ModelWarning(
                    "does-not-generalise",
                    f"the mean reconstruction error is {left_out:.1f} cm for an example left out of the training, but "
                    f"{training:.1f} cm for training examples, which do not show all variations of the action; add "
                    "examples",
                )
            )
    outliers = sorted((one for one in report.examples if one.outlier), key=_likelihood)
    if outliers:
        names = listed([one.name for one in outliers])
        found.append(
            ModelWarning(
                "outliers",
                f"these examples are unlike the others: {names}; check whether they show the same action",
            )
        )
    return found


def _of_time_components(
    primitive: MotionPrimitive, report: TrainingReport, options: ModelOptions
) -> list[ModelWarning]:
    """Warn if the limit of the number of temporal components is too low for the requested share of the variance."""
    kept = primitive.temporal.count
    held = float(report.temporal_energy[kept - 1]) if 0 < kept <= len(report.temporal_energy) else 0.0
    if kept < options.most_temporal_components or kept >= len(report.temporal_energy) or held >= options.temporal_share:
        return []
    return [
        ModelWarning(
            "time-components-missing",
            f"{kept} temporal components explain {held:.0%} of the variance of the timing, but "
            f"{options.temporal_share:.0%} were asked for; raise most_temporal_components, or accept that samples vary "
            "less in their timing than the examples",
        )
    ]


def _likelihood(example: ExampleReport) -> float:
    held_out = example.held_out_log_likelihood
    return example.log_likelihood if held_out is None else held_out


def _of_mixture(report: TrainingReport) -> list[ModelWarning]:
    found = []
    share = report.held_out_low_share
    if share is not None and share > MANY_UNLIKELY and len(report.examples) * share > 1.0:
        found.append(
            ModelWarning(
                "likelihood-too-sure",
                f"{share:.0%} of the examples are less likely than 95% of the samples of a model that was trained "
                "without their takes; new motions differ more than the examples suggest, so add takes",
            )
        )
    slow = [candidate.components for candidate in report.candidates if not candidate.converged]
    if slow:
        found.append(
            ModelWarning(
                "not-converged",
                "the fits of some tried mixtures did not converge, so these mixtures may fit worse than they could "
                f"(numbers of normal distributions: {', '.join(map(str, slow))})",
            )
        )
    return found


def _of_samples(report: TrainingReport) -> list[ModelWarning]:
    found = []
    if report.sample_feet is not None and report.training_feet is not None:
        found += _of_feet(report.sample_feet, report.training_feet)
    durations = report.sample_durations
    if durations is not None and durations.outside_share > MANY_OUTSIDE:
        found.append(
            ModelWarning(
                "odd-durations",
                f"{durations.outside_share:.0%} of the samples are more than 5% longer or shorter than all examples",
            )
        )
    return found


def _of_feet(feet: FootQuality, trained: FootQuality) -> list[ModelWarning]:
    found = []
    if feet.below_floor_mean_cm > DEEP_BELOW_FLOOR_CM:
        found.append(
            ModelWarning(
                "feet-below-floor",
                f"in {feet.below_floor_share:.0%} of their frames, samples have a foot below the floor, "
                f"{feet.below_floor_mean_cm:.1f} cm on average (examples: {trained.below_floor_share:.0%}, "
                f"{trained.below_floor_mean_cm:.1f} cm)",
            )
        )
    if feet.slide_m_s > max(SLIDING_RATIO * trained.slide_m_s, SLIDING_M_S):
        found.append(
            ModelWarning(
                "feet-slide",
                f"where the examples plant their feet, those of samples slide at {feet.slide_m_s:.2f} m/s on average "
                f"(examples: {trained.slide_m_s:.2f} m/s); plant the feet of samples (edit command `plant_feet`)",
            )
        )
    return found
