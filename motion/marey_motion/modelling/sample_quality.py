"""Defects of motions drawn from a model: feet below the floor, feet that slide, unusual durations."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from marey_motion import kinematics
from marey_motion.arrays import CM_PER_M, Floats
from marey_motion.skeleton import Skeleton
from marey_schemas.options.contacts import TOE_SPEED_M_S


@dataclass(frozen=True)
class FootQuality:
    """Measures of feet in motions: frames below the floor and sliding of the joints that touch the ground.

    Parameters
    ----------
    below_floor_share : share of frames in which at least one foot is under height 0
    below_floor_mean_cm : mean depth of the lowest foot in those frames; 0 if there are none
    lowest_cm : lowest height of a foot in a motion, mean over the motions
    slide_m_s : mean horizontal speed over all feet and, for each foot, the steps of canonical time in which the foot is
        on the ground in most training examples; 0 if there are no such steps
    """

    below_floor_share: float
    below_floor_mean_cm: float
    lowest_cm: float
    slide_m_s: float


def foot_speeds(toes: Floats, time_functions: Floats, frame_rate_hz: float) -> Floats:
    """Compute the horizontal speeds of feet in each step of canonical time.

    Parameters
    ----------
    toes : (m, N, k, 3) float64    positions of k toes in m motions at N canonical frames, metres
    time_functions : (m, N) float64    frames of real time at each canonical frame
    frame_rate_hz : float    frames of real time per second

    Returns
    -------
    (m, N - 1, k) float64    metres per second
    """
    moved = np.linalg.norm(np.diff(toes[..., (0, 2)], axis=1), axis=-1)
    return np.asarray(moved / np.diff(time_functions, axis=1)[..., None] * frame_rate_hz)


def standing_steps(toes: Floats, time_functions: Floats, frame_rate_hz: float) -> NDArray[np.bool_]:
    """Find the steps in which most examples have a foot on the ground.

    A foot counts as on the ground while its speed in three dimensions is below the limit for contacts.

    Parameters
    ----------
    toes : (m, N, k, 3) float64    positions of k toes in m motions at N canonical frames, metres
    time_functions : (m, N) float64    frames of real time at each canonical frame
    frame_rate_hz : float    frames of real time per second

    Returns
    -------
    (N - 1, k) bool    True where the foot is on the ground
    """
    moved = np.linalg.norm(np.diff(toes, axis=1), axis=-1)
    speeds = moved / np.diff(time_functions, axis=1)[..., None] * frame_rate_hz
    return np.asarray((speeds < TOE_SPEED_M_S).mean(axis=0) > 0.5)


def foot_quality(
    toes: Floats, time_functions: Floats, frame_rate_hz: float, standing: NDArray[np.bool_]
) -> FootQuality:
    """Measure the feet of motions.

    Parameters
    ----------
    toes : (m, N, k, 3) float64    positions of k toes in m motions at N canonical frames, metres
    time_functions : (m, N) float64    frames of real time at each canonical frame
    frame_rate_hz : float    frames of real time per second
    standing : (N - 1, k) bool    result of `standing_steps` for the training examples

    Returns
    -------
    FootQuality    depth below the floor and sliding speed
    """
    lowest = toes[..., 1].min(axis=2)
    below = lowest < 0.0
    speeds = foot_speeds(toes, time_functions, frame_rate_hz)[:, standing]
    return FootQuality(
        below_floor_share=float(below.mean()),
        below_floor_mean_cm=float(-lowest[below].mean() * CM_PER_M) if below.any() else 0.0,
        lowest_cm=float(lowest.min(axis=1).mean() * CM_PER_M),
        slide_m_s=float(speeds.mean()) if speeds.size else 0.0,
    )


def joint_positions(skeleton: Skeleton, poses: Floats, joints: tuple[int, ...]) -> Floats:
    """Compute the positions of joints in poses.

    Parameters
    ----------
    skeleton : Skeleton    J joints
    poses : (m, N, 3 + 4·J) float64    root translations in metres and local rotations (w, x, y, z)
    joints : tuple of int    indices of k joints

    Returns
    -------
    (m, N, k, 3) float64    metres
    """
    motions, frames, width = poses.shape
    positions = kinematics.forward_kinematics(skeleton, np.ascontiguousarray(poses).reshape(-1, width))
    return np.asarray(positions[:, list(joints)].reshape(motions, frames, len(joints), 3), dtype=np.float64)
