"""Motions in double precision, for use between the steps of a computation."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from marey_motion import kinematics
from marey_motion.arrays import Floats
from marey_motion.clip import Clip
from marey_motion.skeleton import Skeleton


class Motion(NamedTuple):
    """F frames of J joints in double precision.

    Parameters
    ----------
    root_translations : (F, 3) float64    absolute, metres
    rotations : (F, J, 4) float64    local, of unit length, continuous in sign
    translations : (F, k, 3) float64    metres in the parent's frame, in place of the offsets of k translated joints; k
        may be 0
    translated_joints : tuple of int    increasing indices of the k joints
    """

    root_translations: Floats
    rotations: Floats
    translations: Floats
    translated_joints: tuple[int, ...]

    @classmethod
    def of(cls, clip: Clip) -> Motion:
        """Convert a clip to double precision.

        Parameters
        ----------
        clip : Clip    F frames of J joints

        Returns
        -------
        Motion    the same motion; its quaternions have unit length and signs that are continuous over time
        """
        moved = np.zeros((clip.frame_count, 0, 3)) if clip.translations is None else clip.translations
        rotations = _unit_and_continuous(clip.rotations.astype(np.float64))
        return cls(
            clip.root_translations.astype(np.float64), rotations, moved.astype(np.float64), clip.translated_joints
        )

    @property
    def frame_count(self) -> int:
        """Number of frames F."""
        return len(self.root_translations)

    @property
    def poses(self) -> Floats:
        """Root translations and rotations in one array, (F, 3 + 4·J) float64."""
        return np.concatenate((self.root_translations, self.rotations.reshape(self.frame_count, -1)), axis=1)

    def as_clip(self, skeleton: Skeleton, frame_rate_hz: float) -> Clip:
        """Round the motion to a clip in single precision.

        Parameters
        ----------
        skeleton : Skeleton    J joints
        frame_rate_hz : float    frames per second

        Returns
        -------
        Clip    the same motion in float32
        """
        translations = self.translations.astype(np.float32) if self.translated_joints else None
        return Clip(skeleton, frame_rate_hz, self.poses.astype(np.float32), translations, self.translated_joints)

    def positions(self, skeleton: Skeleton) -> Floats:
        """Compute the positions of the joints in the world.

        Parameters
        ----------
        skeleton : Skeleton    J joints

        Returns
        -------
        (F, J, 3) float64    metres
        """
        positions = kinematics.forward_kinematics(
            skeleton, self.poses, translations=self.translations, translated_joints=self.translated_joints
        )
        return np.asarray(positions, dtype=np.float64)

    def at_frames(self, frames: NDArray[np.integer]) -> Motion:
        """Select frames.

        Parameters
        ----------
        frames : (n,) int    frame numbers, in any order

        Returns
        -------
        Motion    the frames in that order, copied
        """
        return self._replace(
            root_translations=self.root_translations[frames],
            rotations=self.rotations[frames],
            translations=self.translations[frames],
        )

    def sliced(self, start: int, stop: int) -> Motion:
        """Make a motion of a range of frames, which shares memory with this motion.

        Parameters
        ----------
        start, stop : int    first frame, and the frame after the last

        Returns
        -------
        Motion    the frames [start, stop)
        """
        return self._replace(
            root_translations=self.root_translations[start:stop],
            rotations=self.rotations[start:stop],
            translations=self.translations[start:stop],
        )


def _unit_and_continuous(rotations: Floats) -> Floats:
    """Normalise rotations (F, J, 4) of nearly unit length and make signs continuous, in place."""
    rotations /= np.sqrt(np.einsum("fjc,fjc->fj", rotations, rotations))[..., None]
    turned_over = np.einsum("fjc,fjc->fj", rotations[1:], rotations[:-1]) < 0.0
    if turned_over.any():
        odd = np.cumsum(turned_over, axis=0) % 2 == 1
        rotations[1:][odd] *= -1.0
    return rotations
