"""Windows of constraints that follow each other: a joint gets time to go from one target to the next."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import permutations

import numpy as np

from marey_motion.arrays import Floats
from marey_motion.editing.calm_limbs import MOST_STEP
from marey_motion.editing.constraining import Constraint
from marey_motion.editing.inverse_kinematics.targets import PositionTarget


@dataclass(frozen=True)
class JoinedWindows:
    """Two constraints of one joint between which the joint would jump.

    Parameters
    ----------
    first, second : numbers of the constraints
    start, stop : frames [start, stop) in which the joint goes from the first target to the second one; empty if the
        windows leave no frames, so that it jumps from the frame `start - 1` to the frame `stop`
    apart_m : distance of the two targets
    """

    first: int
    second: int
    start: int
    stop: int
    apart_m: float


def join_windows(
    constraints: Sequence[Constraint], usual: Floats, blend_frames: int
) -> tuple[list[Constraint], list[JoinedWindows]]:
    """Shorten windows of one joint that follow each other, where the joint would jump from one target to the next.

    The ramps out of the first window and into the second one need `blend_frames` together; if there are fewer frames
    between the windows, the rest is taken from both windows, less than half of each, so that a window between two
    others keeps a frame at least.

    Parameters
    ----------
    constraints : sequence of Constraint    C constraints
    usual : (J,) float64    largest step of each joint in the motion before, metres
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
    """Return whether two constraints put the same point of a joint in place."""
    if not (isinstance(a.target, PositionTarget) and isinstance(b.target, PositionTarget)):
        return False
    return a.target.joint == b.target.joint and np.allclose(a.target.offset, b.target.offset)


def _distance(a: Constraint, b: Constraint) -> float:
    """Compute how far the last target of one constraint is from the first one of the next, in their common axes."""
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
