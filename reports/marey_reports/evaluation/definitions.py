"""Names and definitions of the numbers of a report."""

from __future__ import annotations

from typing import NamedTuple

from marey_motion.evaluation.judgement import GRADES, LARGEST_SPEED_SHARE, LARGEST_TURN_DEG_S, LONGEST_LAG_S
from marey_reports.drawing.markup import Html, element, joined
from marey_reports.drawing.tables import table


class Metric(NamedTuple):
    """Metric of the suite in a report: name, unit, decimals and meaning."""

    label: str
    unit: str
    digits: int
    meaning: str


METRICS = {
    "offset_mean": Metric(
        "distance from the path", "m", 2, "mean distance of the character from where it should be at the same moment"
    ),
    "offset_max": Metric("largest distance", "m", 2, "the largest such distance in any trial"),
    "offset_final": Metric("distance at the end", "m", 2, "the distance at the last moment of a trial"),
    "along_track_rms": Metric("ahead or behind", "m", 2, "the part of the distance along the path: lag or lead"),
    "cross_track_rms": Metric("beside the path", "m", 2, "the part of the distance across the path: drift"),
    "abs_se_v": Metric("speed error", "m/s", 2, "how much too fast or too slow a trial is on average"),
    "abs_se_omega_deg": Metric("turn rate error", "deg/s", 1, "how much too much or too little it turns on average"),
    "dse_v": Metric("spread of the speed", "m/s", 2, "standard deviation of the speed about its own mean"),
    "dse_omega_deg": Metric("spread of the turn rate", "deg/s", 1, "the same of the turn rate; every step sways"),
    "response_s": Metric(
        "response to a new speed", "s", 2, "time until the speed is within 10 % of the new one for half a second"
    ),
    "response_missed": Metric("speeds never reached", "", 0, "switches of speed that were never answered"),
    "pose_cost_mean": Metric(
        "transition cost", "m", 3, "distance over hips, spine, head, hands and feet from one displayed pose to the next"
    ),
    "pose_cost_p95": Metric("transition cost, 95 %", "m", 3, "95 % of the transition costs are below"),
    "transitions_per_s": Metric(
        "transitions", "1/s", 2, "how often the character switches to another place in the clips"
    ),
    "treading_share": Metric(
        "treading", "", 2, "share of the transitions that go back to nearly the same frame, for want of another"
    ),
    "clip_ends": Metric("clip ends met", "", 0, "how often a clip ended before the search chose to leave it"),
    "offset_asymmetry": Metric(
        "left-right difference", "m", 2, "mean difference of the distance between a left turn and the same right turn"
    ),
}
"""Metrics in the order of the report; metrics that a result does not have are left out."""

# What the published text leaves open, as printed there and as it is read here.
_READINGS = (
    (
        "static errors (equations 1 and 2)",
        "1/m · Σ v_r − v_ref over m + 1 terms, brackets missing",
        "signed bias: the mean of recorded minus wished over the steps of the circle. Too fast and too far to the left "
        "are positive.",
    ),
    (
        "dynamic errors (equations 3 and 4)",
        "root of Σ (v_r − SE + v_ref)² over the number of reference values",
        "population standard deviation about the trial's own mean, in switching trials about the mean of each regime; "
        "over a suite the root of the mean square of the trials'.",
    ),
    (
        "offset (equation 5)",
        "Σ ‖p − p_ref‖ in metres, growing with time and frame rate",
        "the mean of the distances at equal moments; the sum and the integral over time are kept beside it.",
    ),
    (
        "sign of errors (figure 8)",
        "a peak at +1.5 m/s for a speed that is not reached",
        "recorded minus wished everywhere; figures can be drawn the other way round.",
    ),
    (
        "window of evaluation",
        "the whole duration",
        "after the approach, from the beginning of the circle, unless the options say otherwise.",
    ),
    (
        "transition cost (figure 7)",
        "cumulative distance over selected joints, to the candidate pose",
        "the distance from each displayed pose to the next displayed one, in metres, summed over the joints named "
        "above; the normalised cost that the search compares is recorded apart.",
    ),
    (
        "duration of trials",
        "not given",
        "the same for every trial; see the options.",
    ),
)


def definitions() -> Html:
    """Write the definitions of metrics, the rules of the verdict, and our interpretation of every ambiguous formula."""
    metrics = [
        (metric.label, metric.unit, metric.meaning, element("code", name, class_="name"))
        for name, metric in METRICS.items()
    ]
    rules = (
        f"on average no farther from the wished place than it goes in {LONGEST_LAG_S:g} s",
        f"on average no more than {100 * LARGEST_SPEED_SHARE:g} % faster or slower than wished",
        f"on average turning no more than {LARGEST_TURN_DEG_S:g} degrees a second too much or too little",
    )
    grades = ", ".join(f"from {100 * share:g} % {name}" for share, name in GRADES[:-1])
    return joined(
        (
            element("h3", "When a trajectory counts as followed"),
            element("p", "The character is"),
            element("ul", [element("li", rule) for rule in rules]),
            element(
                "p",
                f"The share of trajectories that are followed gives the grade: {grades}, below that {GRADES[-1][1]}.",
            ),
            element("h3", "Coverage"),
            element(
                "p",
                "Every second of every clip, one window per frame, has a mean speed and turn rate. A cell around each "
                "trial counts the seconds of data within it; it has enough from the least that the options ask for. "
                "Symmetry is 1 where left and right turns are covered alike and 0 where only one side is.",
            ),
            element("h3", "Metrics"),
            table(
                "What the numbers mean", ("name", "unit", "meaning", "in the data"), metrics, numbers=(), sortable=False
            ),
            element("h3", "How ambiguous formulas are read"),
            element(
                "p",
                "The method is that of Abichequer Sangalli, Hoyet, Christie and Pettré, A new framework for the "
                "evaluation of locomotive motion datasets through motion matching techniques (MIG 2022). Where its "
                "text is open:",
            ),
            table("Readings", ("what", "as printed", "as read here"), _READINGS, numbers=(), sortable=False),
        )
    )
