"""Weights of a change in each frame of a range: 1 inside, with smooth transitions at the borders."""

from __future__ import annotations

import numpy as np

from marey_motion import quaternions
from marey_motion.arrays import Floats
from marey_motion.editing.take import Take


def range_weights(take: Take, frames: tuple[int, int | None] | None, border_s: float) -> tuple[slice, Floats]:
    """Compute the weight of each frame of a range: 1 inside, falling smoothly towards 0 at the borders.

    Each of the two transitions lies inside the range and is at most half as long as the range. There is no transition
    at the start or end of the motion.

    Parameters
    ----------
    take : Take    F frames
    frames : (int, int or None) or None    half-open range; all frames if None
    border_s : float    duration of each transition, seconds

    Returns
    -------
    range : slice    n frames
    weights : (n,) float64    0 to 1

    Raises
    ------
    EditError    if the take lacks one of the frames
    """
    start, stop = take.frames(frames)
    count = stop - start
    border = min(take.count_frames(border_s), count // 2)
    places = np.arange(1, border + 1) / (border + 1)
    weights = np.ones(count)
    if start > 0:
        weights[:border] = smooth_step(places)
    if stop < take.frame_count:
        weights[count - border :] = np.minimum(weights[count - border :], smooth_step(places)[::-1])
    return slice(start, stop), weights


def smooth_step(places: Floats) -> Floats:
    """Ease from 0 to 1 with zero velocity at both ends.

    Parameters
    ----------
    places : (...) float64    0 to 1

    Returns
    -------
    (...) float64    0 to 1
    """
    return np.asarray(places * places * (3.0 - 2.0 * places), dtype=np.float64)


def blended(a: Floats, b: Floats, shares: Floats) -> Floats:
    """Interpolate between rotations; shares of 0 and 1 give the inputs exactly.

    Parameters
    ----------
    a, b : (n, J, 4) float64    unit quaternions at share 0 and 1
    shares : (n,) float64    0 to 1

    Returns
    -------
    (n, J, 4) float64    unit quaternions
    """
    if np.all(shares == 1.0):
        return b
    result = np.where((shares == 1.0)[:, None, None], b, a)
    between = (shares > 0.0) & (shares < 1.0)
    result[between] = quaternions.slerp(a[between], b[between], shares[between, None])
    cosines = np.einsum("fjc,fjc->fj", a[between], b[between])
    for joint in np.flatnonzero((cosines < 0.0).any(axis=0) & (cosines > 0.0).any(axis=0)):
        result[between, joint] = _on_one_side(a[between, joint], b[between, joint], shares[between])
    return result


def _on_one_side(a: Floats, b: Floats, shares: Floats) -> Floats:
    """Interpolate between rotations (n, 4) of one joint that differ by about half a turn, always in one direction.

    The shorter way would lead to one side in one frame and to the other side in the next frame. Signs of `a` and of `b`
    are continuous over the frames.
    """
    cosines = np.sum(a * b, axis=1)
    if cosines.sum() < 0.0:
        b, cosines = -b, -cosines
    angles = np.arccos(np.clip(cosines, -1.0, 1.0))
    sines = np.maximum(np.sin(angles), 1e-9)
    mixed = (np.sin((1.0 - shares) * angles) / sines)[:, None] * a + (np.sin(shares * angles) / sines)[:, None] * b
    return np.asarray(quaternions.normalise(mixed), dtype=np.float64)
