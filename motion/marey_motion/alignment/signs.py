"""Signs of quaternions: q and -q are one rotation, but two points for the mathematics of functions."""

from __future__ import annotations

import numpy as np

from marey_motion import quaternions
from marey_motion.arrays import Floats


def consistent_signs(rotations: Floats, reference: Floats) -> Floats:
    """Rotations (m, N, J, 4) of m aligned clips with signs under which they can be averaged.

    Each joint is made continuous in time first; then its whole course is turned over where its mean dot product with
    that of the reference (N, J, 4) is negative. Deciding frame by frame instead would cut the course of a joint that
    turns by more than half a turn.
    """
    smooth = quaternions.unroll(rotations, axis=1)
    agreement = np.einsum("mfjc,fjc->mj", smooth, quaternions.unroll(reference, axis=0))
    return np.asarray(smooth * np.where(agreement < 0.0, -1.0, 1.0)[:, None, :, None], dtype=np.float64)


def consistent_poses(poses: Floats, reference: Floats) -> Floats:
    """Poses (m, N, 3 + 4·J) with the signs of `consistent_signs`; the reference is (N, 3 + 4·J)."""
    clips, frames, _ = poses.shape
    rotations = consistent_signs(poses[..., 3:].reshape(clips, frames, -1, 4), reference[:, 3:].reshape(frames, -1, 4))
    return np.concatenate((poses[..., :3], rotations.reshape(clips, frames, -1)), axis=2)
