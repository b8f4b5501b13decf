"""Offsets between poses that decay over time: blending by inertialisation.

An offset x with velocity v decays to zero over T frames. The decay is the quintic polynomial whose position, velocity
and acceleration are x, v and 0 at the start, and all 0 at the end: x·(1-s)³·(1+3s+6s²) + v·t·(1-s)³·(1+3s), where t is
the time since the start and s = t/T. This follows Bollo (2018), "Inertialization", who also uses the acceleration of
the source.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from marey_motion import quaternions
from marey_motion.arrays import Floats
from marey_motion.looping import about_vertical
from marey_motion.motion import Motion

VELOCITY_S = 0.15
"""Seconds within which a difference of velocities decays to zero, so that long blends do not overshoot."""


class PoseOffset(NamedTuple):
    """Difference of two poses of the same joints, or the change of such a difference per frame.

    Parameters
    ----------
    root : (..., 3) float64    metres
    turns : (..., J, 3) float64    rotation vectors in the axes of each joint's parent, radians
    translations : (..., k, 3) float64    metres
    """

    root: Floats
    turns: Floats
    translations: Floats

    def times(self, factor: float) -> PoseOffset:
        """Multiply the offset by a number.

        Parameters
        ----------
        factor : float    the number

        Returns
        -------
        PoseOffset    the product
        """
        return PoseOffset(self.root * factor, self.turns * factor, self.translations * factor)

    def minus(self, other: PoseOffset) -> PoseOffset:
        """Subtract another offset.

        Parameters
        ----------
        other : PoseOffset    of the same shapes

        Returns
        -------
        PoseOffset    the difference
        """
        return PoseOffset(self.root - other.root, self.turns - other.turns, self.translations - other.translations)

    def turned(self, angle_rad: float) -> PoseOffset:
        """Rotate the offset about the vertical; this changes only the root's part, which is in world axes.

        Parameters
        ----------
        angle_rad : float    radians, positive to the left

        Returns
        -------
        PoseOffset    the rotated offset
        """
        turn = about_vertical(np.asarray(angle_rad))
        turns = self.turns.copy()
        turns[..., 0, :] = quaternions.rotate_vectors(turn, turns[..., 0, :])
        root = np.asarray(quaternions.rotate_vectors(turn, self.root), dtype=np.float64)
        return self._replace(root=root, turns=turns)


def offset_to(motion: Motion, frame: int, other: Motion, other_frame: int) -> PoseOffset:
    """Compute the offset from a frame of a motion to a frame of another motion of the same joints.

    Parameters
    ----------
    motion : Motion    the motion
    frame : int    frame of `motion`
    other : Motion    the other motion
    other_frame : int    frame of `other`

    Returns
    -------
    PoseOffset    the pose of `other` minus the pose of `motion`, in these frames
    """
    back = quaternions.conjugate(motion.rotations[frame])
    turns = quaternions.as_rotation_vector(quaternions.multiply(other.rotations[other_frame], back))
    return PoseOffset(
        other.root_translations[other_frame] - motion.root_translations[frame],
        np.asarray(turns, dtype=np.float64),
        other.translations[other_frame] - motion.translations[frame],
    )


def step_of(motion: Motion, frame: int) -> PoseOffset:
    """Compute the offset from the pose of a frame to the pose of the next frame; zero at the last frame.

    Parameters
    ----------
    motion : Motion    F frames
    frame : int    the frame

    Returns
    -------
    PoseOffset    the offset, without a frame axis
    """
    return offset_to(motion, frame, motion, min(frame + 1, motion.frame_count - 1))


def seam_offset(before: Motion, after: Motion) -> tuple[PoseOffset, PoseOffset]:
    """Compute the offset, and its change per frame, that make `after` continue `before` in pose and velocity.

    The step across the seam belongs to neither motion. It is estimated as the mean of the last step before and the
    first step after the seam.

    Parameters
    ----------
    before, after : Motion    motions of the same joints

    Returns
    -------
    offset : PoseOffset    offset for the first frame of `after`
    velocity : PoseOffset    initial change of the offset per frame
    """
    arrival, departure = step_of(before, max(0, before.frame_count - 2)), step_of(after, 0)
    velocity = arrival.minus(departure).times(0.5)
    going_on = add_offset(
        before.sliced(before.frame_count - 1, before.frame_count), np.array([0]), arrival.minus(velocity)
    )
    return offset_to(after, 0, going_on, 0), velocity


def add_offset(motion: Motion, frames: NDArray[np.int64], offset: PoseOffset) -> Motion:
    """Add offsets to the poses of some frames.

    Parameters
    ----------
    motion : Motion    F frames
    frames : (n,) int64    the frames
    offset : PoseOffset    of n poses

    Returns
    -------
    Motion    F frames
    """
    root, rotations, translations = (
        motion.root_translations.copy(), motion.rotations.copy(), motion.translations.copy()
    )  # fmt: skip
    root[frames] += offset.root
    rotations[frames] = quaternions.multiply(quaternions.from_rotation_vector(offset.turns), rotations[frames])
    translations[frames] += offset.translations
    return motion._replace(root_translations=root, rotations=rotations, translations=translations)


def decayed_offset(
    offset: PoseOffset, velocity: PoseOffset, ages: Floats, life: float, velocity_life: float
) -> PoseOffset:
    """Compute an offset that decays over time, from its initial value and velocity.

    Parameters
    ----------
    offset : PoseOffset    of one pose
    velocity : PoseOffset    initial change of the offset per frame
    ages : (n,) float64    frames since the start
    life, velocity_life : float    frames after which the contribution of the initial value, or of the velocity, is zero

    Returns
    -------
    PoseOffset    of n poses
    """
    s = np.clip(ages / life, 0.0, 1.0)
    places = (1.0 - s) ** 3 * (1.0 + 3.0 * s + 6.0 * s * s)
    u = np.clip(ages / velocity_life, 0.0, 1.0)
    speeds = ages * (1.0 - u) ** 3 * (1.0 + 3.0 * u)

    def left(x: Floats, v: Floats) -> Floats:
        return np.multiply.outer(places, x) + np.multiply.outer(speeds, v)

    return PoseOffset(*(left(x, v) for x, v in zip(offset, velocity, strict=True)))
