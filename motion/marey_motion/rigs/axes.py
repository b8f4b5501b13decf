"""Anatomical axes of joints, each in the joint's own frame, by which rotations of different rigs can be compared.

`twist` points along the bone: from the joint towards the next one. `swing` is perpendicular to `twist` and points to
the body's left when the limb hangs down or the trunk is upright: `swing` is the axis about which knees and elbows
hinge. The swing axis of an arm turns with the arm when the arm is raised sideways: in a T-pose with palms down, the
swing axis of the left arm points up, and that of the right arm points down.

The twist can usually be computed from offsets alone. The swing of a limb can be computed from the rest pose only if the
rest pose is that of a standing body. In many files all bones are on one line at rest. The axes of a known rig are then
those that the rig always has (`conventions`); only the axes of an unknown rig are determined from a motion.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from marey_motion import quaternions
from marey_motion.arrays import Floats
from marey_motion.clip import Clip
from marey_motion.rigs.conventions import conventional_axes
from marey_motion.rigs.mapping import JointMapping
from marey_motion.rigs.posed_body import PosedBody, unit
from marey_motion.rigs.standard import FINGERS, STANDARD_JOINTS, split_side
from marey_motion.skeleton import Skeleton

Triple = tuple[float, float, float]

# Mean sine of the bend above which a hinge's axis is read off its bending.
HINGE_BEND = 0.1

_TOWARDS: dict[str, tuple[str, ...]] = {
    "pelvis": ("spine_2", "neck", "spine_1", "spine", "head"),
    "spine": ("spine_1", "spine_2", "neck", "head"),
    "spine_1": ("spine_2", "neck", "head"),
    "spine_2": ("neck", "head"),
    "neck": ("head",),
    "clavicle": ("shoulder",),
    "shoulder": ("elbow",),
    "elbow": ("wrist",),
    "wrist": ("middle_finger_base", "index_finger_base", "ring_finger_base", "pinky_finger_base", "finger"),
    "hip": ("knee",),
    "knee": ("ankle",),
    "ankle": ("toe",),
    **{
        f"{finger}_{part}": (f"{finger}_{following}",)
        for finger in ("thumb", *(f"{finger}_finger" for finger in FINGERS))
        for part, following in (("root", "base"), ("base", "mid"), ("mid", "tip"), ("tip", "end"))
    },
}
_BEFORE = {"wrist": "elbow", "toe": "ankle", "finger": "wrist", "ankle": "knee"}


@dataclass(frozen=True)
class JointAxes:
    """Anatomical axes of a joint: unit directions in its local frame.

    Parameters
    ----------
    twist : (float, float, float)    direction along the bone
    swing : (float, float, float)    direction perpendicular to `twist`, about which knees and elbows hinge

    Examples
    --------
    >>> from marey_motion import guess_axes, map_joints, studio_skeleton
    >>> skeleton = studio_skeleton()
    >>> guess_axes(skeleton, map_joints(skeleton))["LeftLeg"]
    JointAxes(twist=(0.0, -1.0, 0.0), swing=(1.0, 0.0, 0.0))
    """

    twist: Triple
    swing: Triple


def guess_axes(skeleton: Skeleton, mapping: JointMapping, motion: Clip | None = None) -> dict[str, JointAxes]:
    """Determine the anatomical axes of every mapped joint.

    Parameters
    ----------
    skeleton : Skeleton    the joints
    mapping : JointMapping    standard names of the skeleton's joints; hips or shoulders of both sides are needed
    motion : Clip, optional    a clip of the skeleton in which the body moves. The clip is used only for the joints that
        `axes_from_motion` names; without a motion, the axes of these joints are guesses on which retargeting should
        not rely.

    Returns
    -------
    dict of str to JointAxes    axes by joint name

    Raises
    ------
    MappingError    if the mapping lacks the joints that define left and up, or if joints of an arm coincide
    UnknownJoint    if the mapping names joints that the skeleton does not have
    ClipError    if the motion belongs to another skeleton

    Examples
    --------
    >>> from marey_motion import guess_axes, map_joints, studio_skeleton
    >>> skeleton = studio_skeleton()
    >>> len(guess_axes(skeleton, map_joints(skeleton)))
    26
    """
    rest = PosedBody.at_rest(skeleton, mapping)
    moving = rest if motion is None else rest.moving(motion)
    conventional = _conventional(rest, mapping)
    axes = {}
    for standard in (name for name in STANDARD_JOINTS if name in rest.joints):
        if standard in conventional:
            twist, swing = conventional[standard]
        else:
            body = moving if standard in rest.doubtful else rest
            twist = _twist(standard, body)
            swing = body.in_joint(standard, _swing(standard, body))
        axes[skeleton.joint_names[rest.joints[standard]]] = JointAxes(_triple(twist), _triple(_across(swing, twist)))
    return axes


def axes_from_motion(skeleton: Skeleton, mapping: JointMapping) -> frozenset[str]:
    """List the joints whose axes only a motion shows, because neither the rest pose nor the names of a known rig do.

    Parameters
    ----------
    skeleton : Skeleton    the joints
    mapping : JointMapping    its standard joints

    Returns
    -------
    frozenset of str    joint names; a root that is not also the pelvis is left out, because no bone defines its axes

    Raises
    ------
    MappingError    if the mapping lacks the joints that define left and up, or if joints of an arm coincide
    """
    rest = PosedBody.at_rest(skeleton, mapping)
    known = _conventional(rest, mapping)
    return frozenset(mapping.joints[name] for name in rest.doubtful if name != "root" and name not in known)


def doubtful_joints(skeleton: Skeleton, mapping: JointMapping) -> frozenset[str]:
    """List the joints of the parts of the body that `rest_pose_doubts` names.

    Parameters
    ----------
    skeleton : Skeleton    the joints
    mapping : JointMapping    its standard joints

    Returns
    -------
    frozenset of str    joint names

    Raises
    ------
    MappingError    if the mapping lacks the joints that define left and up, or if joints of an arm coincide
    """
    return frozenset(mapping.joints[name] for name in PosedBody.at_rest(skeleton, mapping).doubtful)


def _conventional(rest: PosedBody, mapping: JointMapping) -> dict[str, tuple[Floats, Floats]]:
    """Find the twist and swing axes (3,) that a known rig gives the doubtful joints of `rest`, by standard name."""
    if not rest.doubtful:
        return {}
    ends = {name: end for name in rest.doubtful if (end := bone_end(name, rest.joints)) is not None}
    known = conventional_axes(rest.skeleton, mapping.rig, rest.joints, ends)
    return {name: known[name] for name in rest.doubtful if name in known}


def bone_end(standard: str, joints: Collection[str]) -> str | None:
    """Find the standard joint at the other end of a joint's bone.

    Parameters
    ----------
    standard : str    standard name of the joint
    joints : collection of str    standard joints to choose from

    Returns
    -------
    str or None    standard name; None for the last joint of a chain
    """
    return next((end for end in _possible_ends(standard) if end in joints), None)


def _possible_ends(standard: str) -> tuple[str, ...]:
    """List the standard joints at which a joint's bone can end, the most suitable first."""
    side, joint = split_side(standard)
    return tuple(f"{side}_{end}" if side else end for end in _TOWARDS.get(joint, ()))


