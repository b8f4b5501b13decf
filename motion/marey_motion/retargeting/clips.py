"""Retargeting of clips: transfer of the poses, with corrections of trunk, floor height, feet and hands."""

from __future__ import annotations

from dataclasses import dataclass

from marey_motion import kinematics
from marey_motion.clip import Clip
from marey_motion.errors import ClipError
from marey_motion.importing.checks import CheckWarning
from marey_motion.moved_bones import FollowedBones, follow_moved_bones
from marey_motion.retargeting.feet import keep_feet
from marey_motion.retargeting.floor import warn_below_floor
from marey_motion.retargeting.hands import keep_hands
from marey_motion.retargeting.planning import RetargetPlan
from marey_motion.retargeting.soles import level_soles
from marey_motion.retargeting.transferring import transfer
from marey_motion.retargeting.trunk import follow_trunk
from marey_motion.skeleton import SAME_SKELETON_M, same_hierarchy
from marey_schemas.options.retargeting import RetargetOptions


@dataclass(frozen=True, eq=False)
class RetargetedClip:
    """A clip of the target skeleton.

    Parameters
    ----------
    clip : Clip    the motion
    checks : tuple of CheckWarning    differences from the poses of the source, with their sizes

    Examples
    --------
    >>> from marey_motion import generate_gait
    >>> from marey_motion import RetargetedClip
    >>> RetargetedClip(generate_gait(speed_m_s=1.2, turn_rate_rad_s=0.0, duration_s=1.0), ()).checks
    ()
    """

    clip: Clip
    checks: tuple[CheckWarning, ...]


def retarget(clip: Clip, plan: RetargetPlan) -> Clip:
    """Retarget a clip to the plan's target skeleton.

    A mapped joint takes the orientation of its source joint. Any other joint keeps its rest rotation; if both skeletons
    are copies of one rig, it copies the local rotation of the source joint with the same name. Bones keep the lengths
    of the target. If the clip translates joints, the target's bones point in the directions of the clip's translated
    bones. If the target is the source skeleton itself, the clip keeps its translations. The path of the pelvis is the
    source's path times the plan's scale. A root above the pelvis moves with the pelvis without turning.

    There are three corrections. Pelvis, spine and neck are turned, where necessary, so that the line of the hips and
    the spine have the directions that they have in the source. If a rest pose does not show how far the hips are below
    the pelvis, the middle of the hips follows the scaled path of the source, instead of the pelvis. If the soles would
    not stand on the floor of the source, the whole clip is moved up or down.

    Parameters
    ----------
    clip : Clip    motion of the plan's source skeleton
    plan : RetargetPlan    result of `plan_retarget`

    Returns
    -------
    Clip    the motion of the target skeleton, at the same frame rate

    Raises
    ------
    ClipError    if the clip's skeleton differs from the plan's source skeleton

    Examples
    --------
    >>> from marey_motion import game_skeleton, generate_gait, guess_axes, map_joints, plan_retarget, retarget
    >>> clip, target = generate_gait(speed_m_s=1.2, turn_rate_rad_s=0.0, duration_s=2.0), game_skeleton()
    >>> joints = map_joints(clip.skeleton), map_joints(target)
    >>> axes = guess_axes(clip.skeleton, joints[0]), guess_axes(target, joints[1])
    >>> result = retarget(clip, plan_retarget(clip.skeleton, joints[0], axes[0], target, joints[1], axes[1]))
    >>> result.skeleton is target, result.poses.shape
    (True, (120, 159))
    """
    return retarget_with_checks(clip, plan).clip


def retarget_with_checks(clip: Clip, plan: RetargetPlan, options: RetargetOptions | None = None) -> RetargetedClip:
    """Retarget a clip to the plan's target skeleton, and report the corrections.

    Parameters
    ----------
    clip : Clip    motion of the plan's source skeleton
    plan : RetargetPlan    result of `plan_retarget`
    options : RetargetOptions, optional    whether planted feet, and the positions of hands, are kept in addition

    Returns
    -------
    RetargetedClip    the motion of the target skeleton, with checks

    Raises
    ------
    ClipError    if the clip's skeleton differs from the plan's source skeleton
    MappingError    if feet or hands are to be kept, but not all joints of both limbs are mapped in both skeletons

    Examples
    --------
    >>> from marey_motion import game_skeleton, generate_gait, guess_axes, map_joints, plan_retarget
    >>> from marey_motion import retarget_with_checks
    >>> from marey_schemas.options.retargeting import RetargetOptions
    >>> clip, target = generate_gait(speed_m_s=1.2, turn_rate_rad_s=0.0, duration_s=2.0), game_skeleton()
    >>> joints = map_joints(clip.skeleton), map_joints(target)
    >>> axes = guess_axes(clip.skeleton, joints[0]), guess_axes(target, joints[1])
    >>> plan = plan_retarget(clip.skeleton, joints[0], axes[0], target, joints[1], axes[1])
    >>> made = retarget_with_checks(clip, plan, RetargetOptions(keep_feet=True))
    >>> made.clip.frame_count, [check.code for check in made.checks]
    (120, ['feet-kept'])
    """
    if not same_hierarchy(clip.skeleton, plan.source, tolerance_m=SAME_SKELETON_M):
        raise ClipError(
            "the clip has a different skeleton from the source skeleton of the retargeting plan; make a plan for the "
            "skeleton of the clip",
            where="skeleton",
        )
    bones = (
        FollowedBones(clip.poses[:, 3:], {}) if plan.changes_no_pose else follow_moved_bones(clip, plan.source_joints)
    )
    trunk = follow_trunk(clip, plan, bones.rotations)
    made = level_soles(clip, transfer(clip, plan, trunk.rotations), plan)
    result, checks = made.clip, [bones.warning, *trunk.checks, made.warning]
    options = options or RetargetOptions()
    if options.keep_feet:
        result, kept = keep_feet(clip, result, plan, made.floor)
        checks += kept
    if options.keep_hands:
        result, check = keep_hands(clip, result, plan, options.hands_from, made.floor)
        checks.append(check)
    if made.floor is not None and made.points is not None:
        before, after = made.points
        if result is not made.clip:
            after = kinematics.global_positions(result, end_sites=True)
        checks.append(warn_below_floor(before, after, plan, made.floor))
    return RetargetedClip(result, tuple(check for check in checks if check is not None))
