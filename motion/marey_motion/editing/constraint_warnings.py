"""Checks of constraints: a constraint without effect is refused, and an unexpected result of constraints is reported.

Warnings report contradictions, missed constraints, and joints that jump.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import combinations

import numpy as np

from marey_motion.arrays import Flags, Floats
from marey_motion.editing.constraining import Constraint
from marey_motion.editing.constraint_windows import JoinedWindows
from marey_motion.editing.inverse_kinematics.targets import OrientationTarget, PositionTarget, SolverOptions, Target
from marey_motion.editing.limb_smoothing import allowed_steps, largest_steps
from marey_motion.errors import EditError
from marey_motion.motion import Motion
from marey_motion.skeleton import Skeleton

MISSED_M, MISSED_DEG = 0.02, 5.0
"""Error of a constraint, in metres or in degrees, above which a warning is given."""
LEAST_LEVER_M = 1e-6
"""Distance of a point from a joint, in metres, up to which turning the joint does not move the point."""
_OPTIONS = SolverOptions()


def require_acting(skeleton: Skeleton, constraint: Constraint, *, root_moves: bool) -> None:
    """Refuse a position constraint if none of the joints that may turn can move the constrained point.

    Parameters
    ----------
    skeleton : Skeleton    J joints
    constraint : Constraint    the constraint
    root_moves : bool    whether the root may be shifted

    Raises
    ------
    EditError    if turning the joints of the constraint does not move its point
    """
    target = constraint.target
    if root_moves or not isinstance(target, PositionTarget):
        return
    reach = float(np.linalg.norm(np.asarray(target.offset)))
    for joint in skeleton.path_to_root(target.joint):
        if joint in constraint.joints and reach > LEAST_LEVER_M:
            return
        reach += float(np.linalg.norm(skeleton.offsets[joint]))
    names = skeleton.joint_names
    turning = ", ".join(names[joint] for joint in constraint.joints)
    raise EditError(
        f"turning {turning} does not move {names[target.joint]}, so this position constraint has no effect; choose a "
        "higher joint as top, or set root_moves",
        code="constraint-idle",
        where="joint",
    )


def contradictions(constraints: Sequence[Constraint]) -> Iterator[str]:
    """List pairs of constraints that require two positions, or two orientations, of one joint in the same frame.

    Parameters
    ----------
    constraints : sequence of Constraint    C constraints

    Yields
    ------
    str    a warning for each pair
    """
    values = [one.target.values for one in constraints]
    for (first, a), (second, b) in combinations(enumerate(constraints), 2):
        start, stop = max(a.start, b.start), min(a.stop, b.stop)
        if start >= stop or a.target.joint != b.target.joint:
            continue
        common = (
            own if len(own) == 1 else own[start - one.start : stop - one.start]
            for one, own in ((a, values[first]), (b, values[second]))
        )
        apart = start + np.flatnonzero(np.broadcast_to(_apart(a.target, b.target, *common), stop - start))
        if apart.size:
            yield (
                f"constraints[{first}] and constraints[{second}] contradict each other in the frames "
                f"{apart[0]}:{apart[-1] + 1}; the result is a compromise according to their weights"
            )


def _apart(a: Target, b: Target, of_a: Floats, of_b: Floats) -> Flags:
    """Mark the frames (F or 1) in which the values (F or 1, 3 or 4) of two targets of one joint cannot both be met."""
    if isinstance(a, PositionTarget) and isinstance(b, PositionTarget) and np.allclose(a.offset, b.offset):
        axes = ["xyz".index(axis) for axis in a.axes if axis in b.axes]
        return np.asarray(np.abs(of_a - of_b)[:, axes].max(axis=1, initial=0.0) > _OPTIONS.tolerance_m)
    if isinstance(a, OrientationTarget) and isinstance(b, OrientationTarget):
        return np.asarray(np.abs((of_a * of_b).sum(axis=1)) < np.cos(0.5 * _OPTIONS.tolerance_rad))
    return np.zeros(1, dtype=np.bool_)


def joined(pairs: Sequence[JoinedWindows]) -> Iterator[str]:
    """Describe in which frames a joint moves from the target of one constraint to the target of the next constraint.

    Parameters
    ----------
    pairs : sequence of JoinedWindows    constraints whose windows were shortened

    Yields
    ------
    str    a warning for each pair
    """
    for pair in pairs:
        both = f"constraints[{pair.first}] and constraints[{pair.second}]"
        apart = f"their targets are {100.0 * pair.apart_m:.1f} cm apart"
        if pair.start < pair.stop:
            yield (
                f"{both} follow each other too closely: {apart}, so the joint goes from the first to the second one in "
                f"the frames {pair.start}:{pair.stop}; leave more frames between them"
            )
        else:
            yield (
                f"{both} follow each other without a gap: {apart}, so the joint jumps between the frames "
                f"{pair.start - 1} and {pair.stop}; leave frames between them, or set blend_s"
            )


def missed(constraints: Sequence[Constraint], residuals: Sequence[Floats]) -> Iterator[str]:
    """Describe the constraints that are missed: by how much, and in how many frames.

    Parameters
    ----------
    constraints : sequence of Constraint    C constraints
    residuals : sequence of (n,) float64    errors of each constraint in its frames, in metres or radians

    Yields
    ------
    str    a warning for each constraint that is missed by more than `MISSED_M` or `MISSED_DEG`
    """
    for number, (one, errors) in enumerate(zip(constraints, residuals, strict=True)):
        is_position = isinstance(one.target, PositionTarget)
        sizes, limit = (errors, MISSED_M) if is_position else (np.degrees(errors), MISSED_DEG)
        worst = int(np.argmax(sizes))
        if sizes[worst] > limit:
            size = f"{100.0 * sizes[worst]:.1f} cm" if is_position else f"{sizes[worst]:.1f} degrees"
            yield (
                f"constraints[{number}] is missed in {int((sizes > limit).sum())} of {len(sizes)} frames, by up to "
                f"{size} in frame {one.start + worst}"
            )


def jumps(
    skeleton: Skeleton, before: Motion, after: Motion, constraints: Sequence[Constraint], blend_frames: int
) -> Iterator[str]:
    """Describe joints that jump: between two frames, they move farther than `limb_smoothing.allowed_steps` allows.

    The allowed distance depends on the largest step of the joint in the unedited motion, on the distance by which the
    constraints move the joint, and on `blend_frames`.

    Parameters
    ----------
    skeleton : Skeleton    J joints
    before, after : Motion    F frames before and after the constraints were met
    constraints : sequence of Constraint    C constraints
    blend_frames : int    number of frames within which a change is blended

    Yields
    ------
    str    a warning for the worst joint of each chain
    """
    places = [np.asarray(one.positions(skeleton), dtype=np.float64) for one in (before, after)]
    moved = np.linalg.norm(places[1] - places[0], axis=-1).max(axis=0)
    usual = largest_steps(places[0])
    excess = np.linalg.norm(np.diff(places[1], axis=0), axis=-1) - allowed_steps(usual, moved, max(blend_frames, 2))
    reported = set()
    for one in constraints:
        chain = [*one.joints, one.target.joint]
        part = excess[max(one.start - blend_frames - 1, 0) : one.stop + blend_frames, chain]
        if not part.size or part.max() <= 0.0:
            continue
        row, column = np.unravel_index(int(np.argmax(part)), part.shape)
        frame, joint = max(one.start - blend_frames - 1, 0) + int(row), chain[int(column)]
        if (frame, joint) in reported:
            continue
        reported.add((frame, joint))
        step = float(np.linalg.norm(places[1][frame + 1, joint] - places[1][frame, joint]))
        yield (
            f"{skeleton.joint_names[joint]} moves {100.0 * step:.1f} cm between the frames {frame} and {frame + 1}; "
            f"before the edit, its largest step was {100.0 * usual[joint]:.1f} cm; use a longer blend_s or a nearer "
            "target"
        )
