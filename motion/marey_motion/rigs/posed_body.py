"""Body of a rig in one or more frames: directions between its standard joints, and the parts that show their axes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from marey_motion import kinematics, quaternions
from marey_motion.arrays import Floats
from marey_motion.clip import Clip
from marey_motion.errors import ClipError, MappingError
from marey_motion.rigs.mapping import JointMapping
from marey_motion.rigs.standard import CENTRE_JOINTS, SIDES, STANDARD_JOINTS, split_side
from marey_motion.skeleton import Skeleton, same_hierarchy

# Frames of a motion that are looked at, evenly spaced.
FRAMES_READ = 300
# A tip nearer or farther than these shares of the bone before it is a marker of something else.
TIP_LENGTHS = (0.05, 1.5)
# Cosine above which two bones lie along one line.
ALONG = 0.95

# Heights of a body from the top; the upper two that are mapped tell where up is.
_LEVELS = (
    ("shoulder", "head", "neck", "spine_2", "spine_1", "spine"),
    ("pelvis", "hip"),
    ("ankle", "knee"),
)
_LEG = ("hip", "knee", "ankle", "toe", "heel")


@dataclass(frozen=True, eq=False)
class PosedBody:
    """A body in K frames.

    Parameters
    ----------
    skeleton : Skeleton    J joints
    joints : mapping of str to int    index of each mapped joint, by standard name
    positions : (K, J, 3) float64    global positions in metres
    rotations : (K, J, 4) float64    global rotations
    """

    skeleton: Skeleton
    joints: Mapping[str, int]
    positions: Floats
    rotations: Floats

    @classmethod
    def at_rest(cls, skeleton: Skeleton, mapping: JointMapping) -> PosedBody:
        """Make a body in its rest pose, as a single frame.

        Parameters
        ----------
        skeleton : Skeleton    J joints
        mapping : JointMapping    standard names of the skeleton's joints

        Returns
        -------
        PosedBody    K = 1

        Raises
        ------
        MappingError    if neither both hips nor both shoulders are mapped
        UnknownJoint    if the skeleton lacks a mapped joint
        """
        joints = {standard: skeleton.index_of(name) for standard, name in mapping.joints.items()}
        if not any({f"{side}_{joint}" for side in SIDES} <= joints.keys() for joint in ("hip", "shoulder")):
            raise MappingError(
                "the axes are computed from both hips or both shoulders; add one of these pairs to the mapping",
                where="left_hip",
            )
        return cls(skeleton, joints, skeleton.rest_global_positions[None], skeleton.rest_global_rotations[None])

    def moving(self, motion: Clip) -> PosedBody:
        """Make the same body in frames of a motion.

        Parameters
        ----------
        motion : Clip    a clip of the skeleton

        Returns
        -------
        PosedBody    at most `FRAMES_READ` frames, evenly spaced

        Raises
        ------
        ClipError    if the motion belongs to another skeleton
        """
        if not same_hierarchy(self.skeleton, motion.skeleton):
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
        return replace(self, positions=positions, rotations=kinematics.global_rotations(seen).astype(np.float64))

    def direction(self, start: str, end: str) -> Floats | None:
        """Compute the directions from one joint to another.

        Parameters
        ----------
        start, end : str    standard names

        Returns
        -------
        (K, 3) float64 or None    global unit directions; zero in frames where the two joints coincide; None if one of
            the joints is not mapped
        """
        if start not in self.joints or end not in self.joints:
            return None
        return unit(self.positions[:, self.joints[end]] - self.positions[:, self.joints[start]])

    def coinciding(self, start: str, end: str) -> MappingError:
        """Make the error for two joints at the same position, between which there is no direction.

        Parameters
        ----------
        start, end : str    standard names of mapped joints

        Returns
        -------
        MappingError    the error
        """
        names = [self.skeleton.joint_names[self.joints[standard]] for standard in (start, end)]
        return MappingError(
            f"{names[0]} ({start}) and {names[1]} ({end}) are at the same position, so the bone between them "
            f"gives no axis; map {end} to a joint further on, or give the bone a length",
            where=end,
        )

    def in_joint(self, standard: str, vectors: Floats) -> Floats:
        """Compute the mean of vectors in the frame of a joint.

        Parameters
        ----------
        standard : str    standard name of a mapped joint
        vectors : (K, 3) float64    global vectors, one per frame

        Returns
        -------
        (3,) float64    the mean in the local frame of the joint
        """
        inverse = quaternions.conjugate(self.rotations[:, self.joints[standard]])
        mean: Floats = quaternions.rotate_vectors(inverse, vectors).astype(np.float64).mean(axis=0)
        return mean

    @cached_property
    def hips_left(self) -> Floats:
        """Unit directions (K, 3) from the right hip to the left one; without hips, those of the shoulders."""
        across = self.direction("right_hip", "left_hip")
        return self.shoulders_left if across is None else across

    @cached_property
    def shoulders_left(self) -> Floats:
        """Unit directions (K, 3) from the right shoulder to the left one; without shoulders, those of the hips."""
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
        return unit(trunk - _dot(trunk, self.hips_left) * self.hips_left)

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
    def doubtful_parts(self) -> tuple[str, ...]:
        """Names of the parts of the body to which the doubtful joints belong: "trunk", "left arm", ..."""
        return tuple(dict.fromkeys(_part(name) for name in self.doubtful))

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
        """Compute the directions from ankle to toe.

        If the toe joint is straight below the ankle, the directions end at the tip of the toe instead.

        Parameters
        ----------
        side : str    "left" or "right"

        Returns
        -------
        (K, 3) float64 or None    global unit directions; None if ankle or toe are not mapped
        """
        shank, foot = self.direction(f"{side}_knee", f"{side}_ankle"), self.direction(f"{side}_ankle", f"{side}_toe")
        if foot is None or shank is None or float(np.mean(np.sum(foot * shank, axis=-1))) < ALONG:
            return foot
        tip = self.tip(f"{side}_toe")
        if tip is None:
            return foot
        toe = self.joints[f"{side}_toe"]
        end = self.positions[:, toe] + quaternions.rotate_vectors(self.rotations[:, toe], tip)
        return unit(end - self.positions[:, self.joints[f"{side}_ankle"]])

    def tip(self, standard: str) -> Floats | None:
        """Find the end of a bone that ends at no standard joint.

        Parameters
        ----------
        standard : str    standard name of the mapped joint at which the bone begins

        Returns
        -------
        (3,) float or None    offset in the frame of the joint: of the farthest child or end site at a distance that is
            plausible for the end of a bone; None if there is none
        """
        skeleton, joint = self.skeleton, self.joints[standard]
        ends = [skeleton.offsets[child] for child in skeleton.children[joint]]
        ends += [site.offset for site in skeleton.end_sites if site.joint == joint]
        # The joint's own offset is short where it lies just below an ankle.
        own, above = (float(np.linalg.norm(skeleton.offsets[index])) for index in (joint, skeleton.parents[joint]))
        shortest, longest = (share * max(own, 0.5 * above) for share in TIP_LENGTHS)
        ends = [end for end in ends if shortest < np.linalg.norm(end) < longest]
        return max(ends, key=lambda end: float(np.linalg.norm(end))) if ends else None

    def _leg_stands(self, side: str, up: Floats) -> bool:
        thigh, shank = self.direction(f"{side}_hip", f"{side}_knee"), self.direction(f"{side}_knee", f"{side}_ankle")
        foot = self.foot(side)
        straight = all(bone is None or bone[0] @ up < -0.7 for bone in (thigh, shank))
        return straight and (foot is None or shank is None or abs(float(foot[0] @ shank[0])) < ALONG)

    def _arm_hangs_or_reaches_out(self, side: str, up: Floats, outwards: Floats) -> bool:
        bones = (self.direction(f"{side}_shoulder", f"{side}_elbow"), self.direction(f"{side}_elbow", f"{side}_wrist"))
        return all(bone is None or (bone[0] @ up < 0.5 and bone[0] @ outwards > -0.3) for bone in bones)


def _part(standard: str) -> str:
    side, joint = split_side(standard)
    if not side:
        return "trunk"
    return f"{side} leg" if joint in _LEG else f"{side} arm"


def unit(v: Floats) -> Floats:
    """Scale vectors to unit length.

    Parameters
    ----------
    v : (..., 3)    vectors

    Returns
    -------
    (..., 3)    unit vectors; zero for a vector without a direction
    """
    length = np.linalg.norm(v, axis=-1, keepdims=True)
    unit: Floats = v / np.where(length > quaternions.TINY, length, 1.0)
    return np.where(length > quaternions.TINY, unit, 0.0)


def _dot(a: Floats, b: Floats) -> Floats:
    dot: Floats = np.sum(a * b, axis=-1, keepdims=True)
    return dot
