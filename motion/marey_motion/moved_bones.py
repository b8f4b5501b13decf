"""Directions of bones in poses whose joints move relative to their parents.

Some takes store a part of the body's shape in position channels: examples are a shoulder blade that slides, and a rig
whose offsets differ from the proportions of its performer. In such a take, the direction of a bone is not given by the
rotation of its joint. It is the direction from the position of this joint to the position of the next joint.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from marey_motion import kinematics, quaternions
from marey_motion.arrays import AnyFloats, Floats
from marey_motion.clip import Clip
from marey_motion.importing.checks import CheckWarning
from marey_motion.rigs.axes import bone_end

# Bones with smaller rotations are not corrected.
LEAST_TURN_DEG = 0.1
# The bone between joints at a smaller distance has no direction.
SHORTEST_BONE_M = 1e-4


@dataclass(frozen=True, eq=False)
class FollowedBones:
    """Rotations of a clip, corrected so that bones point in the directions given by the clip's joint positions.

    Parameters
    ----------
    rotations : (F, 4·J) float32    local rotations; the clip's own rotations if no bone has moved
    largest_turn_deg : mapping of str to float    by joint name, the largest correction of each corrected joint over all
        frames, in degrees
    """

    rotations: NDArray[np.float32]
    largest_turn_deg: Mapping[str, float]

    @property
    def warning(self) -> CheckWarning | None:
        """A warning for the user, or None if no bone has moved."""
        if not self.largest_turn_deg:
            return None
        name, most = max(self.largest_turn_deg.items(), key=lambda item: item[1])
        return CheckWarning(
            "bones-moved-by-translations",
            f"joints move relative to their parents, so that the directions of {len(self.largest_turn_deg)} bones "
            f"differ from the rotations of their joints, most at {name}: by up to {most:.1f} degrees; the bones of the "
            "result point from joint position to joint position",
            joints=tuple(self.largest_turn_deg),
            values={"largest_turn_deg": most},
        )


def follow_moved_bones(clip: Clip, joints: Mapping[str, int]) -> FollowedBones:
    """Turn joints so that bones keep their directions when the translations of the clip are removed.

    Each joint is turned by the shortest rotation from the bone's direction without the translations to the bone's
    direction with the translations.

    Parameters
    ----------
    clip : Clip    F frames of J joints
    joints : mapping of str to int    joint indices by standard name; the bones between these joints are
        corrected

    Returns
    -------
    FollowedBones    rotations (F, 4·J) float32 and the largest turns in degrees
    """
    own = clip.poses[:, 3:]
    if clip.translations is None:
        return FollowedBones(own, {})
    from marey_motion import moved_bones_kernels as kernels

    still = replace(clip, translations=None, translated_joints=())
    rigid, moved = (kinematics.global_positions(one) for one in (still, clip))
    bones = [(joint, joints[end]) for name, joint in joints.items() if (end := bone_end(name, joints)) is not None]
    turns, angles = turns_between(rigid, moved, np.array(bones, np.int64).reshape(-1, 2))
    largest: dict[str, float] = {}
    chosen: list[int] = []
    for bone, most in enumerate(np.degrees(angles.max(axis=1)).tolist()):
        name = clip.skeleton.joint_names[bones[bone][0]]
        if most >= LEAST_TURN_DEG and name not in largest:
            largest[name] = most
            chosen.append(bone)
    if not largest:
        return FollowedBones(own, {})
    local = np.empty(own.shape, np.float32)
    turned = np.array([bones[bone][0] for bone in chosen], np.int64)
    kernels.turn_joints(kinematics.global_rotations(clip), clip.skeleton.parents, turned, turns[chosen], local)
    return FollowedBones(local, largest)


def turns_between(rigid: AnyFloats, moved: AnyFloats, bones: NDArray[np.int64]) -> tuple[Floats, Floats]:
    """Compute the shortest rotations of bones between two motions.

    Parameters
    ----------
    rigid, moved : (F, J, 3)    positions of J points in both motions, metres
    bones : (B, 2) int64    first and last point of each bone; a bone that has no length in `rigid` or in `moved` does
        not turn

    Returns
    -------
    (B, F, 4) float64, (B, F) float64    rotations from `rigid` to `moved`, and their angles in radians
    """
    from marey_motion import moved_bones_kernels as kernels

    starts, ends = np.ascontiguousarray(bones.T)
    shape = len(bones), len(rigid)
    turns, halves, opposite = np.empty((*shape, 4)), np.empty((2, *shape)), np.zeros(shape, np.bool_)
    kernels.shortest_turns(
        rigid, moved, starts, ends, SHORTEST_BONE_M, quaternions.NEARLY_OPPOSITE, turns, halves, opposite
    )
    bone, frame = np.nonzero(opposite)
    ways = (points[frame, ends[bone]].astype(np.float64) - points[frame, starts[bone]] for points in (rigid, moved))
    turns[bone, frame] = rest = quaternions.between_vectors(*ways)
    halves[:, bone, frame] = np.linalg.norm(rest[:, 1:], axis=1), np.abs(rest[:, 0])
    return turns, 2.0 * np.arctan2(*halves)
