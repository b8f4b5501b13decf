"""Handling of joints above the joint that carries the body (the carrier, usually the pelvis).

Examples are a static reference on the floor and a root that moves with the body. Joints above the carrier move the
whole body, and the motion of the carrier may cancel the motion of these joints. If the root and the carrier are blended
separately, their motions no longer cancel, and the body leaves its path. These functions therefore swap the two: the
carrier becomes the first joint, and the root follows it.
"""

from __future__ import annotations

import numpy as np

from marey_motion import quaternions
from marey_motion.arrays import AnyFloats, Floats
from marey_motion.motion import Motion
from marey_motion.skeleton import Skeleton

STILL = 1e-5
"""A rotation whose components vary by less than this is constant; rounding to float32 causes less variation."""


def carried_at(motion: Motion, skeleton: Skeleton, carrier: int, places: Floats, spins: Floats) -> Motion:
    """Place the carrier at given positions and rotations in the world; the root moves along.

    The translations of the root and the local rotations of the carrier are replaced, and the joints between them keep
    their local rotations. The carrier and the joints above it have no translations of their own in the result.

    Parameters
    ----------
    motion : Motion    F frames
    skeleton : Skeleton    its joints
    carrier : int    joint that carries the body
    places : (F, 3) float64    new positions of the carrier in the world, metres
    spins : (F, 4) float64    new rotations of the carrier in the world

    Returns
    -------
    Motion    the motion with the carrier at these positions and rotations
    """
    above = skeleton.path_to_root(carrier)[:0:-1]
    arm = np.zeros((motion.frame_count, 3))
    parent: AnyFloats = quaternions.identity(motion.frame_count)
    for joint, child in zip(above, (*above, carrier)[1:], strict=True):
        parent = quaternions.multiply(parent, motion.rotations[:, joint])
        arm += quaternions.rotate_vectors(parent, skeleton.offsets[child])
    rotations = motion.rotations.copy()
    rotations[:, carrier] = quaternions.multiply(quaternions.conjugate(parent), spins)
    return _without_translations(motion, (*above, carrier))._replace(
        root_translations=np.asarray(places - arm, dtype=np.float64), rotations=rotations
    )


def spins_of(motion: Motion, skeleton: Skeleton, joint: int) -> Floats:
    """Compute the rotations of one joint in the world.

    Parameters
    ----------
    motion : Motion    F frames
    skeleton : Skeleton    its joints
    joint : int    index of the joint

    Returns
    -------
    (F, 4) float64    unit quaternions
    """
    spins: AnyFloats = quaternions.identity(motion.frame_count)
    for one in skeleton.path_to_root(joint)[::-1]:
        spins = quaternions.multiply(spins, motion.rotations[:, one])
    return np.asarray(spins, dtype=np.float64)


def root_stands(motion: Motion, skeleton: Skeleton, carrier: int) -> bool:
    """Check whether all joints above the carrier keep their rotations, as they do if the root is a static reference.

    Parameters
    ----------
    motion : Motion    F frames
    skeleton : Skeleton    its joints
    carrier : int    joint that carries the body

    Returns
    -------
    bool    True if no joint above the carrier turns; False also if the root is the carrier
    """
    above = motion.rotations[:, skeleton.path_to_root(carrier)[1:]]
    return above.size > 0 and bool(np.ptp(above, axis=0).max() < STILL)


def body_first(motion: Motion, skeleton: Skeleton, carrier: int, *, root_stays: bool) -> Motion:
    """Swap the carrier and the root, so that moving, turning and blending the root moves the body.

    Parameters
    ----------
    motion : Motion    F frames
    skeleton : Skeleton    its joints
    carrier : int    joint that carries the body
    root_stays : bool    True if the root is a static reference, whose rotation does not depend on the body; False if
        the root turns with the body

    Returns
    -------
    Motion    the motion with the root and the carrier swapped; unchanged if the root is the carrier
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
    """Undo `body_first`: make the root the first joint again, and move the body by the root's translations.

    Parameters
    ----------
    motion : Motion    result of `body_first`, or an edit of it
    skeleton : Skeleton    its joints
    carrier : int    joint that carries the body
    root_stays : bool    True if the root is a static reference, whose rotation does not depend on the body; the same
        value as for `body_first`

    Returns
    -------
    Motion    the motion with the root and the carrier in their original places
    """
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
