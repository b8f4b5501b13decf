"""Folding of positions: motion of joints below the root moves to the root, for programs that ignore their positions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from marey_motion.clip import Clip
from marey_motion.kinematics import global_positions
from marey_motion.skeleton import Skeleton


def with_folded_positions(clip: Clip) -> Clip:
    """Make a clip in which only the root is translated.

    Some exporters write the path of the body to the hips below a root that stands still. The root takes over the motion
    of such a joint: the joint that carries more than half of the joints, and is nearest to the root. It and the joints
    below it stay exactly where they were. The other translated joints get their median translations as offsets, so the
    joints below them move by what their bones stretch.

    Parameters
    ----------
    clip : Clip    F frames, any translated joints

    Returns
    -------
    Clip    F frames without translations; its skeleton has other offsets if several joints were translated
    """
    if clip.translations is None:
        return clip
    skeleton = clip.skeleton
    offsets = skeleton.offsets.copy()
    carrier = _carrier(skeleton, clip.translated_joints)
    for slot, joint in enumerate(clip.translated_joints):
        if joint != carrier:
            offsets[joint] = np.median(clip.translations[:, slot].astype(np.float64), axis=0)
    still = Clip(replace(skeleton, offsets=offsets), clip.frame_rate_hz, clip.poses)
    if carrier is None:
        return still
    poses = clip.poses.copy()
    poses[:, :3] += global_positions(clip)[:, carrier] - global_positions(still)[:, carrier]
    return replace(still, poses=poses)


def _carrier(skeleton: Skeleton, translated: tuple[int, ...]) -> int | None:
    """Return the translated joint nearest to the root with more than half of the joints at or below it, or None."""
    below: NDArray[np.int64] = np.ones(skeleton.joint_count, np.int64)
    for joint in range(skeleton.joint_count - 1, 0, -1):
        below[skeleton.parents[joint]] += below[joint]
    return next((joint for joint in translated if 2 * below[joint] > skeleton.joint_count), None)
