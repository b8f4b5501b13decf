"""Transfer of poses: each joint of the target takes the orientation of its source joint.

Both skeletons give each joint two axes in its own frame: twist along the bone and swing across it (`rigs.guess_axes`).
A target joint gets the global orientation in which its two axes coincide with the two axes of the source joint with the
same standard name (Herrmann et al. 2019, Algorithm 1, after Monzani et al. 2000).

The paper rotates twist onto twist, then swing onto swing, for every pose. As both axes are fixed in their joints, this
is the same as one constant rotation per joint: with the axes of source and target as the columns of orthonormal
matrices S and T, the target's global orientation is G·S·Tᵀ if the source's global orientation is G. This module differs
from the printed algorithm in two ways. Here, the second rotation turns only about the twist axis, so it does not undo
the first rotation. And the second rotation is applied after the first one, whereas line 12 of the printed algorithm has
the opposite order.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from marey_motion import quaternions
from marey_motion.arrays import AnyFloats
from marey_motion.clip import Clip
from marey_motion.retargeting.planning import RetargetPlan
from marey_motion.skeleton import Skeleton


def transfer(clip: Clip, plan: RetargetPlan, rotations: NDArray[np.float32]) -> Clip:
    """Transfer the orientations of the source's joints to the target, and the scaled path of the source's anchors.

    Parameters
    ----------
    clip : Clip    F frames of the plan's source skeleton
    plan : RetargetPlan    joints, corrections and scale
    rotations : (F, 4·J) float32    local rotations of the source's J joints that are used instead of the clip's

    Returns
    -------
    Clip    F frames of the target skeleton
    """
    from marey_motion.retargeting import transfer_kernels as kernels

    target = plan.target
    modes = np.where(plan.sources >= 0, kernels.MAPPED, kernels.AT_REST).astype(np.int8)
    sources = plan.sources.copy()
    for name in plan.carried:
        joint = target.index_of(name)
        modes[joint], sources[joint] = kernels.CARRIED, joint
    poses = np.empty((clip.frame_count, 3 + 4 * target.joint_count), dtype=np.float32)
    kernels.rotations(
        rotations,
        plan.source.parents,
        modes,
        sources,
        plan.corrections,
        target.rest_rotations,
        target.parents,
        poses[:, 3:],
    )
    turned = poses[:, 3:].reshape(clip.frame_count, -1, 4)
    translations, joints = (clip.translations, clip.translated_joints) if plan.changes_no_pose else (None, ())
    moved = _offsets_by_joint(translations, joints)
    count = len(plan.anchors)
    travel = sum(_position_in_world(clip, clip.skeleton.index_of(pair.source)) for pair in plan.anchors) / count
    below = sum(_position_from_root(target, turned, target.index_of(pair.target), moved) for pair in plan.anchors)
    poses[:, :3] = plan.scale * travel - below / count
    return Clip(target, clip.frame_rate_hz, poses, translations, joints)


def _position_in_world(clip: Clip, joint: int) -> AnyFloats:
    """Compute positions (F, 3) of one joint of a clip, metres."""
    moved = _offsets_by_joint(clip.translations, clip.translated_joints)
    return clip.root_translations + _position_from_root(clip.skeleton, clip.rotations, joint, moved)


def _offsets_by_joint(translations: NDArray[np.float32] | None, joints: tuple[int, ...]) -> dict[int, AnyFloats]:
    """Return the translations (F, 3) of each of `joints`, by joint index; empty if `translations` is None."""
    return {} if translations is None else {joint: translations[:, slot] for slot, joint in enumerate(joints)}


def _position_from_root(
    skeleton: Skeleton, rotations: AnyFloats, joint: int, moved: Mapping[int, AnyFloats] = MappingProxyType({})
) -> AnyFloats:
    """Compute vectors (F, 3) from root to joint in the world; `moved` has the offsets (F, 3) of translated joints."""
    position: AnyFloats = np.zeros((len(rotations), 3))
    for step in skeleton.path_to_root(joint)[:-1]:
        offset = moved.get(step, skeleton.offsets[step])
        rotation = rotations[:, skeleton.parents[step]].astype(np.float64)
        position = quaternions.rotate_vectors(rotation, position + offset)
    return position
