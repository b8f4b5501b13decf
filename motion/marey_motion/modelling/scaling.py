"""Weights of channels for the analysis of principal components: metres and parts of quaternions are no common unit."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from marey_motion import kinematics
from marey_motion.skeleton import Skeleton

Floats = NDArray[np.float64]

LEAST_ROOT_EXTENT_M = 1e-3
"""A root axis that stays within a millimetre is not blown up to the size of the others."""

LEAST_LEVER_M = 0.01
"""The lever of joints that carry nothing: how a hand is turned still counts a little."""


def root_max_weights(poses: Floats) -> Floats:
    """(D,) weights that bring each root axis of poses (m, N, D) to a maximum of 1, as the published code does.

    Each axis by itself; one that hardly moves keeps its unit.
    """
    extents = np.abs(poses[..., :3]).max(axis=(0, 1))
    weights = np.ones(poses.shape[2])
    weights[:3] = np.where(extents > LEAST_ROOT_EXTENT_M, 1.0 / np.maximum(extents, LEAST_ROOT_EXTENT_M), 1.0)
    return weights


def jacobian_weights(skeleton: Skeleton, poses: Floats) -> Floats:
    """(D,) weights under which every channel is in metres.

    A unit step of a joint's quaternion turns what it carries by 2 radians. Its weight is therefore twice the root mean
    square distance from the joint to the joints and end sites below it.

    Parameters
    ----------
    poses : (F, D) typical ones, as those of the mean motion
    """
    points = kinematics.forward_kinematics(skeleton, poses, end_sites=True)
    joints = skeleton.joint_count
    away = np.linalg.norm(points[:, None, :, :] - points[:, :joints, None, :], axis=3)
    below = _descent(skeleton)
    counts = np.maximum(below.sum(axis=1), 1)
    levers = np.sqrt(np.einsum("fjp,jp->j", away**2, below) / (counts * len(points)))
    weights = np.ones(poses.shape[1])
    weights[3:] = np.repeat(2.0 * np.maximum(levers, LEAST_LEVER_M), 4)
    return weights


def _descent(skeleton: Skeleton) -> Floats:
    """(J, J + E) 1 where a joint or an end site hangs below a joint, else 0."""
    joints = skeleton.joint_count
    below = np.zeros((joints, joints + len(skeleton.end_sites)))
    for point in range(1, joints + len(skeleton.end_sites)):
        carrier = int(skeleton.parents[point]) if point < joints else skeleton.end_sites[point - joints].joint
        below[list(skeleton.path_to_root(carrier)), point] = 1.0
    return below
