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

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from marey_motion import kinematics, quaternions
from marey_motion.arrays import Floats
from marey_motion.clip import Clip
from marey_motion.errors import ClipError, MappingError
from marey_motion.rigs.conventions import conventional_axes
from marey_motion.rigs.mapping import JointMapping
from marey_motion.rigs.standard import CENTRE_JOINTS, FINGERS, SIDES, STANDARD_JOINTS
from marey_motion.skeleton import Skeleton, same_hierarchy

Triple = tuple[float, float, float]

# Frames of a motion that are looked at, evenly spaced.
FRAMES_READ = 300
# Mean sine of the bend above which a hinge's axis is read off its bending.
HINGE_BEND = 0.1
# A tip nearer or farther than these shares of the bone before it is a marker of something else.
TIP_LENGTHS = (0.05, 1.5)
# Cosine above which two bones lie along one line.
ALONG = 0.95

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
# Heights of a body from the top; the upper two that are mapped tell where up is.
_LEVELS = (
    ("shoulder", "head", "neck", "spine_2", "spine_1", "spine"),
    ("pelvis", "hip"),
    ("ankle", "knee"),
)
_LEG = ("hip", "knee", "ankle", "toe", "heel")


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
    rest = _resting_body(skeleton, mapping)
    moving = rest if motion is None else _moving_body(skeleton, motion, rest.joints)
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
    rest = _resting_body(skeleton, mapping)
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
    return frozenset(mapping.joints[name] for name in _resting_body(skeleton, mapping).doubtful)


def _conventional(rest: _PosedBody, mapping: JointMapping) -> dict[str, tuple[Floats, Floats]]:
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
    side, _, joint = standard.partition("_")
    prefix, joint = (f"{side}_", joint) if side in SIDES else ("", standard)
    return next((prefix + end for end in _TOWARDS.get(joint, ()) if prefix + end in joints), None)


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
    return tuple(dict.fromkeys(_part(name) for name in _resting_body(skeleton, mapping).doubtful))


def _resting_body(skeleton: Skeleton, mapping: JointMapping) -> _PosedBody:
    joints = {standard: skeleton.index_of(name) for standard, name in mapping.joints.items()}
    if not any({f"{side}_{joint}" for side in SIDES} <= joints.keys() for joint in ("hip", "shoulder")):
        raise MappingError(
            "the axes are computed from both hips or both shoulders; add one of these pairs to the mapping",
            where="left_hip",
        )
    return _PosedBody(skeleton, joints, skeleton.rest_global_positions[None], skeleton.rest_global_rotations[None])


def _moving_body(skeleton: Skeleton, motion: Clip, joints: Mapping[str, int]) -> _PosedBody:
    if not same_hierarchy(skeleton, motion.skeleton):
        raise ClipError(
            "the skeleton of this motion differs from the given skeleton; use a motion of the given skeleton",
            where="motion",
        )
    count = min(motion.frame_count, FRAMES_READ)
    frames = np.linspace(0, motion.frame_count - 1, count).round().astype(np.intp)
    seen = replace(
        motion,
        poses=motion.poses[frames],
        translations=None if motion.translations is None else motion.translations[frames],
    )
    positions = kinematics.global_positions(seen).astype(np.float64)
    return _PosedBody(skeleton, joints, positions, kinematics.global_rotations(seen).astype(np.float64))


