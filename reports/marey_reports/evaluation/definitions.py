"""Names and definitions of the numbers of a report."""

from __future__ import annotations

from typing import NamedTuple

from marey_motion.evaluation.judgement import GRADES
from marey_reports.drawing.markup import Html, element, joined
from marey_reports.drawing.tables import Number, table
from marey_schemas.options.verdict import VerdictLimits


class Metric(NamedTuple):
    """Metric over all trials in a report: name, unit, decimals and meaning.

    `limited_as` is the name of a related metric that has a limit; if that limit is exceeded, this metric is marked,
    too.
    """

    label: str
    unit: str
    digits: int
    meaning: str
    limited_as: str = ""


METRICS = {
    "offset_mean": Metric(
        "distance from the path", "m", 2, "mean distance of the character from the desired position at the same moment"
    ),
    "offset_max": Metric("largest distance", "m", 2, "largest distance from the desired position in a trial"),
    "offset_final": Metric("distance at the end", "m", 2, "distance from the desired position at the end of a trial"),
    "along_track_rms": Metric(
        "ahead or behind", "m", 2, "root mean square of the part of the distance along the path: lag or lead"
    ),
    "cross_track_rms": Metric(
        "beside the path", "m", 2, "root mean square of the part of the distance across the path: drift"
    ),
    "abs_se_v": Metric("speed error", "m/s", 2, "absolute error of the mean speed of a trial"),
    "abs_se_omega_deg": Metric("turn rate error", "deg/s", 1, "absolute error of the mean turn rate of a trial"),
    "heading_rms_deg": Metric(
        "heading error",
        "deg",
        1,
        "root mean square of the difference between the desired and the simulated heading; whole turns count",
    ),
    "dse_v": Metric("spread of the speed", "m/s", 2, "standard deviation of the speed about its own mean"),
    "dse_omega_deg": Metric(
        "spread of the turn rate",
        "deg/s",
        1,
        "standard deviation of the turn rate about its own mean; the sway of each step contributes to it",
    ),
    "response_median_s": Metric(
        "response to a new speed",
        "s",
        2,
        "median time from a switch until the speed is within 10 % of the new one, and stays there for half a second; "
        "switches without response count as longer than all others",
    ),
    "response_s": Metric(
        "response, if there is one",
        "s",
        2,
        "mean time from a switch until the speed is within 10 % of the new one, and stays there for half a second; "
        "switches without response are left out",
    ),
    "response_missed": Metric(
        "speeds never reached", "", 0, "number of switches to which the character did not respond before the next one"
    ),
    "foot_skate": Metric(
        "feet slide",
        "m/s",
        2,
        "mean speed of the toes on the ground while the foot is in contact in the displayed clip",
    ),
    "foot_skate_clips": Metric(
        "feet slide in the clips", "m/s", 2, "mean speed of the toes in contact in the clips shown, without transitions"
    ),
    "foot_depth_p95": Metric(
        "feet sink", "m", 3, "95th percentile of the depth of the lower toe below the mean height of toes in contact"
    ),
    "contacts_per_m": Metric("steps per metre", "1/m", 2, "number of times that a foot comes into contact, per metre"),
    "contacts_per_m_clips": Metric(
        "steps per metre in the clips", "1/m", 2, "number of contacts of the feet per metre in the clips shown"
    ),
    "pose_cost_mean": Metric(
        "transition cost", "m", 3, "distance over hips, spine, head, hands and feet from one displayed pose to the next"
    ),
    "pose_cost_p95": Metric("transition cost, 95 %", "m", 3, "95 % of the transition costs are below this value"),
    "pose_cost_clips": Metric(
        "change of pose in the clips",
        "m",
        3,
        "distance over hips, spine, head, hands and feet between successive frames of the clips shown",
    ),
    "pose_error_mean": Metric(
        "pose error",
        "m",
        3,
        "along takes: mean distance of hips, spine, head, hands and feet from those of the left-out take at the same "
        "time, each in the frame of its root",
    ),
    "pose_error_nearest": Metric(
        "pose error, any phase",
        "m",
        3,
        "along takes: the same distance from the nearest pose of the take at most half a second earlier or later",
    ),
    "transitions_per_s": Metric(
        "transitions", "1/s", 2, "number of jumps per second that a search chose although the clip could have continued"
    ),
    "treading_per_s": Metric(
        "treading", "1/s", 2, "number of transitions per second to a frame of the same clip at most 1/3 s away"
    ),
    "treading_share": Metric(
        "share of treading", "", 2, "share of all transitions that are treading", limited_as="treading_per_s"
    ),
    "clip_ends": Metric("clip ends met", "", 0, "number of jumps at the end of a clip and of restarts of a loop"),
    "offset_asymmetry": Metric(
        "left-right difference",
        "m",
        2,
        "mean difference of the distance from the path between a left turn and the same right turn",
    ),
}
"""Metrics in the order of the report; metrics that a result does not have are left out."""

