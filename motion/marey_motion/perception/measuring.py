"""Measurement of clips for a perceptual metric: rotations, positions and velocities of joints.

Positions and velocities are relative to the place and heading of the body, so that place and heading do not affect
distances.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from marey_motion import quaternions
from marey_motion.arrays import Floats, Ints
from marey_motion.errors import MotionError
from marey_motion.kinematics import forward_directions, headings, velocities
from marey_motion.looping import LoopSeam, continue_motion, rotated
from marey_motion.matching.body import MatchingBody
from marey_motion.matching.simulation_root import DIRECTION_WINDOW_S, window_frames
from marey_motion.motion import Motion
from marey_motion.perception.metric import JOINT_CLASSES
from marey_motion.skeleton import Skeleton
from marey_schemas.documents.metrics import WITHOUT_ANGLES, Measurement

_SAME_REST = 1e-3
_ROUNDED_FRAMES = 1e-9


@dataclass(frozen=True, eq=False)
class MeasuredClip:
    """The P joints of a clip's joint classes, over F frames.

    Parameters
    ----------
    skeleton : Skeleton    skeleton of the clip
    rate_hz : float    frames per second
    classes : tuple of str    the K joint classes that the skeleton has
    starts : (K + 1,) int64    the joints of class k are [starts[k], starts[k + 1])
    rotations : (F, P, 4) float64    unit rotations relative to the parent
    positions : (F, P, 3) float64    metres, relative to the ground below the hips, with the heading removed
    velocities : (F, P, 3) float64    metres per second, derivatives of `positions`
    cyclic : bool    whether the first frame follows the last
    """

    skeleton: Skeleton
    rate_hz: float
    classes: tuple[str, ...]
    starts: Ints
    rotations: Floats
    positions: Floats
    velocities: Floats
    cyclic: bool

    @property
    def frame_count(self) -> int:
        """Number of frames F."""
        return len(self.positions)

    def sliced(self, start: int, stop: int) -> MeasuredClip:
        """Select a range of frames.

        Parameters
        ----------
        start, stop : int    first frame, and the frame after the last

        Returns
        -------
        MeasuredClip    the frames [start, stop), not cyclic; its arrays are views
        """
        frames = slice(start, stop)
        return replace(
            self,
            rotations=self.rotations[frames],
            positions=self.positions[frames],
            velocities=self.velocities[frames],
            cyclic=False,
        )

    def at(self, times: Floats) -> MeasuredClip:
        """Interpolate between frames.

        Parameters
        ----------
        times : (n,) float64    fractional frame numbers from 0 to F - 1; for a cyclic clip, any numbers, because
            frame F is frame 0 of the next cycle

        Returns
        -------
        MeasuredClip    n frames
        """
        whole = np.round(times)
        times = np.where(np.abs(times - whole) <= _ROUNDED_FRAMES, whole, times)
        before = np.floor(times).astype(np.int64)
        share = (times - before)[:, None, None]
        if self.cyclic:
            frames = before % self.frame_count, (before + 1) % self.frame_count
        else:
            last = self.frame_count - 1
            frames = np.clip(before, 0, last), np.clip(before + 1, 0, last)
        one, other = (self.rotations[each] for each in frames)
        return MeasuredClip(
            self.skeleton,
            self.rate_hz,
            self.classes,
            self.starts,
            np.where(share == 0.0, one, quaternions.slerp(one, other, share[..., 0])),
            (1.0 - share) * self.positions[frames[0]] + share * self.positions[frames[1]],
            (1.0 - share) * self.velocities[frames[0]] + share * self.velocities[frames[1]],
            self.cyclic,
        )


def measure_motion(motion: Motion, body: MatchingBody, rate_hz: float, *, seam: LoopSeam | None = None) -> MeasuredClip:
    """Measure a motion for the metric.

    In each frame, the point on the ground below the hips becomes the origin, and a smoothed heading is removed. The
    heading is smoothed by a line that is fitted to a window of one second around the frame. One second is about one
    cycle of walking, so the rotations of the pelvis within a cycle are not removed. Near the ends of the clip, the line
    is fitted to its first or last second.

    Parameters
    ----------
    motion : Motion    F frames
    body : MatchingBody    body of its skeleton
    rate_hz : float    frames per second
    seam : LoopSeam, optional    movement of a loop from each round to the next; None if the clip is not a loop

    Returns
    -------
    MeasuredClip    F frames

    Raises
    ------
    MotionError    if no frame has a facing direction, or the skeleton has no joint class
    """
    classes, joints, starts = _classes(body)
    around = 0 if seam is None else window_frames(DIRECTION_WINDOW_S, rate_hz)
    longer = motion if seam is None else continue_motion(motion, seam, around, around)
    places = longer.positions(body.skeleton)
    facing = np.unwrap(headings(forward_directions(places, body.lefts, body.rights)))
    ahead = _line_of_a_second(facing, rate_hz)
    positions = places[:, joints]
    hips = places[:, body.hips]
    ground = positions[..., ::2] - hips[:, None, ::2]
    positions[..., ::2] = rotated(ground, -ahead[:, None])
    inner = slice(around, around + motion.frame_count)
    return MeasuredClip(
        body.skeleton,
        rate_hz,
        classes,
        starts,
        motion.rotations[:, joints],
        positions[inner],
        np.asarray(velocities(positions, rate_hz), np.float64)[inner],
        seam is not None,
    )


def require_comparable(a: MeasuredClip, b: MeasuredClip) -> None:
    """Check that two clips have the same joints, rest rotations, joint classes and frame rate.

    Parameters
    ----------
    a, b : MeasuredClip    clips

    Raises
    ------
    MotionError    if they cannot be compared
    """
    one, other = a.skeleton, b.skeleton
    alike = one.joint_names == other.joint_names and np.array_equal(one.parents, other.parents)
    if not alike or np.abs(np.sum(one.rest_rotations * other.rest_rotations, axis=1)).min() < 1.0 - _SAME_REST:
        raise MotionError(
            "the clips have different skeletons, so the angles of their joints have different meanings; retarget one "
            "of the clips to the skeleton of the other",
            code="skeletons-differ",
        )
    if a.classes != b.classes:
        raise MotionError(
            "the joint mappings of the clips contain different joints of the metric; give both clips the same mapping"
        )
    if abs(a.rate_hz - b.rate_hz) > 1e-6 * a.rate_hz:
        raise MotionError(
            f"the clips have {a.rate_hz:g} and {b.rate_hz:g} frames per second; resample one of them",
            code="frame-rates-differ",
        )


def classes_measured(clip: MeasuredClip, measurement: Measurement) -> tuple[str, ...]:
    """List the joint classes that a measurement of a clip has.

    Parameters
    ----------
    clip : MeasuredClip    clip
    measurement : str    angles, positions or velocities

    Returns
    -------
    tuple of str    joint classes; for angles without hand and toe
    """
    return tuple(name for name in clip.classes if measurement != "angles" or name not in WITHOUT_ANGLES)


def _classes(body: MatchingBody) -> tuple[tuple[str, ...], list[int], Ints]:
    """Find the joint classes of a skeleton: their names, their joints and where the joints of each class start."""
    found = {
        name: [body.standard_joints[joint] for joint in joints if joint in body.standard_joints]
        for name, joints in JOINT_CLASSES.items()
    }
    found = {name: joints for name, joints in found.items() if joints}
    if not found:
        raise MotionError(
            "the joint mapping contains none of the joints that a perceptual metric compares; map head, arms and legs",
            code="mapping-invalid",
        )
    starts = np.cumsum([0, *map(len, found.values())])
    return tuple(found), [joint for joints in found.values() for joint in joints], starts


def _line_of_a_second(values: Floats, rate_hz: float) -> Floats:
    """Smooth values by a line fitted to a window of one second around each value.

    If there are fewer values than in a second, the window contains nearly all values.
    """
    from scipy.signal import savgol_filter

    window = min(window_frames(DIRECTION_WINDOW_S, rate_hz), len(values) - (len(values) + 1) % 2)
    return values if window < 3 else np.asarray(savgol_filter(values, window, 1))