@dataclass(frozen=True, eq=False)
class _PosedBody:
    """A body over K frames: global positions (K, J, 3) and rotations (K, J, 4)."""

    skeleton: Skeleton
    joints: Mapping[str, int]
    positions: Floats
    rotations: Floats

    def direction(self, start: str, end: str) -> Floats | None:
        """Compute unit directions (K, 3) from one standard joint to another.

        Returns None if one of the joints is not mapped. The direction is zero in frames where the two joints coincide.
        """
        if start not in self.joints or end not in self.joints:
            return None
        return _unit(self.positions[:, self.joints[end]] - self.positions[:, self.joints[start]])

    def coinciding(self, start: str, end: str) -> MappingError:
        """Make the error for two joints at the same position, between which there is no direction."""
        names = [self.skeleton.joint_names[self.joints[standard]] for standard in (start, end)]
        return MappingError(
            f"{names[0]} ({start}) and {names[1]} ({end}) are at the same position, so the bone between them "
            f"gives no axis; map {end} to a joint further on, or give the bone a length",
            where=end,
        )

    def in_joint(self, standard: str, vectors: Floats) -> Floats:
        """Compute the mean (3,) of global vectors (K, 3) in the frame of a joint."""
        inverse = quaternions.conjugate(self.rotations[:, self.joints[standard]])
        mean: Floats = quaternions.rotate_vectors(inverse, vectors).astype(np.float64).mean(axis=0)
        return mean

    @cached_property
    def hips_left(self) -> Floats:
        across = self.direction("right_hip", "left_hip")
        return self.shoulders_left if across is None else across

    @cached_property
    def shoulders_left(self) -> Floats:
        across = self.direction("right_shoulder", "left_shoulder")
        return self.hips_left if across is None else across

    @cached_property
    def up(self) -> Floats:
        """Upward unit directions (K, 3) of the trunk, perpendicular to the hip line.

        They point from the pelvis to the middle of the shoulders, or else between the nearest mapped joints.
        """
        levels = [level for level in map(self._level, _LEVELS) if level is not None]
        if len(levels) < 2:
            raise MappingError(
                "the upward direction is computed from joints at two of three heights: spine, neck, head or shoulders; "
                "pelvis or hips; knees or ankles; add the missing joints to the mapping",
                where="pelvis",
            )
        trunk = levels[0] - levels[1]
        return _unit(trunk - _dot(trunk, self.hips_left) * self.hips_left)

    def _level(self, names: tuple[str, ...]) -> Floats | None:
        """Find the positions (K, 3) of the first of `names` that is mapped; None if none is mapped.

        A name that stands for a left and a right joint gives the middle of the two joints.
        """
        for name in names:
            joints = (name,) if name in CENTRE_JOINTS else tuple(f"{side}_{name}" for side in SIDES)
            if all(joint in self.joints for joint in joints):
                middle: Floats = self.positions[:, [self.joints[joint] for joint in joints]].mean(axis=1)
                return middle
        return None

    @cached_property
    def doubtful(self) -> tuple[str, ...]:
        """Standard joints, in their order, of the parts whose swing axes cannot be read from these frames."""
        names = (name for name in STANDARD_JOINTS if name in self.joints)
        return tuple(name for name in names if _part(name) not in self.readable_parts)

    @cached_property
    def readable_parts(self) -> frozenset[str]:
        """Names of the parts of the body whose axes can be computed from the first frame.

        These are the parts that have the pose of a standing body in that frame.
        """
        left, up = self.hips_left[0], self.up[0]
        legs = [leg[0] for side in SIDES if (leg := self.direction(f"{side}_hip", f"{side}_ankle")) is not None]
        if left @ self.shoulders_left[0] < 0.7 or not np.any(up) or any(leg @ up > -0.7 for leg in legs):
            return frozenset()
        parts = {"trunk"}
        for side, outwards in zip(SIDES, (left, -left), strict=True):
            if self._leg_stands(side, up):
                parts.add(f"{side} leg")
            if self._arm_hangs_or_reaches_out(side, up, outwards):
                parts.add(f"{side} arm")
        return frozenset(parts)

    def foot(self, side: str) -> Floats | None:
        """Compute unit directions (K, 3) from ankle to toe.

        If the toe joint is straight below the ankle, the directions end at the tip of the toe instead.
        """
        shank, foot = self.direction(f"{side}_knee", f"{side}_ankle"), self.direction(f"{side}_ankle", f"{side}_toe")
        if foot is None or shank is None or float(np.mean(np.sum(foot * shank, axis=-1))) < ALONG:
            return foot
        toe = self.joints[f"{side}_toe"]
        tip = _tip(self.skeleton, toe)
        if tip is None:
            return foot
        end = self.positions[:, toe] + quaternions.rotate_vectors(self.rotations[:, toe], tip)
        return _unit(end - self.positions[:, self.joints[f"{side}_ankle"]])

    def _leg_stands(self, side: str, up: Floats) -> bool:
        thigh, shank = self.direction(f"{side}_hip", f"{side}_knee"), self.direction(f"{side}_knee", f"{side}_ankle")
        foot = self.foot(side)
        straight = all(bone is None or bone[0] @ up < -0.7 for bone in (thigh, shank))
        return straight and (foot is None or shank is None or abs(float(foot[0] @ shank[0])) < ALONG)

    def _arm_hangs_or_reaches_out(self, side: str, up: Floats, outwards: Floats) -> bool:
        bones = (self.direction(f"{side}_shoulder", f"{side}_elbow"), self.direction(f"{side}_elbow", f"{side}_wrist"))
        return all(bone is None or (bone[0] @ up < 0.5 and bone[0] @ outwards > -0.3) for bone in bones)


