"""The same motion with left and right exchanged."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from marey_motion import kinematics, quaternions
from marey_motion.clip import Clip
from marey_motion.resampling import Motion
from marey_motion.skeleton import Skeleton

Floats = NDArray[np.float64]

REFLECTED = np.array((-1.0, 1.0, 1.0))
_CONJUGATED = np.array((1.0, 1.0, -1.0, -1.0))


def mirror_clip(clip: Clip, partners: NDArray[np.int32]) -> Clip:
    """A clip reflected in the plane x = 0, each joint moving as its partner (J,) on the other side did.

    Works for any local axes: see `mirror_motion`.
    """
    motion = mirror_motion(clip.skeleton, partners, Motion.of(clip), clip.translated_joints)
    poses = np.concatenate((motion.root_translations, motion.rotations.reshape(clip.frame_count, -1)), axis=1)
    translations = None if clip.translations is None else motion.translations.astype(np.float32)
    return Clip(clip.skeleton, clip.frame_rate_hz, poses.astype(np.float32), translations, clip.translated_joints)


def mirror_motion(
    skeleton: Skeleton, partners: NDArray[np.int32], motion: Motion, translated_joints: tuple[int, ...]
) -> Motion:
    """As `mirror_clip`, in double precision.

    A joint's mirrored rotation is the reflection of its partner's, in the joint's own local axes: these may differ from
    the partner's reflected ones by a constant rotation, found from the rest pose and the offsets of the children.
    """
    world = kinematics.as_global_rotations(skeleton, motion.rotations)
    corrections = _frame_corrections(skeleton, tuple(int(partner) for partner in partners))
    mirrored = quaternions.multiply(_reflected(world[:, partners]), corrections)
    local = quaternions.unroll(kinematics.as_local_rotations(skeleton, mirrored))
    return Motion(
        motion.root_translations * REFLECTED,
        np.asarray(local, dtype=np.float64),
        _mirrored_translations(skeleton, partners, motion.translations, translated_joints, corrections),
    )


def _reflected(rotations: Floats) -> Floats:
    """Rotations as a mirror in the plane x = 0 shows them."""
    return rotations * _CONJUGATED


def _mirrored_translations(
    skeleton: Skeleton,
    partners: NDArray[np.int32],
    translations: Floats,
    translated_joints: tuple[int, ...],
    corrections: Floats,
) -> Floats:
    """Local positions of the translated joints; a partner that keeps its offset brings that one."""
    slots = {joint: slot for slot, joint in enumerate(translated_joints)}
    mirrored = np.empty_like(translations)
    for slot, joint in enumerate(translated_joints):
        partner = int(partners[joint])
        theirs = translations[:, slots[partner]] if partner in slots else skeleton.offsets[partner]
        frame = quaternions.conjugate(corrections[skeleton.parents[joint]])
        mirrored[:, slot] = quaternions.rotate_vectors(frame, theirs * REFLECTED)
    return mirrored


@lru_cache(maxsize=64)
def _frame_corrections(skeleton: Skeleton, partners: tuple[int, ...]) -> Floats:
    """(J, 4) rotation from each joint's local axes to the reflected ones of its partner."""
    rest = kinematics.as_global_rotations(skeleton, skeleton.rest_rotations[None])[0]
    corrections = np.asarray(
        quaternions.multiply(quaternions.conjugate(_reflected(rest[list(partners)])), rest), dtype=np.float64
    )
    children: dict[int, list[int]] = {}
    for child, parent in enumerate(skeleton.parents.tolist()):
        if parent >= 0:
            children.setdefault(parent, []).append(child)
    for joint, own in children.items():
        # Children whose partner hangs elsewhere say nothing about this joint.
        pairs = [child for child in own if skeleton.parents[partners[child]] == partners[joint]]
        ours = skeleton.offsets[pairs]
        theirs = skeleton.offsets[[partners[child] for child in pairs]] * REFLECTED
        corrections[joint] = _turned_onto(corrections[joint], ours, theirs)
    return corrections


def _turned_onto(correction: Floats, ours: Floats, theirs: Floats) -> Floats:
    """The correction, turned as little as it takes for the directions `ours` (n, 3) to come to lie on `theirs`."""
    lengths = np.linalg.norm(ours, axis=1), np.linalg.norm(theirs, axis=1)
    telling = (lengths[0] > 1e-6) & (lengths[1] > 1e-6)
    if not telling.any():
        return correction
    turned = quaternions.rotate_vectors(correction, ours[telling] / lengths[0][telling, None])
    wanted = theirs[telling] / lengths[1][telling, None]
    cosines = np.sum(turned * wanted, axis=1)
    if np.all(cosines > np.cos(0.05)):  # sides measured apart differ a little and mean the same axes
        return correction
    if telling.sum() == 1:
        return np.asarray(quaternions.multiply(quaternions.between_vectors(turned[0], wanted[0]), correction))
    from scipy.spatial.transform import Rotation

    best, _ = Rotation.align_vectors(wanted, turned)
    return np.asarray(quaternions.multiply(best.as_quat(scalar_first=True), correction))
