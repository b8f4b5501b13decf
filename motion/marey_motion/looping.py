"""Loops: clips whose last frame leads into their first frame, which may be at another position on the ground.

Ground positions are (x, z) in metres; headings are in radians and increase in a left turn.
"""

from __future__ import annotations

from typing import NamedTuple, cast

import numpy as np

from marey_motion import quaternions
from marey_motion.arrays import AnyFloats, Floats, Ints
from marey_motion.motion import Motion


class LoopSeam(NamedTuple):
    """Movement on the ground from each round (repetition) of a loop to the next: a turn about the origin, then a shift.

    Parameters
    ----------
    turn_rad : float    radians, positive to the left
    shift_m : (2,) float64    (x, z) in metres
    """

    turn_rad: float
    shift_m: Floats


def loop_seam(positions: Floats, headings: Floats) -> LoopSeam:
    """Compute the seam of a loop that moves on the ground.

    The step from the last frame to the first frame of the next round is not in the data. It is estimated as the mean of
    the clip's last and first step, each relative to the heading at its start. Therefore, velocities are continuous
    across the seam.

    Parameters
    ----------
    positions : (F, 2) float64    (x, z) in metres
    headings : (F,) float64    radians, continuous in time

    Returns
    -------
    LoopSeam    identity for fewer than two frames
    """
    if len(headings) < 2:
        return LoopSeam(0.0, np.zeros(2))
    turns = np.array([headings[1] - headings[0], headings[-1] - headings[-2]])
    steps = np.stack((positions[1] - positions[0], positions[-1] - positions[-2]))
    local = rotated(steps, -headings[[0, -2]]).mean(axis=0)
    arrival = positions[-1] + rotated(local, headings[-1])
    turn = float(headings[-1] + turns.mean() - headings[0])
    return LoopSeam(turn, arrival - rotated(positions[0], turn))


def rotated(vectors: Floats, angles_rad: Floats | float) -> Floats:
    """Rotate ground vectors to the left.

    Parameters
    ----------
    vectors : (..., 2) float64    (x, z)
    angles_rad : (...) float64    radians

    Returns
    -------
    (..., 2) float64    (x, z), in the unit of `vectors`
    """
    sine, cosine = np.sin(angles_rad), np.cos(angles_rad)
    x, z = vectors[..., 0], vectors[..., 1]
    return np.stack((x * cosine + z * sine, z * cosine - x * sine), axis=-1)


def moves_of_rounds(seam: LoopSeam, rounds: Ints) -> tuple[Floats, Floats]:
    """Compute the moves from the recorded round of a loop to other rounds.

    Parameters
    ----------
    seam : LoopSeam    the move to the next round
    rounds : (n,) int64    numbers of rounds; 1 is the next one, -1 the one before

    Returns
    -------
    turns : (n,) float64    radians
    shifts : (n, 2) float64    (x, z) in metres
    """
    first, last = int(rounds.min(initial=0)), int(rounds.max(initial=0))
    turns = seam.turn_rad * np.arange(first, last + 1, dtype=np.float64)
    shifts = np.zeros((last - first + 1, 2))
    for n in range(1, last + 1):
        shifts[n - first] = rotated(shifts[n - 1 - first], seam.turn_rad) + seam.shift_m
    for n in range(-1, first - 1, -1):
        shifts[n - first] = rotated(shifts[n + 1 - first] - seam.shift_m, -seam.turn_rad)
    return turns[rounds - first], shifts[rounds - first]


def continue_motion(motion: Motion, seam: LoopSeam, before: int, after: int) -> Motion:
    """Extend a loop at both ends by frames of the rounds before and after it.

    Parameters
    ----------
    motion : Motion    one round of F frames
    seam : LoopSeam    the move to the next round
    before, after : int    numbers of frames to add

    Returns
    -------
    Motion    before + F + after frames
    """
    rounds, frames = np.divmod(np.arange(-before, motion.frame_count + after), motion.frame_count)
    turns, shifts = moves_of_rounds(seam, rounds)
    going_on = motion.at_frames(frames)
    going_on.root_translations[:, (0, 2)] = rotated(going_on.root_translations[:, (0, 2)], turns) + shifts
    going_on.rotations[:, 0] = quaternions.multiply(about_vertical(turns), going_on.rotations[:, 0])
    return going_on._replace(rotations=np.asarray(quaternions.unroll(going_on.rotations), dtype=np.float64))


def about_vertical(angles_rad: AnyFloats) -> Floats:
    """Make rotations about the vertical.

    Parameters
    ----------
    angles_rad : (...) float64    radians, positive to the left

    Returns
    -------
    (..., 4) float64    unit quaternions (w, x, y, z)
    """
    zero = np.zeros_like(angles_rad)
    return cast(Floats, np.stack((np.cos(0.5 * angles_rad), zero, np.sin(0.5 * angles_rad), zero), axis=-1))
