"""Soles of a retargeted clip: the whole clip is moved up or down so that they stand on the floor of the source."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from marey_motion import kinematics
from marey_motion.arrays import AnyFloats, Flags, Floats
from marey_motion.clip import Clip
from marey_motion.editing.annotations.contacts import foot_speed, stances_of
from marey_motion.editing.ground import LOWEST_SHARE, lower_soles_in_stance, sole_heights
from marey_motion.importing.checks import CheckWarning
from marey_motion.retargeting.floor import Floor
from marey_motion.retargeting.planning import RetargetPlan
from marey_motion.rigs.standard import SIDES
from marey_schemas.options.annotations import ContactOptions

SOLES_OFF_M = 0.01
"""Distance between soles and floor, in metres, up to which a clip is not moved."""


class LevelledClip(NamedTuple):
    """A clip whose soles are on the floor, a warning if the clip was moved, and the floor if it is known.

    `points` are the positions (F, n, 3) of joints and end sites in the source and in the clip; None without a floor.
    """

    clip: Clip
    warning: CheckWarning | None
    floor: Floor | None
    points: tuple[AnyFloats, AnyFloats] | None


def level_soles(source: Clip, result: Clip, plan: RetargetPlan) -> LevelledClip:
    """Move a retargeted clip up or down, so that its soles stand as high as those of the source, times the scale.

    All frames are moved by the same distance. The heights of the soles are compared in the frames in which the lower
    foot of the source stands.

    Parameters
    ----------
    source : Clip    F frames of the plan's source skeleton
    result : Clip    F frames of its target skeleton
    plan : RetargetPlan    joints and scale

    Returns
    -------
    LevelledClip    the clip itself if the soles are at most `SOLES_OFF_M` off, or if not both ankles are paired
    """
    ankles = [
        [joints.get(f"{side}_ankle", -1) for side in SIDES] for joints in (plan.source_joints, plan.target_joints)
    ]
    if -1 in ankles[0]:
        return LevelledClip(result, None, None, None)
    before, after = (kinematics.global_positions(clip, end_sites=True) for clip in (source, result))
    heights = sole_heights(before, plan.source, ankles[0])
    standing = _feet_on_the_floor(before, heights, plan, source.frame_rate_hz)
    source_m = float(np.median(heights[standing]))
    off = float(np.median(sole_heights(after, plan.target, ankles[1])[standing])) - plan.scale * source_m
    floor = Floor(source_m, plan.scale * source_m)
    if abs(off) <= SOLES_OFF_M:
        return LevelledClip(result, None, floor._replace(result_m=floor.result_m + off), (before, after))
    poses = result.poses.copy()
    poses[:, 1] -= off
    after[..., 1] -= off
    return LevelledClip(replace(result, poses=poses), _moved(off), floor, (before, after))


def _feet_on_the_floor(points: AnyFloats, heights: Floats, plan: RetargetPlan, frame_rate_hz: float) -> Flags:
    """Find the frames and feet (F, 2) that show the height of the source's floor.

    A frame and foot is chosen if the foot is the lower one and in stance. If there is none, soles are chosen that are
    not above the `LOWEST_SHARE` quantile of the heights of the lower sole.
    `points` (F, n, 3) are the joints of the source, and `heights` (F, 2) the heights of its soles.
    """
    joints = plan.source_joints
    feet = [[joints[f"{side}_ankle"], joints.get(f"{side}_toe", joints[f"{side}_ankle"])] for side in SIDES]
    speeds = (foot_speed(points[:, foot], frame_rate_hz) for foot in feet)
    standing = lower_soles_in_stance(heights, [stances_of(speed, frame_rate_hz, ContactOptions()) for speed in speeds])
    return standing if standing.any() else heights <= np.quantile(heights.min(axis=1), LOWEST_SHARE)


def _moved(off: float) -> CheckWarning:
    return CheckWarning(
        "soles-moved-to-floor",
        f"the soles were {abs(100 * off):.1f} cm {'above' if off > 0 else 'below'} the floor of the source, because "
        "the feet or hips of the two skeletons have different shapes; the whole clip was moved by this distance",
        values={"moved_m": -off},
    )
