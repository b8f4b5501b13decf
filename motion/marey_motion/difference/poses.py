"""Poses that are compared with each other: the joints that two clips have in common, and distances between frames."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from marey_motion.arrays import AnyInts, Floats
from marey_motion.motion import Motion
from marey_motion.resampling import sample_motion

FAR_DEG = 30.0
"""Smallest angle between two rotations of a joint that count as entirely different when frames are matched."""
FAR_M = 0.3
"""Smallest distance between two positions of the root that count as entirely different when frames are matched."""
UNEQUAL = 0.01
"""Least cost of two frames that are not equal, so that equal frames are matched first."""
BLOCK = 2048
"""Frames compared at a time, which limits the memory of intermediate results."""

_FAR_CHORD = 2.0 * np.sin(np.radians(FAR_DEG) / 4.0)


class Poses(NamedTuple):
    """F frames of one clip, reduced to the J joints that both compared clips have.

    Parameters
    ----------
    roots : (F, 3) float32    positions in the world of the joint that carries the body, usually the root, in metres
    rotations : (F, J, 4) float32    local rotations of unit length (w, x, y, z)
    """

    roots: NDArray[np.float32]
    rotations: NDArray[np.float32]

    @property
    def frame_count(self) -> int:
        """Number of frames F."""
        return len(self.roots)

    def sampled(self, places: Floats) -> Poses:
        """Sample the poses between frames.

        Parameters
        ----------
        places : (n,) float64    frame numbers from 0 to F - 1

        Returns
        -------
        Poses    n frames
        """
        no_translations = np.zeros((self.frame_count, 0, 3))
        motion = Motion(self.roots.astype(np.float64), _continuous(self.rotations), no_translations, ())
        sampled = sample_motion(motion, places)
        return Poses(sampled.root_translations.astype(np.float32), sampled.rotations.astype(np.float32))


def _continuous(rotations: NDArray[np.float32]) -> Floats:
    """Return rotations (F, J, 4) with signs that are continuous over time."""
    steps = np.einsum("fjc,fjc->fj", rotations[1:], rotations[:-1]) < 0.0
    signs = np.ones(rotations.shape[:2])
    signs[1:] -= 2.0 * (np.cumsum(steps, axis=0) % 2)
    return np.asarray(rotations * signs[..., None], dtype=np.float64)


def rotation_changes_deg(before: Poses, after: Poses, pairs: AnyInts) -> NDArray[np.float32]:
    """Compute the angles between the rotations of paired frames.

    Parameters
    ----------
    before, after : Poses    frames of the same J joints
    pairs : (n, 2) int    frame of `before` and frame of `after`

    Returns
    -------
    (n, J) float32    degrees from 0 to 180
    """
    angles = np.empty((len(pairs), before.rotations.shape[1]), dtype=np.float32)
    for rows in _blocks(pairs):
        half_chords = np.minimum(_chords(before, after, pairs[rows]) / 2.0, 1.0)
        angles[rows] = np.degrees(4.0 * np.arcsin(half_chords))
    return angles


def frame_costs(before: Poses, after: Poses, pairs: AnyInts) -> Floats:
    """Compute the cost of matching the two frames of each pair.

    Each joint costs min(angle / `FAR_DEG`, 1), to within 0.002, and the root costs min(distance / `FAR_M`, 1) in
    addition. This limits the contribution of a joint that was edited a lot. If the mean m of these costs is not 0, the
    cost of the pair is `UNEQUAL` + (1 - `UNEQUAL`)·m.

    Parameters
    ----------
    before, after : Poses    frames of the same J joints
    pairs : (n, 2) int    frame of `before` and frame of `after`

    Returns
    -------
    (n,) float64    from 0 for equal frames to 1
    """
    costs = np.empty(len(pairs))
    for rows in _blocks(pairs):
        joints = np.minimum(_chords(before, after, pairs[rows]) / _FAR_CHORD, 1.0)
        steps = after.roots[pairs[rows, 1]] - before.roots[pairs[rows, 0]]
        root = np.minimum(np.sqrt(np.einsum("fc,fc->f", steps, steps)) / FAR_M, 1.0)
        costs[rows] = (joints.sum(axis=1, dtype=np.float64) + root) / (joints.shape[1] + 1)
    return np.where(costs > 0.0, UNEQUAL + (1.0 - UNEQUAL) * costs, 0.0)


def time_offsets(before: Poses, after: Poses, pairs: AnyInts) -> tuple[Floats, Floats]:
    """Estimate for each pair of frames how far apart in time their poses are, from distances and velocities.

    Parameters
    ----------
    before, after : Poses    frames of the same J joints
    pairs : (n, 2) int    frame of `before` and frame of `after`

    Returns
    -------
    offsets : (n,) float64    for a pair (i, j): pose j of `after` occurs in `before` near frame i + offset
    weights : (n,) float64    reliability of each offset: the squared speed in `before`, 0 where nothing moves
    """
    offsets, weights = np.zeros(len(pairs)), np.zeros(len(pairs))
    for rows in _blocks(pairs):
        here = pairs[rows, 0]
        earlier, later = np.maximum(here - 1, 0), np.minimum(here + 1, before.frame_count - 1)
        velocity = _steps(before, before, earlier, later) / np.maximum(later - earlier, 1)[:, None, None]
        distance = _steps(before, after, here, pairs[rows, 1])
        weights[rows] = np.einsum("fjc,fjc->f", velocity, velocity)
        offsets[rows] = np.einsum("fjc,fjc->f", velocity, distance)
    return np.divide(offsets, weights, out=np.zeros_like(offsets), where=weights > 0.0), weights


def _blocks(pairs: AnyInts) -> Iterator[slice]:
    """Yield slices of `BLOCK` pairs each, so that the arrays of intermediate results stay small."""
    return (slice(start, start + BLOCK) for start in range(0, len(pairs), BLOCK))


def _steps(first: Poses, second: Poses, rows: AnyInts, others: AnyInts) -> NDArray[np.float32]:
    """Compute differences (n, J, 4) of quaternions: `second` at frames `others` minus `first` at frames `rows`.

    A quaternion and its negative are the same rotation; the sign that makes the difference small is used.
    """
    a, b = first.rotations[rows], second.rotations[others]
    signs = np.where(np.einsum("fjc,fjc->fj", a, b) < 0.0, np.float32(-1.0), np.float32(1.0))
    return np.asarray(b * signs[..., None] - a, dtype=np.float32)


def _chords(before: Poses, after: Poses, pairs: AnyInts) -> NDArray[np.float32]:
    """Return the distances (n, J) between paired quaternions: 2·sin(a / 4) for rotations that differ by the angle a.

    Unlike an angle computed from a scalar product, such a distance is exact near 0.
    """
    steps = _steps(before, after, pairs[:, 0], pairs[:, 1])
    return np.asarray(np.sqrt(np.einsum("fjc,fjc->fj", steps, steps)), dtype=np.float32)
