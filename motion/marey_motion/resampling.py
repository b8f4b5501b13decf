"""Clips at another frame rate."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from marey_motion import quaternions
from marey_motion.clip import Clip
from marey_motion.errors import ClipError

Floats = NDArray[np.float64]


class Motion(NamedTuple):
    """The numbers of a clip in double precision: what is computed with before it is stored.

    root_translations : (F, 3) metres; rotations : (F, J, 4) local; translations : (F, k, 3) metres, k may be 0
    """

    root_translations: Floats
    rotations: Floats
    translations: Floats

    @classmethod
    def of(cls, clip: Clip) -> Motion:
        """A clip's own numbers, its quaternions brought to unit length and continuous in sign."""
        rotations = quaternions.unroll(quaternions.normalise(clip.rotations.astype(np.float64)))
        moved = clip.translations
        return cls(
            clip.root_translations.astype(np.float64),
            rotations,
            np.zeros((clip.frame_count, 0, 3)) if moved is None else moved.astype(np.float64),
        )


def resample_clip(clip: Clip, frame_rate_hz: float) -> Clip:
    """The same motion at another rate: first frames coincide, and no frame lies beyond the last one.

    Positions follow cubic splines; rotations cubic splines through their sign-continuous components, brought back to
    unit length.
    """
    if frame_rate_hz == clip.frame_rate_hz:
        return clip
    motion = resample_motion(Motion.of(clip), clip.frame_rate_hz, frame_rate_hz)
    poses = np.concatenate((motion.root_translations, motion.rotations.reshape(len(motion.rotations), -1)), axis=1)
    translations = None if clip.translations is None else motion.translations.astype(np.float32)
    return Clip(clip.skeleton, frame_rate_hz, poses.astype(np.float32), translations, clip.translated_joints)


def resample_motion(motion: Motion, from_hz: float, to_hz: float) -> Motion:
    """As `resample_clip`, in double precision."""
    if not (np.isfinite(to_hz) and to_hz > 0):
        raise ClipError(f"the frame rate is {to_hz}, a positive number is needed", where="frame_rate_hz")
    if from_hz == to_hz:
        return motion
    frames = len(motion.rotations)
    # Rates that divide each other must not lose their last frame to rounding.
    count = int(np.floor((frames - 1) / from_hz * to_hz + 1e-6)) + 1
    at = np.minimum(np.arange(count) * (from_hz / to_hz), frames - 1.0)
    columns = np.concatenate(
        (motion.root_translations, motion.rotations.reshape(frames, -1), motion.translations.reshape(frames, -1)),
        axis=1,
    )
    sampled = _through(columns, at)
    rotation_columns = motion.rotations.shape[1] * 4
    rotations = sampled[:, 3 : 3 + rotation_columns].reshape(count, -1, 4)
    return Motion(
        sampled[:, :3],
        quaternions.normalise(rotations),
        sampled[:, 3 + rotation_columns :].reshape(count, -1, 3),
    )


def _through(columns: Floats, at: Floats) -> Floats:
    """Cubic splines through the rows of `columns` (F, C), read at fractional frames."""
    from scipy.interpolate import CubicSpline

    if len(columns) == 1:
        return np.repeat(columns, len(at), axis=0)
    sampled: Floats = CubicSpline(np.arange(len(columns)), columns, axis=0)(at)
    return sampled