# Ambiguous parts of the published text: the subject, the printed text, and the computation here.
_READINGS = (
    (
        "static errors (equations 1 and 2)",
        "1/m · Σ v_r − v_ref over m + 1 terms, brackets missing",
        "signed bias: the mean of simulated minus desired values over the steps of the circle. Too fast and too far to "
        "the left are positive.",
    ),
    (
        "dynamic errors (equations 3 and 4)",
        "root of Σ (v_r − SE + v_ref)² over the number of reference values",
        "population standard deviation about the trial's own mean, in switching trials about the mean of each regime; "
        "over a suite the mean, and in dse_…_pooled the root mean square, of the trials.",
    ),
    (
        "offset (equation 5)",
        "Σ ‖p − p_ref‖ in metres, growing with time and frame rate",
        "the mean of the distances at equal moments; the sum and the integral over time are also stored.",
    ),
    (
        "sign of errors (figure 8)",
        "a peak at +1.5 m/s for a speed that is not reached",
        "simulated minus desired everywhere; the option negate_errors of figures reverses the sign.",
    ),
    (
        "window of evaluation",
        "the whole duration",
        "after the approach, from the beginning of the circle, unless the options set another window.",
    ),
    (
        "transition cost (figure 7)",
        "cumulative distance over selected joints, to the candidate pose",
        "the distance from each displayed pose to the next displayed one, in metres, summed over the joints named "
        "above; the normalised cost that the search compares is stored separately.",
    ),
    (
        "duration of trials",
        "not given",
        "the same for every trial, as set in the options.",
    ),
)


_COVERAGE = (
    "The data is measured in windows of one second, one for each frame, by their mean speed and turn rate. Each "
    "trial has a cell around its speed and turn rate. A cell has enough data if its windows sum up to the number of "
    "seconds that the options require. Symmetry is 1 if left and right turns are covered equally, and 0 if only one "
    "side is covered."
)


def definitions(limits: VerdictLimits) -> Html:
    """Write the definitions of metrics, the limits of the verdict, and our interpretation of ambiguous formulas."""
    metrics = [
        (metric.label, metric.unit, metric.meaning, element("code", name, class_="name"))
        for name, metric in METRICS.items()
    ]
    grades = ", ".join(f"from {100 * share:g} % {name}" for share, name in GRADES[:-1])
    return joined(
        (
            element("h3", "Followed trajectories"),
            element("p", "The character follows a trajectory if it exceeds none of these limits:"),
            _limits(limits),
            element(
                "p",
                f"The share of followed trajectories determines the grade: {grades}, below that {GRADES[-1][1]}.",
            ),
            element("h3", "Coverage"),
            element("p", _COVERAGE),
            element("h3", "Metrics"),
            table(
                "Definitions of the metrics",
                ("name", "unit", "meaning", "name in the data"),
                metrics,
                numbers=(),
                sortable=False,
            ),
            element("h3", "Interpretation of the published formulas"),
            element(
                "p",
                "The method is that of Abichequer Sangalli, Hoyet, Christie and Pettré, A new framework for the "
                "evaluation of locomotive motion datasets through motion matching techniques (MIG 2022). Its text "
                "leaves open the following:",
            ),
            table("Interpretations", ("subject", "printed", "computed here"), _READINGS, numbers=(), sortable=False),
        )
    )


def _limits(limits: VerdictLimits) -> Html:
    rules = [
        (
            element("code", name, class_="name"),
            Number(value, f"{value:g}"),
            VerdictLimits.model_fields[name].description,
        )
        for name, value in limits.model_dump().items()
    ]
    return table("Limits of a trial", ("limit", "value", "meaning"), rules, numbers=(1,), sortable=False)
