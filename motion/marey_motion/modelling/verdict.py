"""Summary of a trained model: one or two sentences, and a few numbers to show in lists."""

from __future__ import annotations

from marey_motion.modelling.training import TrainedPrimitive
from marey_schemas.wording import counted

Headline = dict[str, float | int | str | None]


def verdict_of(trained: TrainedPrimitive) -> str:
    """Describe the quality of a model in one or two sentences.

    Parameters
    ----------
    trained : TrainedPrimitive    the model

    Returns
    -------
    str    text for users
    """
    report, primitive = trained.report, trained.primitive
    count = len(report.examples)
    takes = "" if report.takes == count else f" of {counted(report.takes, 'take')}"
    parts = [f"{counted(count, 'example')}{takes} in {primitive.dimensions} dimensions"]
    parts.append(counted(len(primitive.mixture.weights), "normal distribution"))
    error, of_subject = _left_out_cm(trained), _left_out_subject_cm(trained)
    if error is not None:
        named = "example" if report.takes == count else "take"
        others = "" if of_subject is None else f", of a left-out performer {of_subject:.1f} cm"
        parts.append(f"the mean error of a left-out {named} is {error:.1f} cm{others}")
    elif report.reconstruction is not None and count > 1:
        parts.append("the mean error of a left-out take is unknown: all examples come from one take")
    feet = report.sample_feet
    if feet is not None:
        below = f"{feet.below_floor_mean_cm:.1f} cm below the floor in {feet.below_floor_share:.0%} of the frames"
        parts.append(
            f"feet of samples are {below}" if feet.below_floor_share else "feet of samples stay above the floor"
        )
    sentence = "; ".join(parts) + "."
    noted = [warning.code for warning in trained.warnings]
    return f"{sentence} Warnings: {', '.join(noted)}." if noted else sentence


def headline_of(trained: TrainedPrimitive) -> Headline:
    """Select the numbers of a trained model that lists of models show.

    Parameters
    ----------
    trained : TrainedPrimitive    the model

    Returns
    -------
    dict    value by name; names end with the unit
    """
    report, primitive = trained.report, trained.primitive
    durations, feet = report.training_durations, report.sample_feet
    return {
        "examples": len(report.examples),
        "takes": report.takes,
        "subjects": report.subjects,
        "frames": primitive.frame_count,
        "frame_rate_hz": primitive.frame_rate_hz,
        "spatial_components": primitive.spatial.count,
        "temporal_components": primitive.temporal.count,
        "mixture_components": len(primitive.mixture.weights),
        "log_likelihood": report.log_likelihood,
        "held_out_log_likelihood": report.held_out_log_likelihood,
        "held_out_low_share": report.held_out_low_share,
        "left_out_error_cm": _left_out_cm(trained),
        "left_out_subject_error_cm": _left_out_subject_cm(trained),
        "least_duration_s": durations.least_s,
        "most_duration_s": durations.most_s,
        "feet_below_floor_share": None if feet is None else feet.below_floor_share,
        "feet_below_floor_cm": None if feet is None else feet.below_floor_mean_cm,
        "foot_slide_m_s": None if feet is None else feet.slide_m_s,
        "example_foot_slide_m_s": None if report.training_feet is None else report.training_feet.slide_m_s,
        "warnings": len(trained.warnings),
    }


def _left_out_cm(trained: TrainedPrimitive) -> float | None:
    errors = trained.report.reconstruction
    if errors is None or errors.left_out_cm is None:
        return None
    return float(errors.left_out_cm[min(trained.primitive.spatial.count, len(errors.components) - 1)])


def _left_out_subject_cm(trained: TrainedPrimitive) -> float | None:
    errors = trained.report.reconstruction
    if errors is None or errors.left_out_subject_cm is None:
        return None
    return float(errors.left_out_subject_cm[min(trained.primitive.spatial.count, len(errors.components) - 1)])
