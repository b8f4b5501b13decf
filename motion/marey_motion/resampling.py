"""Clips at another frame rate."""

from __future__ import annotations

import numpy as np

from marey_motion import quaternions
from marey_motion.arrays import Floats
from marey_motion.clip import Clip
from marey_motion.errors import ClipError
from marey_motion.looping import LoopSeam, continue_motion
from marey_motion.motion import Motion

SAME_RATE = 1e-9
# The influence of a frame on a cubic spline falls to about a quarter with each frame, and is negligible after so many.
LOOP_REACH = 20
# Channels interpolated at a time, so that an hour of motion needs little more memory than its own.
CHANNELS = 32


def resample_clip(clip: Clip, frame_rate_hz: float, *, seam: LoopSeam | None = None) -> Clip:
    """Sample a clip at another frame rate.

    The first sample is the first frame, and no sample lies beyond the last frame. Positions follow cubic splines.
    Rotations follow cubic splines through their sign-continuous components and are then normalised. If all samples fall
    on frames, these frames are copied unchanged.

    Parameters
    ----------
    clip : Clip    F frames
    frame_rate_hz : float    frames per second
    seam : LoopSeam, optional    the transition from the end of a loop to its start (`looping.loop_seam`); None if the
        clip is not a loop. The samples of a loop are evenly spaced; if the loop does not last a whole number of sample
        intervals, its duration is rounded to the nearest whole number of intervals.

    Returns
    -------
    Clip    the same motion at the new rate

    Raises
    ------
    ClipError    if the rate is not a positive number
    """
    if _are_same(frame_rate_hz, clip.frame_rate_hz):
        return clip
    motion = resample_motion(Motion.of(clip), clip.frame_rate_hz, frame_rate_hz, seam=seam)
    return motion.as_clip(clip.skeleton, frame_rate_hz)


def resample_motion(motion: Motion, from_hz: float, to_hz: float, *, seam: LoopSeam | None = None) -> Motion:
    """Sample a motion at another frame rate, in double precision.

    The first sample is the first frame, and no sample lies beyond the last frame. Positions and rotations follow cubic
    splines. If all samples fall on frames, these frames are copied unchanged.

    Parameters
    ----------
    motion : Motion    F frames
    from_hz, to_hz : float    frame rates of the motion and of the result
    seam : LoopSeam, optional    the transition from the end of a loop to its start; None if the motion is not a loop.
        The duration of a loop is rounded to a whole number of sample intervals.

    Returns
    -------
    Motion    the same motion at `to_hz`

    Raises
    ------
    ClipError    if `to_hz` is not a positive number
    """
    if not (np.isfinite(to_hz) and to_hz > 0):
        raise ClipError(f"the frame rate must be a positive number, not {to_hz}", where="frame_rate_hz")
    if _are_same(to_hz, from_hz):
        return motion
    frames = motion.frame_count
    if seam is not None:
        count = max(1, round(frames / from_hz * to_hz))
        places = LOOP_REACH + np.arange(count, dtype=np.float64) * (frames / count)
        return sample_motion(continue_motion(motion, seam, LOOP_REACH, LOOP_REACH), places)
    count = count_samples(frames, from_hz, to_hz)
    return sample_motion(motion, np.minimum(np.arange(count, dtype=np.float64) * (from_hz / to_hz), frames - 1.0))


def count_samples(frames: int, from_hz: float, to_hz: float) -> int:
    """Count the frames of a resampled motion, which has no frame beyond the last frame of the original.

    Parameters
    ----------
    frames : int    number of frames before
    from_hz, to_hz : float    frame rates before and after

    Returns
    -------
    int    number of frames after
    """
    # Rates that divide each other must not lose their last frame to rounding.
    return int((frames - 1) / from_hz * to_hz + 1e-6) + 1


def _are_same(rate_hz: float, other_hz: float) -> bool:
    return abs(rate_hz - other_hz) <= SAME_RATE * other_hz


def sample_motion(motion: Motion, places: Floats) -> Motion:
    """Sample a motion at fractional frame numbers.

    Parameters
    ----------
    motion : Motion    F frames
    places : (n,) float64    frame numbers from 0 to F - 1; if all are whole, the frames are copied unchanged

    Returns
    -------
    Motion    n frames
    """
    nearest = np.round(places).astype(np.int64)
    if np.all(np.abs(places - nearest) <= SAME_RATE * motion.frame_count):
        return motion.at_frames(nearest)
    rotations = quaternions.normalise(_interpolated(motion.rotations, places))
    return motion._replace(
        root_translations=_interpolated(motion.root_translations, places),
        rotations=np.asarray(rotations, dtype=np.float64),
        translations=_interpolated(motion.translations, places),
    )


def _interpolated(values: Floats, places: Floats) -> Floats:
    """Interpolate `values` (F, ...) by cubic splines at frame numbers `places` (n,); return (n, ...)."""
    from scipy.interpolate import make_interp_spline

    columns = values.reshape(len(values), -1)
    if len(values) == 1:
        return np.repeat(values, len(places), axis=0)
    sampled = np.empty((len(places), columns.shape[1]))
    frames = np.arange(len(values), dtype=np.float64)
    degree = min(3, len(values) - 1)  # three frames have a parabola, two a line
    for start in range(0, columns.shape[1], CHANNELS):
        channels = slice(start, start + CHANNELS)
        sampled[:, channels] = make_interp_spline(frames, columns[:, channels], k=degree)(places)
    return sampled.reshape(len(places), *values.shape[1:])
