"""Smoother targets for limbs that would jump: the limb moves steadily, and misses the original targets a little.

A limb cannot reach a target at its shoulder or hip, because its middle joint cannot fold completely. If a target passes
close to the shoulder, the limb would turn over between two frames. If a running body passes a target, the limb would
turn as fast as the body passes. In the runs of frames in which the limb would jump, this module therefore leads the
hand round the shoulder and lets it lag behind the target, as an animator would.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import numpy as np

from marey_motion.arrays import Flags, Floats
from marey_motion.editing.annotations.contacts import runs
from marey_motion.editing.borders import smooth_step
from marey_motion.editing.inverse_kinematics.limbs import TwoBoneLimb
from marey_motion.motion import Motion
from marey_motion.skeleton import Skeleton

MOST_STEP = 1.5
"""Largest permitted step of a joint between two frames, as a multiple of its largest step in the unedited motion."""
BLEND_PEAK = 2.0
"""Greatest rate at which a change is blended in, as a multiple of its mean rate over the blended frames."""
_WIDTHS = (0.0, 0.1, 0.2, 0.4, 0.8)
"""Smoothing widths that are tried in turn, as shares of the number of frames within which changes are blended."""
_CLEAR = 0.5
"""Two unit directions count as opposite if the length of their sum is below this value."""


def largest_steps(places: Floats) -> Floats:
    """Compute the largest step of each joint between two frames.

    Parameters
    ----------
    places : (F, J, 3) float64    positions, metres

    Returns
    -------
    (J,) float64    metres; 0 if there is only one frame
    """
    steps = np.linalg.norm(np.diff(places, axis=0), axis=-1)
    return np.asarray(steps.max(axis=0, initial=0.0), dtype=np.float64)


def allowed_steps(usual: Floats, moved: Floats, blend_frames: float) -> Floats:
    """Compute how far joints may move between two frames of an edited motion.

    Parameters
    ----------
    usual : (n,) float64    largest step of each joint between two frames of the unedited motion, metres
    moved : (n,) float64    largest distance by which the edit moves each joint, metres
    blend_frames : float    number of frames within which the change is blended in

    Returns
    -------
    (n,) float64    metres between two frames
    """
    need = BLEND_PEAK * moved / (max(blend_frames, 1.0) + 1.0)
    return np.asarray(np.maximum(MOST_STEP * usual, usual + need), dtype=np.float64)


class _Attempt(NamedTuple):
    motion: Motion
    excess: Floats
    """Metres (n - 1,) by which the step of the elbow or wrist exceeds the permitted step; the larger of the two."""


@dataclass(frozen=True, eq=False)
class LimbSmoother:
    """Solver of a limb in a run of frames, which smooths the path of the limb's end until no joint of the limb jumps.

    Parameters
    ----------
    skeleton : Skeleton    J joints
    limb : TwoBoneLimb    the limb
    given : Motion    the n frames before they are solved
    usual : (2,) float64    largest steps of middle joint and end in the whole unedited motion, in metres
    reach : float    number of frames within which changes are blended
    fold_rad : float    angle between the two bones of the limb when it is folded as far as possible
    """

    skeleton: Skeleton
    limb: TwoBoneLimb
    given: Motion
    usual: Floats
    reach: float
    fold_rad: float

    def solved(self, targets: Floats, solve: Callable[[Motion, Floats], Motion], first: Motion) -> Motion:
        """Solve the limb for smoother and smoother paths of its end until no joint of the limb jumps.

        Parameters
        ----------
        targets : (n, 3) float64    desired positions of the limb's end, in metres in the world
        solve : callable    called as solve(motion, path); returns the motion solved for this path of the limb's end
        first : Motion    the solution for `targets`

        Returns
        -------
        Motion    n frames, the solution with the smallest jumps; `first` itself if it has no jumps
        """
        best = self._judged(first)
        if best.excess.max(initial=0.0) <= 0.0:
            return first
        jumps = np.zeros(len(targets), dtype=np.bool_)
        jumps[:-1] |= best.excess > 0.0
        jumps[1:] |= best.excess > 0.0
        starts = self._places(self.given)[:, 0]
        for width, smooth in product(_WIDTHS, (self._slowed, self._evened)):
            path = starts + smooth(targets - starts, jumps, max(1, round(width * self.reach)))
            made = self._judged(solve(self.given, path))
            if made.excess.max() < best.excess.max():
                best = made
            if best.excess.max() <= 0.0:
                break
        return best.motion

    def _places(self, motion: Motion) -> Floats:
        joints = [self.limb.start, self.limb.middle, self.limb.end]
        return np.asarray(motion.positions(self.skeleton)[:, joints], dtype=np.float64)

    def _judged(self, motion: Motion) -> _Attempt:
        before, after = (self._places(one)[:, 1:] for one in (self.given, motion))
        moved = np.linalg.norm(after - before, axis=-1).max(axis=0)
        steps = np.linalg.norm(np.diff(after, axis=0), axis=-1)
        return _Attempt(motion, (steps - allowed_steps(self.usual, moved, self.reach)).max(axis=1))

    def _slowed(self, vectors: Floats, jumps: Flags, width: int) -> Floats:
        """Let the limb's end turn more slowly round the limb's first joint, and keep the end away from this joint.

        `vectors` (n, 3) are the positions of the end relative to the first joint; `jumps` (n,) is True in frames next
        to a jump. A frame is changed if it is at most `width` frames from a frame next to a jump, or from a frame in
        which the limb would have to fold too far. In each run of such frames, the direction turns smoothly from the
        first direction to the last, starting and ending at rest, and the distance is at least that of the folded limb.
        """
        from scipy.ndimage import maximum_filter1d

        start, middle, end = np.moveaxis(self._places(self.given), 1, 0)
        first, second = np.linalg.norm(middle - start, axis=1), np.linalg.norm(end - middle, axis=1)
        least = np.sqrt(first**2 + second**2 - 2.0 * first * second * np.cos(self.fold_rad))
        sizes = np.linalg.norm(vectors, axis=1)
        turning = np.asarray(maximum_filter1d(jumps | (sizes < least), 2 * width + 1), dtype=np.bool_)
        directions = _directions(vectors, end - start)
        slowed = directions.copy()
        for begin, stop in runs(turning):
            mean = _directions((end - start)[begin:stop].mean(axis=0), np.array((0.0, -1.0, 0.0)))
            places = smooth_step(np.linspace(0.0, 1.0, stop - begin))
            slowed[begin:stop] = _turned(directions[begin], directions[stop - 1], mean, places)
        return np.asarray(np.where(turning[:, None], np.maximum(sizes, least)[:, None] * slowed, vectors))

    def _evened(self, vectors: Floats, jumps: Flags, width: int) -> Floats:
        """Smooth the path of the limb's end near jumps by a Gaussian filter.

        `vectors` (n, 3) are the positions of the path relative to the limb's first joint, `jumps` (n,) are the frames
        next to a jump, and `width` is the standard deviation of the filter in frames.
        """
        from scipy.ndimage import gaussian_filter1d, maximum_filter1d

        share = maximum_filter1d(jumps.astype(np.float64), 4 * width + 1)
        share = gaussian_filter1d(share, width, mode="nearest")[:, None]
        even = gaussian_filter1d(self._slowed(vectors, np.zeros_like(jumps), width), width, axis=0, mode="nearest")
        return np.asarray(vectors + share * (even - vectors), dtype=np.float64)


def _directions(vectors: Floats, otherwise: Floats) -> Floats:
    """Compute the unit directions (..., 3) of vectors; a vector of `otherwise` replaces each vector of length zero."""
    vectors = np.where(np.linalg.norm(vectors, axis=-1, keepdims=True) > 1e-6, vectors, otherwise)
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-9))


def _turned(first: Floats, last: Floats, guide: Floats, places: Floats) -> Floats:
    """Interpolate between two unit directions (3,) on a great circle; if they are opposite, through `guide`.

    Returns the directions (n, 3) at `places` (n,), from 0 for the first direction to 1 for the last.
    """
    middle, chord = first + last, last - first
    size = float(np.linalg.norm(middle))
    if size < _CLEAR:
        across = np.stack((guide, *np.eye(3)))
        across -= np.outer(across @ chord, chord) / max(float(chord @ chord), 1e-12)
        chosen = (
            across[0]
            if np.linalg.norm(across[0]) > _CLEAR
            else across[1 + np.argmax(np.linalg.norm(across[1:], axis=1))]
        )
        middle = middle + (_CLEAR - size) * chosen / np.linalg.norm(chosen)
    middle = middle / np.linalg.norm(middle)
    halves = np.where(places[:, None] < 0.5, first, last)
    share = np.abs(2.0 * places - 1.0)[:, None]
    angle = np.arccos(np.clip(float(first @ middle), -1.0, 1.0))
    if angle < 1e-6:
        return np.asarray(halves)
    return np.asarray((np.sin(share * angle) * halves + np.sin((1.0 - share) * angle) * middle) / np.sin(angle))
