"""Detection of foot contacts, robust against noise and against the rolling of the foot."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from marey_motion import kinematics
from marey_motion.arrays import Floats
from marey_motion.clip import Clip
from marey_motion.matching.body import MatchingBody
from marey_schemas.options.annotations import ContactOptions

LEAVING_FACTOR = 1.6
"""Speed at which a contact ends, as a multiple of the speed limit below which the contact begins (hysteresis)."""
SMOOTHING_S = 0.045


class Stance(NamedTuple):
    """The frames [start, end) in which a foot is on the ground."""

    start: int
    end: int


def find_stances(clip: Clip, body: MatchingBody, options: ContactOptions | None = None) -> tuple[list[Stance], ...]:
    """Find the stances of both feet of a clip: the times in which a foot is on the ground.

    Parameters
    ----------
    clip : Clip    F frames
    body : MatchingBody    joints of its skeleton
    options : ContactOptions, optional    limits of speed and duration

    Returns
    -------
    (list of Stance, list of Stance)    stances of the left and of the right foot, in the order of time; a stance may
        begin or end with the clip
    """
    positions = kinematics.global_positions(clip)
    feet = [positions[:, list(pair)] for pair in zip(body.feet, body.toes, strict=True)]
    rate = clip.frame_rate_hz
    return tuple(stances_of(foot_speed(foot, rate), rate, options or ContactOptions()) for foot in feet)


def foot_speed(points: NDArray[np.floating], frame_rate_hz: float) -> Floats:
    """Compute the speed of the slowest point of a foot in each frame, and remove outliers by a median filter.

    While a foot rolls from heel strike to toe off, first its heel does not move, then its toe. The ankle is close to
    the heel, so the slower of ankle and toe is slow during the whole contact.

    Parameters
    ----------
    points : (F, k, 3)    positions of the points, metres
    frame_rate_hz : float    frames per second

    Returns
    -------
    (F,) float64    metres per second
    """
    from scipy.ndimage import median_filter  # imported here, because this import is slow

    speed = np.linalg.norm(kinematics.velocities(points, frame_rate_hz), axis=-1).min(axis=1)
    width = 2 * int(0.5 * SMOOTHING_S * frame_rate_hz) + 1
    return np.asarray(median_filter(speed.astype(np.float64), size=width, mode="nearest"))


def stances_of(speed: Floats, frame_rate_hz: float, options: ContactOptions) -> list[Stance]:
    """Find the stances of one foot, or of one point of a foot, by its speed.

    Parameters
    ----------
    speed : (F,) float64    metres per second
    frame_rate_hz : float    frames per second
    options : ContactOptions    limits of speed and duration

    Returns
    -------
    list of Stance    in the order of time
    """
    standing = _with_hysteresis(speed, options.speed_m_s, LEAVING_FACTOR * options.speed_m_s)
    standing = ~without_short(~standing, options.shortest_swing_s * frame_rate_hz)
    return [Stance(*one) for one in runs(without_short(standing, options.shortest_stance_s * frame_rate_hz))]


def contact_labels(points: Floats, rate_hz: float) -> NDArray[np.bool_]:
    """Label the frames in which points of feet are on the ground, by the speed of each point (see `stances_of`).

    The limits of speed and duration are the defaults of `ContactOptions`.

    Parameters
    ----------
    points : (F, k, 3) float64    metres
    rate_hz : float    frames per second

    Returns
    -------
    (F, k) bool    True in the stances of each point
    """
    labels = np.zeros(points.shape[:2], dtype=np.bool_)
    options = ContactOptions()
    for point in range(points.shape[1]):
        for stance in stances_of(foot_speed(points[:, point : point + 1], rate_hz), rate_hz, options):
            labels[stance.start : stance.end, point] = True
    return labels


def _with_hysteresis(values: Floats, low: float, high: float) -> NDArray[np.bool_]:
    """Compute a mask (F,) that is true from where the values fall below `low` until they rise above `high`.

    The mask is also true before the first value outside these limits.
    """
    decided = (values < low) | (values > high)
    latest = np.maximum.accumulate(np.where(decided, np.arange(len(values)), -1))
    return np.asarray(np.where(latest >= 0, values[latest] < low, values < high))


def without_short(states: NDArray[np.bool_], shortest: float) -> NDArray[np.bool_]:
    """Set short runs of true states to false. Runs at either end are kept, since they may continue outside the clip.

    Parameters
    ----------
    states : (F,) bool    state in each frame
    shortest : float    frames; shorter runs become false

    Returns
    -------
    (F,) bool    states without the short runs
    """
    kept = states.copy()
    for start, end in runs(states):
        if end - start < shortest and start > 0 and end < len(states):
            kept[start:end] = False
    return kept


def runs(states: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """List the ranges of frames in which `states` is true.

    Parameters
    ----------
    states : (F,) bool    states

    Returns
    -------
    list of (int, int)    ranges [start, end)
    """
    padded = np.concatenate(([False], states, [False]))
    starts, ends = np.flatnonzero(~padded[:-1] & padded[1:]), np.flatnonzero(padded[:-1] & ~padded[1:])
    return list(zip(starts.tolist(), ends.tolist(), strict=True))
