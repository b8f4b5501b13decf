"""Constraints on ranges of frames, which are solved by inverse kinematics and blended into the frames around them.

Two constraints are solved together if one constraint turns a joint, and the other constraint turns or depends on the
same joint. All other constraints are solved separately.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal

import numpy as np

from marey_motion import kinematics, quaternions
from marey_motion.arrays import Floats, Ints
from marey_motion.editing.compute_budget import PER_CONSTRAINED_NUMBER, PER_CONSTRAINT_GROUP, ComputeBudget
from marey_motion.editing.displacement import displace, windows_around
from marey_motion.editing.inverse_kinematics.limbs import TwoBoneLimb, limb_targets
from marey_motion.editing.inverse_kinematics.solving import measure_residuals, solve
from marey_motion.editing.inverse_kinematics.targets import (
    Freedom,
    LookAtTarget,
    Neighbours,
    OrientationTarget,
    PositionTarget,
    SolverOptions,
    Target,
)
from marey_motion.editing.limb_smoothing import LimbSmoother, largest_steps
from marey_motion.errors import EditError
from marey_motion.motion import Motion
from marey_motion.skeleton import Skeleton
from marey_schemas.editing.constraints import Solver

MOST_ROUNDS = 12
"""Maximum number of rounds in which constraints on different ranges of frames are solved one after another."""
SMALL_ERROR = 1e-3
"""The rounds end early if the error of every constraint is below this value, in metres or radians."""
_PER_FRAME = 40_000
"""Work per frame, in nanoseconds, to prepare the arrays, measure the errors and evaluate closed forms."""
_LIMIT_PASSES = 4
FLIP_SHARE = 0.25
"""Share of a range of frames over which the flip of a limb is spread, unless the blend has more frames."""

Method = Literal["ccd", "two_bone", "least_squares"]


@dataclass(frozen=True, eq=False)
class Constraint:
    """A target of inverse kinematics for the frames [start, stop).

    Parameters
    ----------
    target : the target, with one value for all of these frames or one value per frame
    joints : indices of the joints that may turn to meet the target
    limb : the limb that ends at the target's joint, if any; the limb is solved alone before other joints turn
    """

    target: Target
    start: int
    stop: int
    joints: tuple[int, ...]
    limb: TwoBoneLimb | None = None


@dataclass(frozen=True, eq=False)
class ConstrainedMotion:
    """A motion in which constraints are met as well as possible.

    Parameters
    ----------
    motion : the whole motion
    residuals_before, residuals_after : error of each constraint in each of its frames, before and after constraining,
        in metres (positions) or radians (orientations and look-at targets)
    """

    motion: Motion
    residuals_before: tuple[Floats, ...]
    residuals_after: tuple[Floats, ...]


def constrain_motion(
    skeleton: Skeleton,
    motion: Motion,
    constraints: Sequence[Constraint],
    *,
    blend_frames: int,
    freedom: Freedom | None = None,
    solver: Solver = "auto",
    options: SolverOptions | None = None,
    budget: ComputeBudget | None = None,
    damping_zone_rad: float = 0.0,
) -> ConstrainedMotion:
    """Change a motion so that it meets constraints, and blend the change into the frames before and after them.

    Parameters
    ----------
    skeleton : Skeleton    J joints
    motion : Motion    F frames
    constraints : sequence of Constraint    C constraints
    blend_frames : int    number of frames that may change before the first and after the last constrained frame
    freedom : Freedom, optional    limits, stiffness and whether the root moves; the joints that may turn are given by
        the constraints
    solver : str    "auto", "ccd", "two_bone" or "least_squares"; "auto" uses the two-bone solver for limbs and least
        squares for everything else
    options : SolverOptions, optional    tolerances and iterations
    budget : ComputeBudget, optional    remaining work; reduced by the work of this call
    damping_zone_rad : float    angle before full extension at which the damping of a stretching limb begins (two-bone
        solver only); 0 for none

    Returns
    -------
    ConstrainedMotion    F frames and the remaining errors

    Raises
    ------
    EditError    if a constraint is invalid (the error names it) or the budget is too small
    """
    freedom = freedom or Freedom()
    for number, constraint in enumerate(constraints):
        _check_range(constraint, number, motion.frame_count)
    before = tuple(residuals_of(skeleton, motion, constraint) for constraint in constraints)
    changed = motion
    usual = largest_steps(np.asarray(motion.positions(skeleton), dtype=np.float64))
    for cluster in _clusters(skeleton, constraints, freedom.root_moves):
        solving = _Cluster(
            skeleton,
            cluster,
            freedom,
            solver,
            options or SolverOptions(),
            budget or ComputeBudget(),
            damping_zone_rad,
            usual,
        )
        changed = solving.constrained(changed, blend_frames)
    after = tuple(residuals_of(skeleton, changed, constraint) for constraint in constraints)
    return ConstrainedMotion(changed, before, after)


def current_values(skeleton: Skeleton, motion: Motion, target: PositionTarget | OrientationTarget) -> Floats:
    """Compute the values that a target would need so that the unchanged motion meets it exactly.

    Parameters
    ----------
    skeleton : Skeleton    J joints
    motion : Motion    F frames
    target : PositionTarget or OrientationTarget    the target

    Returns
    -------
    (F, 3) or (F, 4) float64    metres, or unit quaternions in the world
    """
    spins = kinematics.as_global_rotations(skeleton, motion.rotations)[:, target.joint]
    if isinstance(target, OrientationTarget):
        return np.asarray(spins, dtype=np.float64)
    tips = motion.positions(skeleton)[:, target.joint]
    return np.asarray(tips + quaternions.rotate_vectors(spins, np.asarray(target.offset)), dtype=np.float64)


def _check_range(constraint: Constraint, number: int, frames: int) -> None:
    start, stop = constraint.start, constraint.stop
    if not 0 <= start < stop <= frames:
        raise EditError(
            f"the range {start}:{stop} must be within the clip's frames 0:{frames}, with its start before its stop",
            code="frames-missing",
            where=f"constraints[{number}]",
        )
    if len(constraint.target.values) not in (1, stop - start):
        raise EditError(
            f"the target has {len(constraint.target.values)} values for {stop - start} frames; give one "
            "value, or one per frame",
            where=f"constraints[{number}]",
        )


def residuals_of(skeleton: Skeleton, motion: Motion, constraint: Constraint) -> Floats:
    """Compute the error of a constraint in each of its frames: how far the motion misses the target.

    Parameters
    ----------
    skeleton : Skeleton    J joints
    motion : Motion    F frames
    constraint : Constraint    a constraint on n frames

    Returns
    -------
    (n,) float64    metres for a position target, radians for an orientation or look-at target
    """
    part = motion.at_frames(np.arange(constraint.start, constraint.stop))
    return measure_residuals(skeleton, part, [constraint.target])[:, 0]


def _clusters(
    skeleton: Skeleton, constraints: Sequence[Constraint], together: bool
) -> tuple[tuple[Constraint, ...], ...]:
    """Group the constraints that must be solved together, since one of them turns a joint that affects another of them.

    If `together` is true, all constraints are in one group.
    """
    clusters: list[tuple[set[int], set[int], list[Constraint]]] = []
    for constraint in constraints:
        turning = set(constraint.joints)
        carrying = set(skeleton.path_to_root(constraint.target.joint))
        members = [constraint]
        apart = []
        for cluster in clusters:
            if together or turning & (cluster[0] | cluster[1]) or carrying & cluster[0]:
                turning, carrying, members = turning | cluster[0], carrying | cluster[1], cluster[2] + members
            else:
                apart.append(cluster)
        clusters = [*apart, (turning, carrying, members)]
    return tuple(tuple(members) for _, _, members in clusters)


@dataclass(frozen=True, eq=False)
class _Cluster:
    """Constraints that are solved together, with their solver and options."""

    skeleton: Skeleton
    constraints: Sequence[Constraint]
    freedom: Freedom
    solver: Solver
    options: SolverOptions
    budget: ComputeBudget
    damping_zone_rad: float
    usual: Floats

    def constrained(self, motion: Motion, blend_frames: int) -> Motion:
        """Solve the constraints and blend the solution into the motion before and after the constrained frames.

        Constraints on different ranges are first solved one range after another, and each solution is blended into
        the motion, until the remaining errors are small. Then all ranges are solved together; this last solution
        changes little at the borders of a range.
        """
        spans: dict[tuple[int, int], list[Constraint]] = {}
        for one in self.constraints:
            spans.setdefault((one.start, one.stop), []).append(one)
        for _ in range(MOST_ROUNDS if len(spans) > 1 else 0):
            for together in spans.values():
                motion = self._met(motion, together, blend_frames)
            if max(residuals_of(self.skeleton, motion, one).max() for one in self.constraints) < SMALL_ERROR:
                break
        return self._met(motion, self.constraints, blend_frames)

    def _met(self, motion: Motion, constraints: Sequence[Constraint], blend_frames: int) -> Motion:
        self.budget.spend(PER_CONSTRAINT_GROUP + PER_CONSTRAINED_NUMBER * motion.rotations.size)
        frames = np.unique(np.concatenate([np.arange(one.start, one.stop) for one in constraints]))
        active = np.array([(frames >= one.start) & (frames < one.stop) for one in constraints])
        given = motion.at_frames(frames)
        rotations, roots = given.rotations.copy(), given.root_translations.copy()
        sets, which = np.unique(active, axis=1, return_inverse=True)
        for number, chosen in enumerate(sets.T):
            here = np.flatnonzero(which.reshape(-1) == number)
            asked = [one for one, counts in zip(constraints, chosen, strict=True) if counts]
            solved = self._solve(given.at_frames(here), frames[here], asked, blend_frames)
            rotations[here], roots[here] = solved.rotations, solved.root_translations
        changed = given._replace(rotations=rotations, root_translations=roots)
        return displace(motion, frames, changed, windows_around(frames, blend_frames, motion.frame_count))

    def _solve(self, given: Motion, frames: Ints, constraints: Sequence[Constraint], blend_frames: int) -> Motion:
        """Solve frames that all have the same constraints; return only these frames.

        `given` is the motion in these frames, and `frames` are their numbers. If a limb would flip from one frame to
        the next, the flip is spread over `blend_frames` frames or over the share `FLIP_SHARE` of the frames, whichever
        is longer.
        """
        reach = max(blend_frames, FLIP_SHARE * len(frames), 1.0)
        limb = constraints[0].limb if all(one.limb == constraints[0].limb for one in constraints) else None
        joints = tuple(sorted({joint for one in constraints for joint in one.joints}))
        targets, neighbours = [_target_at(one, frames) for one in constraints], Neighbours(frames, reach)
        solved = self._solver_of(constraints, limb, joints)
        made = solved(given, targets, neighbours)
        if limb is None or self._method(constraints, limb, joints) != "two_bone" or not self.damping_zone_rad:
            return made
        return self._smoothed(given, made, targets, limb, neighbours, solved)

    def _solver_of(
        self, constraints: Sequence[Constraint], limb: TwoBoneLimb | None, joints: tuple[int, ...]
    ) -> Callable[[Motion, Sequence[Target], Neighbours], Motion]:
        freedom = replace(self.freedom, joints=joints)

        def solved(given: Motion, targets: Sequence[Target], neighbours: Neighbours) -> Motion:
            self.budget.spend(self._work(given.frame_count, constraints, limb, joints))
            return solve(
                self.skeleton, given, targets, freedom=freedom, limb=limb, solver=self.solver, options=self.options,
                neighbours=neighbours, damping_zone_rad=self.damping_zone_rad,
            ).motion  # fmt: skip

        return solved

    def _smoothed(
        self,
        given: Motion,
        made: Motion,
        targets: Sequence[Target],
        limb: TwoBoneLimb,
        neighbours: Neighbours,
        solved: Callable[[Motion, Sequence[Target], Neighbours], Motion],
    ) -> Motion:
        """Smooth the limb's path in runs of frames in which the limb jumps, and solve these runs for the smoother path.

        `given` is the motion before it is solved, and `made` is the solution for `targets`. Returns `made` if the
        position target has a pole or an offset.
        """
        (place,) = (one for one in targets if isinstance(one, PositionTarget))
        if place.pole is not None or np.any(place.offset):
            return made
        rotations = made.rotations.copy()
        for start, stop in neighbours.runs:
            rows = slice(start, stop)
            run = Neighbours(neighbours.frames[rows], neighbours.reach)
            others = [_rows_of(one, rows) for one in targets if one is not place]
            usual = self.usual[[limb.middle, limb.end]]
            smoother = LimbSmoother(
                self.skeleton, limb, given.sliced(start, stop), usual, run.reach, 0.5 * self.damping_zone_rad
            )
            again = partial(_solved_for, solved, place, others, run)
            path = np.broadcast_to(place.values, (len(neighbours.frames), 3))[rows]
            rotations[rows] = smoother.solved(path, again, made.sliced(start, stop)).rotations
        return made._replace(rotations=rotations)

    def _work(
        self, frames: int, constraints: Sequence[Constraint], limb: TwoBoneLimb | None, joints: tuple[int, ...]
    ) -> float:
        """Estimate the work of solving a number of frames in the worst case, in which no target can be reached."""
        method, limited = self._method(constraints, limb, joints), bool(self.freedom.limits)
        carriers = {carrier for one in constraints for carrier in self.skeleton.path_to_root(one.target.joint)}
        return solving_work(frames, len(carriers), len(constraints), method, limited=limited, options=self.options)

    def _method(self, constraints: Sequence[Constraint], limb: TwoBoneLimb | None, joints: tuple[int, ...]) -> Method:
        asked = limb_targets([one.target for one in constraints], limb)
        alone = limb is not None and set(joints) <= set(limb.joints) and not self.freedom.root_moves
        if self.solver == "two_bone" or (
            self.solver == "auto" and alone and asked is not None and not self.freedom.limits
        ):
            return "two_bone"
        return "ccd" if self.solver == "ccd" else "least_squares"


def _target_at(constraint: Constraint, frames: Ints) -> Target:
    """Select the values of a constraint's target for some of its frames."""
    values = constraint.target.values
    return constraint.target if len(values) == 1 else _with_values(constraint.target, values[frames - constraint.start])


