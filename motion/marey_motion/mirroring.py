"""Clips reflected from left to right."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from marey_motion import quaternions
from marey_motion.arrays import AnyInts, Floats
from marey_motion.clip import Clip
from marey_motion.errors import MotionError
from marey_motion.motion import Motion
from marey_motion.skeleton import Skeleton

REFLECTION = np.diag([-1.0, 1.0, 1.0])
HALF_TURN_ABOUT_X = np.array([0.0, 1.0, 0.0, 0.0])
# Greatest angle between bones and their mirrored counterparts in a symmetric rest pose; measured sides differ a little.
SAME_DIRECTION_RAD = 0.05
# Least share of the spread of a joint's bones that must lie beside the longest direction to determine its twist.
SPREAD = 1e-3


@dataclass(frozen=True, eq=False)
class _Mirror:
    """Constants of mirroring the joints of a skeleton.

    Parameters
    ----------
    sources : (J,) index of the joint (the source) from which each joint gets its motion
    frames : (J, 3, 3) improper matrices that map the local axes of the source to the local axes of the joint
    outer, inner : (J, 4) rotations to multiply the source's local rotation with, from the left and from the right
    carried : (J,) True for joints that have no counterpart and keep their local motion
    """

    sources: NDArray[np.int64]
    frames: Floats
    outer: Floats
    inner: Floats
    carried: NDArray[np.bool_]


def mirror_clip(clip: Clip, partners: AnyInts) -> Clip:
    """Reflect a motion in x, which exchanges the motion of left and right limbs.

    The result is exact if both sides have the same bone lengths, whatever the rest pose and the joints' local axes;
    reflecting twice gives the original motion. A joint that has no counterpart, such as a prop in one hand, moves with
    its parent as before.

    Parameters
    ----------
    clip : Clip    F frames of J joints
    partners : (J,) int    each joint's partner on the other side; joints of the centre are their own partners
        (`rigs.symmetric_joints`)

    Returns
    -------
    Clip    the mirrored copy; global positions are reflected in x

    Raises
    ------
    MotionError    if `partners` is not a pairing of the skeleton's joints

    Notes
    -----
    Let M be the reflection in x, G global and L local rotations before mirroring, and F_j the constant matrix that maps
    the local axes of the partner p to those of the joint j. F_j mirrors, so -F_j is a rotation. The mirrored global
    rotation of j is M·G_p·F_j⁻¹, and the mirrored local rotation is F_parent·L_p·F_j⁻¹. F_j is computed from the rest
    pose; if the rest pose is not symmetric, F_j is corrected so that it maps the partner's bones to those of the joint.
    """
    mirrored = mirror_motion(clip.skeleton, partners, Motion.of(clip))
    return mirrored.as_clip(clip.skeleton, clip.frame_rate_hz)


def mirror_motion(skeleton: Skeleton, partners: AnyInts, motion: Motion) -> Motion:
    """Reflect a motion in x, which exchanges the motion of left and right limbs, in double precision.

    Parameters
    ----------
    skeleton : Skeleton    J joints
    partners : (J,) int    each joint's partner on the other side
    motion : Motion    F frames

    Returns
    -------
    Motion    the mirrored copy

    Raises
    ------
    MotionError    if `partners` is not a pairing of the skeleton's joints
    """
    mirror = _mirror_of(skeleton, tuple(int(partner) for partner in partners))
    rotations = quaternions.multiply(mirror.outer, motion.rotations[:, mirror.sources])
    rotations = quaternions.multiply(rotations, mirror.inner)
    translations, joints = _mirrored_translations(skeleton, mirror, motion)
    return Motion(
        motion.root_translations * np.diagonal(REFLECTION),
        np.asarray(rotations, dtype=np.float64),
        translations,
        joints,
    )


@lru_cache(maxsize=16)
def _mirror_of(skeleton: Skeleton, pairing: tuple[int, ...]) -> _Mirror:
    partners = np.array(pairing)
    count = skeleton.joint_count
    if partners.shape != (count,) or not np.array_equal(np.sort(partners), np.arange(count)):
        raise MotionError(
            f"each of the {count} joints needs one partner, and no two joints may have the same partner",
            where="partners",
        )
    if partners[0] != 0 or not np.array_equal(partners[partners], np.arange(count)):
        raise MotionError("partners must be mutual, and the root must be its own partner", where="partners")
    sources = partners.astype(np.int64)
    carried = np.zeros(count, np.bool_)
    for joint in range(1, count):
        parent, other = skeleton.parents[joint], skeleton.parents[sources[joint]]
        carried[joint] = sources[parent] != other or carried[parent]
    sources[carried] = np.flatnonzero(carried)
    frames = np.stack([_frame(skeleton, sources, carried, joint) for joint in range(count)])
    return _Mirror(sources, frames, *_turns(skeleton, frames, carried), carried)


def _frame(skeleton: Skeleton, sources: NDArray[np.int64], carried: NDArray[np.bool_], joint: int) -> Floats:
    """Return the improper matrix (3, 3) that maps the local axes of a joint's source to those of the joint.

    The source is the joint from which the joint gets its motion. `sources` (J,) are the sources of all joints;
    `carried` (J,) is True for joints without a counterpart, which keep their local motion.
    """
    source = sources[joint]
    rest = quaternions.as_matrix(skeleton.rest_global_rotations[[joint, source]])
    by_rest = rest[0].T @ REFLECTION @ rest[1]
    own = [child for child in skeleton.children[joint] if not carried[child]]
    bones = [(skeleton.offsets[child], skeleton.offsets[sources[child]]) for child in own]
    tips, others = ([site.offset for site in skeleton.end_sites if site.joint == one] for one in (joint, source))
    if len(tips) == len(others):
        bones += zip(tips, others, strict=True)
    own_bones, other_bones = np.array(bones, dtype=np.float64).reshape(-1, 2, 3).swapaxes(0, 1)
    return _frame_of_bones(by_rest, own_bones, other_bones)


def _frame_of_bones(by_rest: Floats, bones: Floats, partners: Floats) -> Floats:
    """Find the mirroring matrix (3, 3) that best maps `partners` to `bones`.

    `bones` (n, 3) are the offsets of a joint's children, and `partners` (n, 3) those of the children of the joint whose
    motion it gets. `by_rest` is the matrix according to the rest poses. It is returned if it maps the directions of
    the bones well enough. If the bones do not determine a matrix, it is rotated until the main direction fits.
    """
    seen = partners @ by_rest.T
    lengths = np.linalg.norm(bones, axis=1) * np.linalg.norm(seen, axis=1)
    if np.all(np.sum(bones * seen, axis=1) >= np.cos(SAME_DIRECTION_RAD) * lengths):
        return by_rest
    left, sizes, right = np.linalg.svd(bones.T @ partners)
    if sizes[1] > SPREAD * sizes[0]:  # the orthogonal Procrustes problem among matrices that mirror
        sign = -np.sign(np.linalg.det(left) * np.linalg.det(right))
        return np.asarray(left @ np.diag([1.0, 1.0, sign]) @ right, dtype=np.float64)
    correction = quaternions.between_vectors(by_rest @ right[0], left[:, 0])
    return np.asarray(quaternions.as_matrix(correction) @ by_rest, dtype=np.float64)


def _turns(skeleton: Skeleton, frames: Floats, carried: NDArray[np.bool_]) -> tuple[Floats, Floats]:
    rotations = np.asarray(quaternions.from_matrix(-frames), dtype=np.float64)
    outer = np.concatenate((HALF_TURN_ABOUT_X[None], rotations[skeleton.parents[1:]]))
    inner = np.asarray(quaternions.conjugate(rotations), dtype=np.float64)
    outer[carried] = inner[carried] = quaternions.identity()
    return outer, inner


def _mirrored_translations(skeleton: Skeleton, mirror: _Mirror, motion: Motion) -> tuple[Floats, tuple[int, ...]]:
    """Mirror the translations of joints.

    Each joint gets the mirrored translations of its counterpart on the other side, in the axes of the joint's own
    parent.
    """
    if not motion.translated_joints:
        return motion.translations, ()
    moving = np.array(motion.translated_joints)
    joints = np.union1d(moving, mirror.sources[moving])
    every = np.empty((motion.frame_count, skeleton.joint_count, 3))
    every[:] = skeleton.offsets
    every[:, moving] = motion.translations
    frames = mirror.frames[skeleton.parents[joints]]
    frames[mirror.carried[joints]] = np.eye(3)
    mirrored = np.einsum("kab,fkb->fka", frames, every[:, mirror.sources[joints]])
    return mirrored, tuple(int(joint) for joint in joints)