def rest_pose_doubts(skeleton: Skeleton, mapping: JointMapping) -> tuple[str, ...]:
    """List the parts of the body whose swing axes cannot be read from the rest pose.

    Parameters
    ----------
    skeleton : Skeleton    the joints
    mapping : JointMapping    its standard joints

    Returns
    -------
    tuple of str    "trunk", "left arm", ...

    Raises
    ------
    MappingError    if the mapping lacks the joints that define left and up, or if joints of an arm coincide
    """
    return PosedBody.at_rest(skeleton, mapping).doubtful_parts


def _twist(standard: str, body: PosedBody) -> Floats:
    """Compute the unit direction (3,) of a joint's bone in the frame of the joint."""
    side, joint = split_side(standard)
    for end in _possible_ends(standard):
        direction = body.foot(side) if joint == "ankle" else body.direction(standard, end)
        if direction is not None and np.any(direction):
            return unit(body.in_joint(standard, direction))
    if side:
        tip = body.tip(standard)
        if tip is not None:
            return unit(tip)
        direction = body.direction(f"{side}_{_BEFORE.get(joint, 'elbow')}", standard)
        if direction is not None and np.any(direction):
            return unit(body.in_joint(standard, direction))
    return unit(body.in_joint(standard, body.up))


def _swing(standard: str, body: PosedBody) -> Floats:
    """Compute the swing axis of a joint in each of K frames, as directions (K, 3) in the world.

    The mean of these directions in the frame of the joint is the joint's swing axis.
    """
    side, joint = split_side(standard)
    if not side:
        if standard in ("spine_2", "neck", "head"):
            return body.shoulders_left
        return body.hips_left + body.shoulders_left if standard == "spine_1" else body.hips_left
    if joint in ("hip", "knee"):
        return _leg_hinge(side, body)
    if joint in ("ankle", "toe", "heel"):
        shank, foot = body.direction(f"{side}_knee", f"{side}_ankle"), body.foot(side)
        return body.hips_left if shank is None or foot is None else np.cross(foot, shank)
    if joint == "clavicle":
        return body.up if side == "left" else -body.up
    knuckles = body.direction(f"{side}_pinky_finger_base", f"{side}_index_finger_base")
    if joint == "wrist" and knuckles is not None and np.any(knuckles):
        # Across the palm: out of the back of a left hand, out of the palm of a right one.
        hand = _twist(standard, body)
        return np.cross(knuckles, quaternions.rotate_vectors(body.rotations[:, body.joints[standard]], hand))
    return _arm_hinge(side, joint, body)


