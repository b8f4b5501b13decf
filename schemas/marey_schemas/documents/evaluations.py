"""Evaluations of locomotion clips: the parts of an item of the kind `evaluation`."""

from __future__ import annotations

import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import Literal, NamedTuple

from pydantic import ConfigDict, Field

from marey_schemas.base import Request

COSTS = ("match_cost", "continuing_cost", "pose_cost")
"""Names of the costs that the part `records` contains for each tick (step of the simulation) of a trial."""

CONFIDENCE = 0.95
"""Confidence level of intervals: changes between two evaluations, means of replicates, and totals of quality."""


MOST_EVALUATIONS_COMPARED = 8
"""Greatest number of evaluations in one comparison; more evaluations do not fit side by side in a table."""


ANGLED_FAMILIES = ("corners", "strafing")
"""Families (kinds) of trials that combine each speed with each angle, instead of with each turn rate."""


def trial_name(family: str, speed_m_s: float, turn_rate_rad_s: float, angle_rad: float = 0.0, label: str = "") -> str:
    """Return the name of a trial, unique in a suite, such as "circle v=1.25 w=-50" or "corners v=1.25 a=90".

    w is the turn rate in degrees per second; a is the angle in degrees, for the families that vary an angle. A trial
    along a take has the take's name, its `label`.
    """
    if label:
        return f"{family} {label}"
    course = f"a={math.degrees(angle_rad):g}" if family in ANGLED_FAMILIES else f"w={math.degrees(turn_rate_rad_s):g}"
    return f"{family} v={speed_m_s:g} {course}"


class HeadlineMetric(NamedTuple):
    """Metric of an evaluation that is shown in lists and summaries."""

    meaning: str
    of_trials: str | None = None
    """Name of the metric of single trials whose mean is this metric; None if this metric is not a mean over trials.

    Trials in which the metric is not defined are left out of the mean.
    """


HEADLINE_METRICS: Mapping[str, HeadlineMetric] = MappingProxyType(
    {
        "clips": HeadlineMetric("number of clips; a clip and its mirrored copy count as one"),
        "unused_clips": HeadlineMetric("number of clips that no trial displayed"),
        "data_s": HeadlineMetric("duration of all clips, in seconds"),
        "trials": HeadlineMetric("number of trials"),
        "followed_trials": HeadlineMetric("number of trials whose trajectory the character followed"),
        "offset_mean_m": HeadlineMetric("distance from the desired position, in metres", "offset_mean"),
        "baseline_offset_mean_m": HeadlineMetric("offset_mean_m with generated clips that cover every cell"),
        "abs_se_v_m_s": HeadlineMetric("error of the speed, in metres per second", "abs_se_v"),
        "abs_se_omega_deg_s": HeadlineMetric("error of the turn rate, in degrees per second", "abs_se_omega_deg"),
        "transitions_per_s": HeadlineMetric("number of jumps between frames per second", "transitions_per_s"),
        "pose_cost_mean_m": HeadlineMetric("distance between successive poses, in metres", "pose_cost_mean"),
        "coverage_index": HeadlineMetric("share of the cells of speed and turn rate that have enough data"),
        "symmetry": HeadlineMetric("similarity of the coverage of left and right turns, from 0 to 1"),
    }
)
"""Metrics in the headline of an evaluation, by name; the name of a metric ends in its unit, if it has one."""
USAGE_FACETS: Mapping[str, str] = MappingProxyType(
    {
        "usage": "Share of the time steps that show the clip or its mirrored copy, 0 to 1, in the newest evaluation "
        "that contains the clip.",
        "used_frames": "Share of the clip's evaluated frames that at least one trial shows, 0 to 1, in the newest "
        "evaluation that contains the clip. If only a range of the clip was evaluated, its other frames are not "
        "counted.",
    }
)
"""Meaning of each facet (published number) that an evaluation gives to its clips, by name of the facet."""
REMOVAL_FACETS: Mapping[str, str] = MappingProxyType(
    {
        "removal_harm": "Harm of removing the clip from the evaluated set, in metres, by the newest suggestions that "
        "assessed the clip; 0 if no trial needs the clip, negative if the removal helps."
    }
)
"""Meaning of each facet (published number) that a job of the kind `suggest` gives to clips, by name of the facet."""


class RegionVerdict(Request):
    """Verdict on the trials of one region, a group of trials with similar motion, such as sharp turns."""

    region: str = Field(max_length=64, description="Name of the region.")
    followed: int = Field(ge=0, description="Number of followed trials.")
    trials: int = Field(ge=0, description="Number of trials; 0 if no trial requires motion of this region.")
    sentence: str = Field(max_length=2000, description="The verdict in one sentence.")


class EvaluationDocument(Request):
    """Part `evaluation`: options, provenance, metrics of every trial, usage, coverage, baseline.

    The document has the members of `marey_motion.evaluation.result.EvaluationResult`, with arrays as leaves. This class
    declares only the members that are shown in lists and summaries.
    """

    model_config = ConfigDict(extra="allow")

    schema_: Literal["marey/evaluation@1"] = Field("marey/evaluation@1", alias="schema")
    verdict: str = Field(max_length=2000, description="Assessment of the clips in one or two sentences.")
    regions: tuple[RegionVerdict, ...] = Field(
        (), max_length=16, description="Verdict on each region of the trials; empty in evaluations of old versions."
    )
    headline: dict[str, float | int | None] = Field(
        max_length=64, description="Headline metrics by name, which lists of items show; null: not defined."
    )


class EvaluationRecords(Request):
    """Part `records`: the ticks (steps of the simulation) of all trials, one trial after the other."""

    model_config = ConfigDict(extra="allow")

    schema_: Literal["marey/evaluation-records@1"] = Field("marey/evaluation-records@1", alias="schema")
