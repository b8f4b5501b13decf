"""Signs of quaternions: q and -q are the same rotation, but averages and interpolations need a consistent sign."""

from __future__ import annotations

import numpy as np

from marey_motion import quaternions
from marey_motion.arrays import Floats


def consistent_signs(rotations: Floats, reference: Floats) -> Floats:
    """Choose the signs of quaternions so that the rotations of aligned clips can be averaged.

    The quaternions of each joint are first made continuous in time. Then the quaternions of the joint are negated in
    all frames if their mean dot product with the reference is negative. Choosing signs frame by frame would make the
    quaternions of a joint discontinuous where it turns by more than half a turn.

    Parameters
    ----------
    rotations : (m, N, J, 4) float64    rotations of m aligned clips
    reference : (N, J, 4) float64    rotations of the reference

    Returns
    -------
    (m, N, J, 4) float64    the same rotations, as quaternions with consistent signs
    """
    smooth = quaternions.unroll(rotations, axis=1)
    agreement = np.einsum("mfjc,fjc->mj", smooth, quaternions.unroll(reference, axis=0))
    return np.asarray(smooth * np.where(agreement < 0.0, -1.0, 1.0)[:, None, :, None], dtype=np.float64)


def consistent_poses(poses: Floats, reference: Floats) -> Floats:
    """Choose the signs of the quaternions in poses so that the poses of aligned clips can be averaged.

    The signs are those of `consistent_signs`; root translations stay unchanged.

    Parameters
    ----------
    poses : (m, N, 3 + 4·J) float64    root translations and rotations
    reference : (N, 3 + 4·J) float64    root translations and rotations of the reference

    Returns
    -------
    (m, N, 3 + 4·J) float64    the same poses, with consistent signs
    """
    clips, frames, _ = poses.shape
    rotations = consistent_signs(poses[..., 3:].reshape(clips, frames, -1, 4), reference[:, 3:].reshape(frames, -1, 4))
    return np.concatenate((poses[..., :3], rotations.reshape(clips, frames, -1)), axis=2)