def _leg_hinge(side: str, body: PosedBody) -> Floats:
    """Find the axes (K, 3) about which a knee bends backwards; if it never bends, the direction of the body's left."""
    thigh, shank = body.direction(f"{side}_hip", f"{side}_knee"), body.direction(f"{side}_knee", f"{side}_ankle")
    if len(body.positions) > 1 and thigh is not None and shank is not None:
        bend = np.cross(thigh, shank)
        if np.linalg.norm(body.in_joint(f"{side}_hip", bend)) > HINGE_BEND:
            return bend
    return body.hips_left


def _arm_hinge(side: str, joint: str, body: PosedBody) -> Floats:
    """Find the axes (K, 3) about which an elbow extends.

    If the elbow never bends, return the direction of the body's left, rotated like the arm from hanging down to its
    pose.
    """
    upper, fore = body.direction(f"{side}_shoulder", f"{side}_elbow"), body.direction(f"{side}_elbow", f"{side}_wrist")
    if len(body.positions) > 1 and upper is not None and fore is not None:
        bend = np.cross(fore, upper)
        if np.linalg.norm(body.in_joint(f"{side}_shoulder", bend)) > HINGE_BEND:
            return bend
    bone = upper if joint == "shoulder" or fore is None else fore
    if bone is None:
        return body.shoulders_left
    if not bone.any(axis=1).all():
        start, end = ("shoulder", "elbow") if bone is upper else ("elbow", "wrist")
        raise body.coinciding(f"{side}_{start}", f"{side}_{end}")
    forward = np.cross(body.hips_left, body.up)
    raised = quaternions.between_vectors(-body.up, bone, half_turn_axis=forward)
    return quaternions.rotate_vectors(raised, body.hips_left).astype(np.float64)


def _across(swing: Floats, twist: Floats) -> Floats:
    """Compute the part of a swing axis (3,) perpendicular to the twist axis (3,), scaled to unit length.

    If that part is zero, any perpendicular direction is returned.
    """
    across = swing - (swing @ twist) * twist
    if np.linalg.norm(across) < 1e-6:
        across = np.cross(twist, np.eye(3)[int(np.argmin(np.abs(twist)))])
    return unit(across)


def _triple(v: Floats) -> Triple:
    x, y, z = (float(component) for component in v)
    return x, y, z