def _rows_of(target: Target, rows: slice) -> Target:
    """Select some frames of a target that has one value per frame; a constant target is returned as it is."""
    return target if len(target.values) == 1 else _with_values(target, target.values[rows])


def _solved_for(
    solved: Callable[[Motion, Sequence[Target], Neighbours], Motion],
    place: PositionTarget,
    others: Sequence[Target],
    neighbours: Neighbours,
    given: Motion,
    path: Floats,
) -> Motion:
    """Solve a run of frames, with the positions of the target `place` replaced by `path` (n, 3)."""
    return solved(given, [replace(place, position=path), *others], neighbours)


def _with_values(target: Target, values: Floats) -> Target:
    if isinstance(target, PositionTarget):
        return replace(target, position=values)
    return replace(target, point=values) if isinstance(target, LookAtTarget) else replace(target, rotation=values)


def solving_work(
    frames: int,
    joints: int,
    targets: int,
    method: Literal["ccd", "two_bone", "least_squares"],
    *,
    limited: bool = False,
    options: SolverOptions | None = None,
) -> float:
    """Estimate the work of inverse kinematics in the worst case, in which no target can be reached.

    Parameters
    ----------
    frames, joints, targets : int    number of frames, of joints above the targets, and of targets
    method : str    "ccd", "two_bone" or "least_squares"
    limited : bool    whether joints have limits, which need additional steps
    options : SolverOptions, optional    iterations

    Returns
    -------
    float    nanoseconds of one thread
    """
    if method == "two_bone":
        return float(frames * _PER_FRAME)
    if method == "ccd":
        round_ = joints * (400 + 30 * targets)
    else:
        rows, columns = 3 * targets, 3 * joints + 3
        products = rows**2 * columns / 2 + rows**3 / 6 + 3 * rows * columns
        step = 0.45 * products * (_LIMIT_PASSES if limited else 1)
        round_ = int(2000 + 150 * joints + 60 * joints * targets + step)
    return float(frames * (_PER_FRAME + (options or SolverOptions()).most_iterations * round_))
