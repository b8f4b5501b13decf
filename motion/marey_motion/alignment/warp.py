"""Time functions (time warps), which map each frame of one motion to a time in another motion.

A time function gives a fractional frame of the source for each canonical frame. It is strictly increasing, begins at 0
and ends at the source's last frame; between canonical frames it is linear.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from marey_motion import quaternions
from marey_motion.arrays import Floats
from marey_motion.errors import MotionError
from marey_motion.motion import Motion

LEAST_SLOPE = 0.01
# Slopes are raised by a little more than needed, so that rounded sums of slopes do not fall below the least slope.
_SLACK = 1e-9
_WHOLE = 1e-9


def time_function(path: NDArray[np.integer]) -> Floats:
    """Compute the time function (time warp) of an alignment path between a reference and a source.

    A canonical frame (a frame of the reference) that is matched with several source frames is mapped to the mean of
    these. A source frame that is matched with several canonical frames is assigned to the mean of these; between such
    points, the function is linear. The first frames of both motions correspond exactly, and so do the last frames. If a
    slope is below `LEAST_SLOPE`, the slopes are changed as little as possible, by least squares, so that all of them
    are at least `LEAST_SLOPE`.

    Parameters
    ----------
    path : (L, 2) int    matched frames of the reference (N frames) and of the source

    Returns
    -------
    (N,) float64    source frames

    Raises
    ------
    MotionError    if one of the motions has fewer than two frames, or if the source is too short for the least slope
    """
    if len(path) < 2 or (path[-1] <= path[0]).any():
        raise MotionError("a time function needs at least two frames in both motions", code="too-few-frames")
    canonical, source = _knots(path)
    frames = np.arange(path[0, 0], path[-1, 0] + 1, dtype=np.float64)
    return _with_least_slope(np.interp(frames, canonical, source))


def _knots(path: NDArray[np.integer]) -> tuple[Floats, Floats]:
    """Find the points between which a time function is interpolated: canonical frames (k,) and source frames (k,).

    Where the path stays at one frame of either motion for several cells, the mean of these cells is one point. The
    first and the last point are the ends of the path.
    """
    steps = np.diff(path, axis=0)
    side = steps[:, 0] - steps[:, 1]  # 0 for a step in both motions, 1 or -1 for a step in one
    before = np.concatenate(([0], side[:-1]))
    runs = np.concatenate(([0], np.cumsum((side == 0) | ((before != 0) & (before != side)))))
    lengths = np.bincount(runs)
    middles = np.stack([np.bincount(runs, weights=frames) / lengths for frames in path.T], axis=1)
    knots = np.concatenate((path[:1], middles[1:-1], path[-1:]), dtype=np.float64)
    return knots[:, 0], knots[:, 1]


def _with_least_slope(times: Floats) -> Floats:
    """Change times (N,) as little as possible so that each time exceeds the one before by at least `LEAST_SLOPE`.

    The first and the last time stay, and the sum of the squared changes of the steps is minimal. Raises `MotionError`
    if the mean slope is below `LEAST_SLOPE`.
    """
    steps, least = np.diff(times), LEAST_SLOPE + _SLACK
    if steps.min() >= LEAST_SLOPE:
        return times
    spare = times[-1] - times[0] - least * len(steps)
    if spare < 0:
        raise MotionError(
            f"{len(times)} frames cannot be aligned with {times[-1] - times[0]:g} frames of the source clip: "
            f"the slope of the time function would be below {LEAST_SLOPE:g}; use a longer source clip",
            code="alignment-impossible",
        )
    # Projection onto the simplex of steps above the least one (Held, Wolfe and Crowder 1974).
    above = np.sort(steps - least)[::-1]
    excess = (np.cumsum(above) - spare) / np.arange(1, len(above) + 1)
    kept = np.count_nonzero(above > excess)
    raised = times.copy()
    raised[1:-1] = times[0] + np.cumsum(np.maximum(steps - least - excess[kept - 1], 0.0) + least)[:-1]
    return raised


def inverse(times: Floats) -> Floats:
    """Invert a time function (time warp).

    Parameters
    ----------
    times : (N,) float64    source frame of each of N canonical frames, increasing; the last one is M - 1

    Returns
    -------
    (M,) float64    fractional canonical frame of each of the M source frames
    """
    return np.interp(np.arange(round(times[-1]) + 1, dtype=np.float64), times, np.arange(len(times), dtype=np.float64))


def warped(motion: Motion, times: ArrayLike) -> Motion:
    """Sample a motion at fractional frames: positions are interpolated linearly, rotations by slerp.

    Parameters
    ----------
    motion : Motion    F frames
    times : (n,) float    frames from 0 to F - 1

    Returns
    -------
    Motion    n frames

    Raises
    ------
    MotionError    if a time is outside the motion
    """
    places = np.asarray(times, dtype=np.float64)
    last = motion.frame_count - 1
    if places.size and not (places.min() >= -_WHOLE and places.max() <= last + _WHOLE):
        raise MotionError(f"a time is outside the motion, whose frames are 0 to {last}", where="times")
    places = np.clip(places, 0.0, last)
    whole = np.round(places)
    places = np.where(np.abs(places - whole) <= _WHOLE, whole, places)
    frames = places.astype(np.int64)
    made = motion.at_frames(frames)
    (between,) = np.nonzero(places != frames)
    if len(between):
        before, share = frames[between], places[between] - frames[between].astype(np.float64)
        turned = quaternions.slerp(motion.rotations[before], motion.rotations[before + 1], share[:, None])
        made.rotations[between] = turned
        made.root_translations[between] = _between(motion.root_translations, before, share)
        made.translations[between] = _between(motion.translations, before, share)
    return made


def _between(values: Floats, frames: NDArray[np.int64], share: Floats) -> Floats:
    fraction = share.reshape(-1, *[1] * (values.ndim - 1))
    return np.asarray((1.0 - fraction) * values[frames] + fraction * values[frames + 1])
