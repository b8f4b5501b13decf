"""Joints above the one that carries the body: a static reference on the floor, or a root that goes along with the body.

They only move the whole body about: what they do, the carrier may undo. Blended one by one, both cancel no longer and
the body leaves its path. So the body goes first here, and they follow.
"""

from __future__ import annotations

import numpy as np

from marey_motion import quaternions
from marey_motion.arrays import Floats
from marey_motion.motion import Motion
from marey_motion.skeleton import Skeleton

STILL = 1e-5
"""Components of rotations that do not turn vary by less: single precision and its rounding."""


def carried_at(motion: Motion, skeleton: Skeleton, carrier: int, places: Floats, spins: Floats) -> Motion:
    """The motion with the joint `carrier` at `places` (F, 3), its rotations in the world being `spins` (F, 4).

    The root is moved along, and what it carries keeps its rotations; translations of `carrier` and of joints above it
    go into those of the root.
    """
    above = skeleton.path_to_root(carrier)[:0:-1]
    arm = np.zeros((motion.frame_count, 3))
    parent = quaternions.identity(motion.frame_count)
    for joint, child in zip(above, (*above, carrier)[1:], strict=True):
        parent = quaternions.multiply(parent, motion.rotations[:, joint])
        arm += quaternions.rotate_vectors(parent, skeleton.offsets[child])
    rotations = motion.rotations.copy()
    rotations[:, carrier] = quaternions.multiply(quaternions.conjugate(parent), spins)
    return _without_translations(motion, (*above, carrier))._replace(
        root_translations=np.asarray(places - arm, dtype=np.float64), rotations=rotations
    )


def spins_of(motion: Motion, skeleton: Skeleton, joint: int) -> Floats:
    """Rotations (F, 4) of a joint in the world."""
    spins = quaternions.identity(motion.frame_count)
    for one in skeleton.path_to_root(joint)[::-1]:
        spins = quaternions.multiply(spins, motion.rotations[:, one])
    return np.asarray(spins, dtype=np.float64)


def root_stands(motion: Motion, skeleton: Skeleton, carrier: int) -> bool:
    """Whether nothing above the carrier ever turns, as with a static reference; no where the root is the carrier."""
    above = motion.rotations[:, skeleton.path_to_root(carrier)[1:]]
    return above.size > 0 and bool(np.ptp(above, axis=0).max() < STILL)


def body_first(motion: Motion, skeleton: Skeleton, carrier: int, *, root_stays: bool) -> Motion:
    """The motion with the carrier in the root's place and the root in the carrier's.

    What then moves, turns and blends the root does so with the body, wherever the root of the skeleton is.

    Parameters
    ----------
    root_stays : the root is a reference whose rotation is none of the body's business; else it turns with the body
    """
    if not carrier:
        return motion
    spins, root = spins_of(motion, skeleton, carrier), motion.rotations[:, 0]
    rotations = motion.rotations.copy()
    rotations[:, 0] = spins
    rotations[:, carrier] = root if root_stays else quaternions.multiply(quaternions.conjugate(spins), root)
    return _without_translations(motion, skeleton.path_to_root(carrier))._replace(
        root_translations=motion.positions(skeleton)[:, carrier], rotations=rotations
    )


def root_first(motion: Motion, skeleton: Skeleton, carrier: int, *, root_stays: bool) -> Motion:
    """The inverse of `body_first`; the travel of the body is then the root's."""
    if not carrier:
        return motion
    spins, root = motion.rotations[:, 0], motion.rotations[:, carrier]
    rotations = motion.rotations.copy()
    rotations[:, 0] = root if root_stays else quaternions.multiply(spins, root)
    return carried_at(motion._replace(rotations=rotations), skeleton, carrier, motion.root_translations, spins)


def _without_translations(motion: Motion, joints: tuple[int, ...]) -> Motion:
    kept = [slot for slot, joint in enumerate(motion.translated_joints) if joint not in joints]
    return motion._replace(
        translations=motion.translations[:, kept],
        translated_joints=tuple(motion.translated_joints[slot] for slot in kept),
    )
