"""Functions that add translations of joints to motions, so that two motions store translations for the same joints."""

from __future__ import annotations

import numpy as np

from marey_motion.motion import Motion
from marey_motion.skeleton import Skeleton


def translated(motion: Motion, skeleton: Skeleton, joints: tuple[int, ...]) -> Motion:
    """Add translations for further joints, equal to the offsets of these joints, so that the motion does not change.

    Parameters
    ----------
    motion : Motion    F frames
    skeleton : Skeleton    its skeleton
    joints : tuple of int    increasing indices, which include all joints that have translations already

    Returns
    -------
    Motion    the same motion with translations (F, k, 3) of these joints
    """
    if joints == motion.translated_joints:
        return motion
    translations = np.empty((motion.frame_count, len(joints), 3))
    translations[:] = skeleton.offsets[list(joints)]
    translations[:, [joints.index(joint) for joint in motion.translated_joints]] = motion.translations
    return motion._replace(translations=translations, translated_joints=joints)


def with_equal_joints(a: Motion, b: Motion, skeleton: Skeleton) -> tuple[Motion, Motion]:
    """Add translations to two motions of one skeleton, so that both store translations for the same joints.

    Afterwards, both motions store translations for every joint for which at least one of them stored translations.

    Parameters
    ----------
    a, b : Motion    the motions
    skeleton : Skeleton    their skeleton

    Returns
    -------
    (Motion, Motion)    `a` and `b` with the added translations; poses do not change
    """
    joints = tuple(sorted({*a.translated_joints, *b.translated_joints}))
    return translated(a, skeleton, joints), translated(b, skeleton, joints)
