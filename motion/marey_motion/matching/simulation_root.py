"""Where a body is on the ground and where it heads, smooth enough to be followed and steered."""

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
    """A root on the ground: positions (F, 2) in metres, headings (F,) in radians, continuous in time."""

    positions: Floats
    headings: Floats


def simulation_root(positions: Floats, body: MatchingBody, rate_hz: float) -> SimulationRoot:
    """The smoothed ground projection of the torso, heading as hips and shoulders face on average.

    Parameters
    ----------
    positions : (F, J, 3) metres, of all joints

    Raises `MotionError` when hips and shoulders never tell a direction.

    Notes
    -----
    Savitzky-Golay filters of third order over 0.5 s and 1 s, as is usual for motion matching; shorter ones for short
    clips. A loop is filtered across its seam when it comes with frames of the rounds before and after it
    (`looping.continue_motion`).
    """
    raw = raw_root(positions, body)
    facing = np.stack((np.sin(raw.headings), np.cos(raw.headings)), axis=-1)
    mean = _smoothed(facing, window_frames(DIRECTION_WINDOW_S, rate_hz))
    length = np.hypot(mean[:, 0], mean[:, 1])[:, None]
    directions = np.where(length > SHORTEST_MEAN, mean, facing)
    return SimulationRoot(_smoothed(raw.positions, window_frames(POSITION_WINDOW_S, rate_hz)), headings(directions))


def raw_root(positions: Floats, body: MatchingBody) -> SimulationRoot:
    """As `simulation_root`, not smoothed."""
    facing = forward_directions(positions, body.lefts, body.rights)
    return SimulationRoot(positions[:, body.torso, ::2], headings(facing))


def bone_root(motion: Motion, body: MatchingBody) -> SimulationRoot:
    """The skeleton's own root joint as it moves on the ground, for data whose root was made to lead the character.

    It heads where the rest pose faces, turned as the root is turned about the vertical. Raises `MotionError` when the
    rest pose faces nowhere.
    """
    skeleton = body.skeleton
    rest = rest_heading(body)
    turns = quaternions.multiply(motion.rotations[:, 0], quaternions.conjugate(skeleton.rest_rotations[0]))
    twist = 2.0 * np.arctan2(turns[:, 2], turns[:, 0])
    return SimulationRoot(motion.root_translations[:, ::2], np.unwrap(twist + rest))


def rest_heading(body: MatchingBody) -> float:
    """Heading of the rest pose. Raises `MotionError` when it faces nowhere."""
    positions = body.skeleton.rest_global_positions[None]
    return float(headings(forward_directions(positions, body.lefts, body.rights))[0])


def window_frames(window_s: float, rate_hz: float) -> int:
    """The odd number of frames next to a window of so many seconds: 31 for half a second at 60 Hz."""
    return 2 * round(0.5 * window_s * rate_hz) + 1


def _smoothed(values: Floats, window: int) -> Floats:
    """Values (F, C) filtered over `window` frames, or the largest odd number that a shorter clip has."""
    from scipy.signal import savgol_filter

    window = min(window, len(values) - (len(values) + 1) % 2)
    if window < SHORTEST_WINDOW:
        return values
    return np.asarray(savgol_filter(values, window, FILTER_ORDER, axis=0))
