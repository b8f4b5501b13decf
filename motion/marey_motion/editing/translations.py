"""What joints other than the root move by, made comparable between motions."""

from __future__ import annotations

import numpy as np

from marey_motion.motion import Motion
from marey_motion.skeleton import Skeleton


def translated(motion: Motion, skeleton: Skeleton, joints: tuple[int, ...]) -> Motion:
    """The same motion with translations of `joints`, increasing and at least those it has: offsets for the others."""
    if joints == motion.translated_joints:
        return motion
    translations = np.empty((motion.frame_count, len(joints), 3))
    translations[:] = skeleton.offsets[list(joints)]
    translations[:, [joints.index(joint) for joint in motion.translated_joints]] = motion.translations
    return motion._replace(translations=translations, translated_joints=joints)


def with_equal_joints(a: Motion, b: Motion, skeleton: Skeleton) -> tuple[Motion, Motion]:
    """Two motions of one skeleton, with translations of the same joints."""
    joints = tuple(sorted({*a.translated_joints, *b.translated_joints}))
    return translated(a, skeleton, joints), translated(b, skeleton, joints)
