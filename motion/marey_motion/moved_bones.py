"""Directions of bones in poses whose joints move relative to their parents.

Some takes keep the shape of the body in position channels: a shoulder blade that slides, a rig whose offsets are not
those of its performer. There a bone does not point where its joint's rotation says, but from the joint's position to
the next one's.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from marey_motion import kinematics, quaternions
from marey_motion.arrays import AnyFloats
from marey_motion.clip import Clip
from marey_motion.importing.checks import CheckWarning
from marey_motion.rigs.axes import bone_end

# Bones that turn less are left as their joints' rotations have them.
LEAST_TURN_DEG = 0.1
# Joints nearer to each other point nowhere.
SHORTEST_BONE_M = 1e-4


@dataclass(frozen=True, eq=False)
class FollowedBones:
    """Rotations of a clip that point its bones where its positions say.

    Parameters
    ----------
    rotations : (F, 4·J) float32    local rotations; the clip's own where no bone has moved
    largest_turn_deg : mapping of str to float    by name of each joint that was turned, its largest turn in any frame,
        degrees
    """

    rotations: NDArray[np.float32]
    largest_turn_deg: Mapping[str, float]

    @property
    def warning(self) -> CheckWarning | None:
        """A warning for the user, or None where no bone has moved."""
        if not self.largest_turn_deg:
            return None
        name, most = max(self.largest_turn_deg.items(), key=lambda item: item[1])
        return CheckWarning(
            "bones-moved-by-translations",
            f"joints move against their parents, so that {len(self.largest_turn_deg)} bones point elsewhere than their "
            f"rotations say, that of {name} by up to {most:.1f} degrees; where they really point was followed",
            joints=tuple(self.largest_turn_deg),
            values={"largest_turn_deg": most},
        )


def follow_moved_bones(clip: Clip, joints: Mapping[str, int]) -> FollowedBones:
    """Rotate each joint the shortest way from its bone's direction without translations to its real one.

    Parameters
    ----------
    clip : Clip    F frames of J joints
    joints : mapping of str to int    joints by standard name whose bones are compared

    Returns
    -------
    FollowedBones    rotations (F, 4·J) float32 and the largest turns in degrees
    """
    own = clip.poses[:, 3:]
    if clip.translations is None:
        return FollowedBones(own, {})
    still = replace(clip, translations=None, translated_joints=())
    rigid, moved = (kinematics.global_positions(one).astype(np.float64) for one in (still, clip))
    turned = kinematics.global_rotations(clip).astype(np.float64)
    largest: dict[str, float] = {}
    for standard, joint in joints.items():
        end = bone_end(standard, joints)
        name = clip.skeleton.joint_names[joint]
        if end is None or name in largest:
            continue
        turns = _turns(*(points[:, joints[end]] - points[:, joint] for points in (rigid, moved)))
        most = float(np.degrees(quaternions.angle_between(turns, quaternions.identity(len(turns)))).max())
        if most >= LEAST_TURN_DEG:
            largest[name] = most
            turned[:, joint] = quaternions.multiply(turns, turned[:, joint])
    if not largest:
        return FollowedBones(own, {})
    local = kinematics.as_local_rotations(clip.skeleton, turned)
    return FollowedBones(local.reshape(len(own), -1).astype(np.float32), largest)


def _turns(rigid: AnyFloats, moved: AnyFloats) -> AnyFloats:
    """Compute the shortest rotations (F, 4) between bones (F, 3); none where one of them has no length."""
    turns = quaternions.identity(len(rigid)).astype(np.float64)
    lengths = [np.linalg.norm(bones, axis=1) for bones in (rigid, moved)]
    known = np.minimum(*lengths) > SHORTEST_BONE_M
    if known.any():
        turns[known] = quaternions.between_vectors(rigid[known], moved[known])
    return turns
