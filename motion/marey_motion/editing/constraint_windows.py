"""Shortening of the frame ranges (windows) of successive constraints, so that a joint has time to change its target."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import permutations

import numpy as np

from marey_motion.arrays import Floats
from marey_motion.editing.constraining import Constraint
from marey_motion.editing.inverse_kinematics.targets import PositionTarget
from marey_motion.editing.limb_smoothing import MOST_STEP


@dataclass(frozen=True)
class JoinedWindows:
    """Two successive constraints of one joint, between whose ranges of frames (windows) the joint would jump.

    `join_windows` has shortened both windows, as far as this was possible.

    Parameters
    ----------
    first, second : numbers of the constraints
    start, stop : frames [start, stop) in which the joint moves from the first target to the second one; empty if the
        windows leave no frames between them, so that the joint jumps from the frame `start - 1` to the frame `stop`
    apart_m : distance between the two targets, metres
    """

    first: int
    second: int
    start: int
    stop: int
    apart_m: float


def join_windows(
    constraints: Sequence[Constraint], usual: Floats, blend_frames: int
) -> tuple[list[Constraint], list[JoinedWindows]]:
    """Shorten successive windows of one joint if the joint would otherwise jump from one target to the next.

    The joint needs `blend_frames` frames to move from the target of the first window to that of the second one. If
    there are fewer frames between the windows, both windows are shortened, each by less than half. So a window that
    is shortened at both ends keeps at least one frame.

    Parameters
    ----------
    constraints : sequence of Constraint    C constraints
    usual : (J,) float64    largest step of each joint between two frames of the unedited motion, metres
    blend_frames : int    number of frames within which a change is blended

    Returns
    -------
    list of Constraint    C constraints, some of them shorter
    list of JoinedWindows    pairs between which joints would jump
    """
    shortened = list(constraints)
    joined = []
    for (first, a), (second, b) in permutations(enumerate(constraints), 2):
        gap = b.start - a.stop
        if not 0 <= gap < max(blend_frames, 1) or not _same_point(a, b):
            continue
        if any(a.stop <= c.start and c.stop <= b.start and _same_point(a, c) for c in constraints):
            continue  # the joint goes to another target in between
        apart = _distance(a, b)
        if apart <= MOST_STEP * float(usual[a.target.joint]) * (gap + 1):
            continue
        lacking = blend_frames - gap
        before = min(lacking // 2, (a.stop - a.start - 1) // 2)
        after = min(lacking - before, (b.stop - b.start - 1) // 2)
        shortened[first] = _within(shortened[first], shortened[first].start, a.stop - before)
        shortened[second] = _within(shortened[second], b.start + after, shortened[second].stop)
        joined.append(JoinedWindows(first, second, a.stop - before, b.start + after, apart))
    return shortened, joined


def _same_point(a: Constraint, b: Constraint) -> bool:
    """Return whether two constraints are position constraints of the same point of the same joint."""
    if not (isinstance(a.target, PositionTarget) and isinstance(b.target, PositionTarget)):
        return False
    return a.target.joint == b.target.joint and np.allclose(a.target.offset, b.target.offset)


def _distance(a: Constraint, b: Constraint) -> float:
    """Compute the distance from the last target of `a` to the first target of `b`, along the axes that both constrain.

    The distance is in metres.
    """
    assert isinstance(a.target, PositionTarget)
    assert isinstance(b.target, PositionTarget)
    axes = ["xyz".index(axis) for axis in a.target.axes if axis in b.target.axes]
    return float(np.linalg.norm((b.target.values[0] - a.target.values[-1])[axes]))


def _within(constraint: Constraint, start: int, stop: int) -> Constraint:
    """Limit a position constraint to the frames [start, stop)."""
    target = constraint.target
    assert isinstance(target, PositionTarget)
    if len(target.values) > 1:
        target = replace(target, position=target.values[start - constraint.start : stop - constraint.start])
    return replace(constraint, target=target, start=start, stop=stop)
