"""Limits of the verdict on an evaluation: deviations from the desired motion, and measures of how the motion looks.

Limits of looks are derived from two sources: the clips that the trial shows, and the baseline of generated clips, whose
feet do not slide. The figures of the baseline in the descriptions are those of the 162 default trials.
docs/explanation/what-a-verdict-means.md explains each limit.
"""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from marey_schemas.base import Options
from marey_schemas.options.contacts import TOE_SPEED_M_S

_Limit = Annotated[float, Field(gt=0, le=1000, allow_inf_nan=False)]


class VerdictLimits(Options):
    """Limits within which a trial counts as followed.

    The baseline in the descriptions is the evaluation of generated clips that contain every speed and turn rate.
    """

    lag_s: _Limit = Field(
        0.5,
        description="Greatest mean distance from the desired position, given as the time in seconds to cover "
        "the distance at the mean speed of the trial.",
    )
    speed_share: _Limit = Field(
        0.15,
        description="Greatest error of the mean speed, as a share of the desired speed. In a switching trial, each "
        "speed is measured separately, away from the switches.",
    )
    turn_deg_s: _Limit = Field(10.0, description="Greatest error of the mean turn rate, in degrees per second.")
    heading_deg: _Limit = Field(
        15.0,
        description="Greatest root mean square error of the heading, in degrees; the baseline of generated "
        "clips reaches 12.",
    )
    speed_wobble_share: _Limit = Field(
        0.2,
        description="Greatest standard deviation of the speed, as a share of the desired speed. In a switching "
        "trial, it is measured away from the switches, as a share of the faster speed, because the "
        "character catches up after a switch. The baseline of generated clips reaches 0.19.",
    )
    turn_wobble_deg_s: _Limit = Field(
        25.0,
        description="Greatest standard deviation of the turn rate, in degrees per second. The heading sways with "
        "each step: the baseline of generated clips reaches 21.",
    )
    response_s: _Limit = Field(
        2.0,
        description="Greatest median time in which the character responds to a switch of the speed, in seconds. "
        "A switch without a response counts as slower than every response.",
    )
    skate_m_s: _Limit = Field(
        TOE_SPEED_M_S,
        description="Greatest mean speed of feet in contact, in metres per second, unless `skate_ratio` allows more. "
        "The default is the greatest speed of a foot that counts as standing.",
    )
    skate_ratio: _Limit = Field(
        2.0,
        description="Greatest ratio of the mean speed of feet in contact to the same speed in the clips "
        "that the trial shows.",
    )
    sinking_m: _Limit = Field(
        0.03,
        description="Greatest depth of the feet below the floor of the clips that the trial shows, in metres; "
        "the deepest 5 % of the time are left out. The baseline of generated clips reaches 0.006.",
    )
    step_ratio: _Limit = Field(
        1.5,
        description="Greatest ratio between the contacts per metre of the trial and of the clips that it shows, "
        "in either direction. The ratio of the baseline of generated clips is between 0.97 and 1.05.",
    )
    steps_per_m: _Limit = Field(
        0.3,
        description="Least number of foot contacts per metre; a sprinter has 0.4, so fewer show that the "
        "character glides.",
    )
    pose_cost_ratio: _Limit = Field(
        2.0,
        description="Greatest ratio of the mean pose cost (change of pose from frame to frame) to its mean in "
        "the clips that the trial shows. The baseline of generated clips reaches 1.5.",
    )
    pose_cost_p95_ratio: _Limit = Field(
        4.0,
        description="Greatest ratio of the 95th percentile of the pose cost (change of pose from frame to frame) "
        "to its mean in the clips that the trial shows.",
    )
    transitions_per_s: _Limit = Field(
        6.0,
        description="Greatest number of transitions per second; 95 % of the trials with the baseline of "
        "generated clips have fewer than 5.",
    )
    treading_per_s: _Limit = Field(
        0.5,
        description="Greatest number of transitions per second to a frame of the same clip at most 1/3 s away; "
        "the baseline of generated clips has none.",
    )
