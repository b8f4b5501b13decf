"""Channel weights for principal component analysis: metres and quaternion components have no common unit."""

from __future__ import annotations

import numpy as np

from marey_motion import kinematics, quaternions
from marey_motion.arrays import Floats
from marey_motion.skeleton import Skeleton

LEAST_ROOT_EXTENT_M = 1e-3
"""Extent of a root axis, in metres, below which the axis is not scaled up to the size of the other axes."""

LEAST_WEIGHT_M = 0.01
"""Least weight of a joint, so that the rotation of a joint without children, such as a hand, is not ignored."""

MOST_DIFFERENCES = 1_000_000
"""Maximum number of differences of positions in memory at once."""


def root_max_weights(poses: Floats) -> Floats:
    """Compute weights that scale each root axis to a maximum of 1 (the default of Herrmann et al. 2019).

    Each axis is scaled by itself. An axis along which the root hardly moves is not scaled.

    Parameters
    ----------
    poses : (m, N, 3 + 4·J) float64    root translations in metres and local rotations

    Returns
    -------
    (3 + 4·J,) float64    weights, 1 for rotations
    """
    extents = np.abs(poses[..., :3]).max(axis=(0, 1))
    weights = np.ones(poses.shape[2])
    weights[:3] = np.where(extents > LEAST_ROOT_EXTENT_M, 1.0 / np.maximum(extents, LEAST_ROOT_EXTENT_M), 1.0)
    return weights


def jacobian_weights(skeleton: Skeleton, poses: Floats) -> Floats:
    """Compute weights that scale each channel by the distance that a unit step of the channel moves the body.

    A unit step of a joint's quaternion rotates the joints below it by 2 radians. The joint's weight is the root mean
    square of the displacements of all joints of the body: twice the lever arm for each joint below, and 0 for the other
    joints. (The mean over only the joints below would give a finger the weight of a spine.)

    Parameters
    ----------
    skeleton : Skeleton    J joints
    poses : (F, 3 + 4·J) float64    typical poses, such as those of the mean motion; their quaternions need not have
        unit length

    Returns
    -------
    (3 + 4·J,) float64    metres per unit of each channel: 1 for the root axes, at least `LEAST_WEIGHT_M` for rotations
    """
    rotations = quaternions.normalise(poses[:, 3:].reshape(len(poses), -1, 4)).reshape(len(poses), -1)
    joints = kinematics.forward_kinematics(skeleton, np.concatenate((poses[:, :3], rotations), axis=1))
    below = _descent(skeleton)
    squares = np.zeros(skeleton.joint_count)
    block = max(1, MOST_DIFFERENCES // skeleton.joint_count**2)
    for start in range(0, len(joints), block):
        some = joints[start : start + block]
        away = some[:, None, :, :] - some[:, :, None, :]
        squares += np.einsum("fjpc,fjpc,jp->j", away, away, below)
    squares /= len(joints) * skeleton.joint_count
    weights = np.ones(poses.shape[1])
    weights[3:] = np.repeat(np.maximum(2.0 * np.sqrt(squares), LEAST_WEIGHT_M), 4)
    return weights


def _descent(skeleton: Skeleton) -> Floats:
    """Make the matrix (J, J) that is 1 where the column's joint is a descendant of the row's joint, else 0."""
    below = np.zeros((skeleton.joint_count, skeleton.joint_count))
    for joint, parent in enumerate(skeleton.parents.tolist()):
        if parent >= 0:
            below[:, joint] = below[:, parent]
            below[parent, joint] = 1.0
    return below
