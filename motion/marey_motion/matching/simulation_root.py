"""Smoothed position and heading of a body on the ground, suitable for steering."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from marey_motion import quaternions
from marey_motion.arrays import Floats
from marey_motion.kinematics import forward_directions, headings
from marey_motion.matching.body import MatchingBody
from marey_motion.motion import Motion

POSITION_WINDOW_S = 0.5
DIRECTION_WINDOW_S = 1.0
FILTER_ORDER = 3
SHORTEST_WINDOW = 5
# A body that spins has no mean direction: where that is shorter than this, the direction of the moment counts.
SHORTEST_MEAN = 1e-3


class SimulationRoot(NamedTuple):
    """A root on the ground.

    Parameters
    ----------
    positions : (F, 2) float64    (x, z) in metres
    headings : (F,) float64    radians, continuous in time
    """

    positions: Floats
    headings: Floats


def simulation_root(positions: Floats, body: MatchingBody, rate_hz: float) -> SimulationRoot:
    """Compute the smoothed ground projection of the torso, with the mean heading of hips and shoulders.

    Parameters
    ----------
    positions : (F, J, 3) float64    positions of all joints, metres
    body : MatchingBody    the joints
    rate_hz : float    frames per second

    Returns
    -------
    SimulationRoot    F frames

    Raises
    ------
    MotionError    if no frame has a facing direction

    Notes
    -----
    Savitzky-Golay filters of third order smooth the position over 0.5 s and the facing direction over 1 s, as is usual
    for motion matching; for shorter clips, the windows are shorter. To smooth a loop across its seam, extend it with
    `looping.continue_motion` before you call this function.
    """
    raw = raw_root(positions, body)
    facing = np.stack((np.sin(raw.headings), np.cos(raw.headings)), axis=-1)
    mean = _smoothed(facing, window_frames(DIRECTION_WINDOW_S, rate_hz))
    length = np.hypot(mean[:, 0], mean[:, 1])[:, None]
    directions = np.where(length > SHORTEST_MEAN, mean, facing)
    return SimulationRoot(_smoothed(raw.positions, window_frames(POSITION_WINDOW_S, rate_hz)), headings(directions))


def raw_root(positions: Floats, body: MatchingBody) -> SimulationRoot:
    """Compute the ground projection of the torso, with the mean heading of hips and shoulders, without smoothing.

    Parameters
    ----------
    positions : (F, J, 3) float64    positions of all joints, metres
    body : MatchingBody    the joints

    Returns
    -------
    SimulationRoot    F frames

    Raises
    ------
    MotionError    if no frame has a facing direction
    """
    facing = forward_directions(positions, body.lefts, body.rights)
    return SimulationRoot(positions[:, body.torso, ::2], headings(facing))


def bone_root(motion: Motion, body: MatchingBody) -> SimulationRoot:
    """Compute the motion of the root joint on the ground, for data whose root joint is meant to steer the character.

    The heading is the heading of the rest pose plus the rotation of the root joint about the vertical.

    Parameters
    ----------
    motion : Motion    F frames
    body : MatchingBody    the joints

    Returns
    -------
    SimulationRoot    F frames

    Raises
    ------
    MotionError    if the rest pose has no facing direction
    """
    skeleton = body.skeleton
    rest = rest_heading(body)
    turns = quaternions.multiply(motion.rotations[:, 0], quaternions.conjugate(skeleton.rest_rotations[0]))
    twist = 2.0 * np.arctan2(turns[:, 2], turns[:, 0])
    return SimulationRoot(motion.root_translations[:, ::2], np.unwrap(twist + rest))


def rest_heading(body: MatchingBody) -> float:
    """Compute the heading of the rest pose.

    Parameters
    ----------
    body : MatchingBody    the joints

    Returns
    -------
    float    radians

    Raises
    ------
    MotionError    if the body faces no direction on the ground in the rest pose
    """
    positions = body.skeleton.rest_global_positions[None]
    return float(headings(forward_directions(positions, body.lefts, body.rights))[0])


def window_frames(window_s: float, rate_hz: float) -> int:
    """Round a window to an odd number of frames: 31 for half a second at 60 Hz.

    Parameters
    ----------
    window_s : float    seconds
    rate_hz : float    frames per second

    Returns
    -------
    int    odd number of frames
    """
    return 2 * round(0.5 * window_s * rate_hz) + 1


def _smoothed(values: Floats, window: int) -> Floats:
    """Smooth values (F, C) by a Savitzky-Golay filter over `window` frames.

    For a clip that is shorter than the window, the window is the greatest odd number of frames of the clip; if this is
    less than `SHORTEST_WINDOW`, the values are returned unchanged.
    """
    from scipy.signal import savgol_filter

    window = min(window, len(values) - (len(values) + 1) % 2)
    if window < SHORTEST_WINDOW:
        return values
    return np.asarray(savgol_filter(values, window, FILTER_ORDER, axis=0))