def _part(standard: str) -> str:
    side, _, joint = standard.partition("_")
    if side not in SIDES:
        return "trunk"
    return f"{side} leg" if joint in _LEG else f"{side} arm"


def _twist(standard: str, body: _PosedBody) -> Floats:
    """Compute the unit direction (3,) of a joint's bone in the frame of the joint."""
    side, _, joint = standard.partition("_")
    prefix, joint = (f"{side}_", joint) if side in SIDES else ("", standard)
    for target in _TOWARDS.get(joint, ()):
        direction = body.foot(side) if joint == "ankle" else body.direction(standard, prefix + target)
        if direction is not None and np.any(direction):
            return _unit(body.in_joint(standard, direction))
    if prefix:
        tip = _tip(body.skeleton, body.joints[standard])
        if tip is not None:
            return _unit(tip)
        before = f"{prefix}{_BEFORE.get(joint, 'elbow')}"
        direction = body.direction(before, standard)
        if direction is not None and np.any(direction):
            return _unit(body.in_joint(standard, direction))
    return _unit(body.in_joint(standard, body.up))


def _tip(skeleton: Skeleton, joint: int) -> Floats | None:
    """Return the offset (3,) of the farthest child or end site at a distance that is plausible for a bone's end."""
    ends = [skeleton.offsets[child] for child in skeleton.children[joint]]
    ends += [site.offset for site in skeleton.end_sites if site.joint == joint]
    # The joint's own offset is short where it lies just below an ankle.
    own, above = (float(np.linalg.norm(skeleton.offsets[index])) for index in (joint, skeleton.parents[joint]))
    shortest, longest = (share * max(own, 0.5 * above) for share in TIP_LENGTHS)
    ends = [end for end in ends if shortest < np.linalg.norm(end) < longest]
    return max(ends, key=lambda end: float(np.linalg.norm(end))) if ends else None


def _swing(standard: str, body: _PosedBody) -> Floats:
    """Compute the swing axis of a joint in each of K frames, as directions (K, 3) in the world.

    The mean of these directions in the frame of the joint is the joint's swing axis.
    """
    side, _, joint = standard.partition("_")
    if side not in SIDES:
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


def _leg_hinge(side: str, body: _PosedBody) -> Floats:
    """Find the axes (K, 3) about which a knee bends backwards; if it never bends, the direction of the body's left."""
    thigh, shank = body.direction(f"{side}_hip", f"{side}_knee"), body.direction(f"{side}_knee", f"{side}_ankle")
    if len(body.positions) > 1 and thigh is not None and shank is not None:
        bend = np.cross(thigh, shank)
        if np.linalg.norm(body.in_joint(f"{side}_hip", bend)) > HINGE_BEND:
            return bend
    return body.hips_left


def _arm_hinge(side: str, joint: str, body: _PosedBody) -> Floats:
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
    return _unit(across)


def _unit(v: Floats) -> Floats:
    length = np.linalg.norm(v, axis=-1, keepdims=True)
    unit: Floats = v / np.where(length > quaternions.TINY, length, 1.0)
    return np.where(length > quaternions.TINY, unit, 0.0)


def _dot(a: Floats, b: Floats) -> Floats:
    dot: Floats = np.sum(a * b, axis=-1, keepdims=True)
    return dot


def _triple(v: Floats) -> Triple:
    x, y, z = (float(component) for component in v)
    return x, y, z
