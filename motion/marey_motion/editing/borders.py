"""How much each frame takes part in a change of a range: all of it inside, going over softly at the borders."""

from __future__ import annotations

import numpy as np

from marey_motion import quaternions
from marey_motion.arrays import Floats
from marey_motion.editing.take import Take


def range_weights(take: Take, frames: tuple[int, int | None] | None, border_s: float) -> tuple[slice, Floats]:
    """The range as a slice of n frames, and the share (n,) that each takes of the change.

    Borders lie within the range and take up to half of it each. Where the range begins or ends with the motion there is
    nothing to go over to, and no border. Raises `EditError` where the frames are not there.
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
    """From 0 to 1, without velocity at both ends, as places (...) go from 0 to 1."""
    return np.asarray(places * places * (3.0 - 2.0 * places), dtype=np.float64)


def blended(a: Floats, b: Floats, shares: Floats) -> Floats:
    """Rotations (n, J, 4) from `a` at share 0 of (n,) to `b` at share 1, both of which are taken as they are."""
    if np.all(shares == 1.0):
        return b
    result = np.where((shares == 1.0)[:, None, None], b, a)
    between = (shares > 0.0) & (shares < 1.0)
    result[between] = quaternions.slerp(a[between], b[between], shares[between, None])
    return result
