"""Inverse kinematics: joint rotations that bring points, orientations and look-at axes to their targets.

There are three solvers. Without `Neighbours`, a solver solves frames independently: the result for a frame does not
depend on other frames. With `Neighbours`, joints move smoothly from frame to frame, as far as the targets leave a
choice.

Without `Neighbours`, no solver returns a pose with a larger error than the given pose; with `Neighbours`, only the
two-bone solver guarantees this. The error is the weighted sum of the squared errors of all targets; an angle counts as
`ANGLE_LENGTH_M` metres per radian. If the given pose violates limits, the pose is brought within the limits before the
comparison.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from marey_motion.arrays import Flags, Floats
from marey_motion.editing.inverse_kinematics.limbs import TwoBoneLimb, limb_targets
from marey_motion.editing.inverse_kinematics.neighbouring import solve_in_order
from marey_motion.editing.inverse_kinematics.problem import IkProblem, SolverResult, pose_problem
from marey_motion.editing.inverse_kinematics.swivels import swivel_coherently
from marey_motion.editing.inverse_kinematics.targets import (
    Freedom,
    Neighbours,
    OrientationTarget,
    PositionTarget,
    SolverOptions,
    Target,
)
from marey_motion.errors import EditError
from marey_motion.motion import Motion
from marey_motion.skeleton import Skeleton
from marey_schemas.editing.constraints import Solver

Ending = Literal["carried", "held"]

_ANYWHERE = Freedom()
_OPTIONS = SolverOptions()
_STILL = np.array([[1.0, 0.0, 0.0, 0.0]])

# Sum of squared errors that counts as none: that of a nanometre; with a pole, that of a micrometre, because a pose that
# meets its target already must still turn towards the pole.
_ROUNDING, _WITH_POLE = 1e-18, 1e-12


@dataclass(frozen=True, eq=False)
class SolvedPoses:
    """Result of a solver for F frames and C targets.

    Parameters
    ----------
    motion : the frames, with the joints turned
    residual_before, residual_after : (F, C) error of each target before and after, in metres (position) or radians
        (orientation, look-at)
    iterations : (F,) number of sweeps (ccd) or steps (least squares) in each frame; 0 or 1 for the two-bone solver
    reached : (F,) whether all targets are met within the tolerances
    """

    motion: Motion
    residual_before: Floats
    residual_after: Floats
    iterations: NDArray[np.int64]
    reached: NDArray[np.bool_]


class _LimbKernel(NamedTuple):
    """A limb whose joints are numbered as in the arrays of the kernels."""

    start: int
    middle: int
    end: int
    offset: Floats
    hinge: Floats
    damping_zone: float
    ending: int


def solve(
    skeleton: Skeleton,
    motion: Motion,
    targets: Sequence[Target],
    *,
    freedom: Freedom = _ANYWHERE,
    limb: TwoBoneLimb | None = None,
    solver: Solver = "auto",
    options: SolverOptions = _OPTIONS,
    neighbours: Neighbours | None = None,
    damping_zone_rad: float = 0.0,
) -> SolvedPoses:
    """Solve inverse kinematics with a given solver, or with the solver that suits the targets.

    Parameters
    ----------
    skeleton : Skeleton    J joints
    motion : Motion    F frames, which stay unchanged
    targets : sequence of targets    C targets
    freedom : Freedom    joints that may turn; if `freedom.joints` is None and a limb is given, only the limb turns
    limb : TwoBoneLimb, optional    a limb that may turn; it is ignored if `freedom.joints` lacks one of its joints
    solver : str    "auto", "ccd", "two_bone" or "least_squares". "auto" uses the two-bone solver if a limb is given,
        joints have no limits, and the targets are a position of the limb's end in all axes and, optionally, an
        orientation of this end. Otherwise, "auto" uses least squares. If the two-bone solver misses the targets in any
        frame, for example because the limb is too short, and other joints or the root may move, "auto" uses least
        squares instead. If all targets are orientations of the limb's end, this end turns first. Other joints turn,
        too, only in frames in which the end alone cannot reach the targets, for example because of its limits.
    options : SolverOptions    tolerances and iterations
    neighbours : Neighbours, optional    order of the frames in time; None solves each frame alone
    damping_zone_rad : float    damping of stretching limbs, as in `solve_two_bone`

    Returns
    -------
    SolvedPoses    F frames and the errors before and after

    Raises
    ------
    EditError    if a target is invalid (the error names it), or if the solver cannot be used for these targets
    """
    if limb is not None and freedom.joints is not None and not set(limb.joints) <= set(freedom.joints):
        limb = None
    asked = limb_targets(targets, limb)
    if solver == "two_bone" or (solver == "auto" and asked is not None and not freedom.limits):
        if asked is None or limb is None:
            raise EditError(
                "the two-bone solver needs a limb whose joints may turn and, for the end of the limb, one position "
                "target in all axes and at most one orientation target; use another solver",
                code="solver-unfit",
                where="solver",
            )
        position, orientation = asked
        exact = solve_two_bone(
            skeleton, motion, limb, position, orientation=orientation, options=options, neighbours=neighbours,
            damping_zone_rad=damping_zone_rad,
        )  # fmt: skip
        others = set(freedom.joints or ()) - set(limb.joints)
        if solver == "two_bone" or exact.reached.all() or not (others or freedom.root_moves):
            return exact
    _refuse_poles(targets)
    chosen = partial(solve_ccd if solver == "ccd" else solve_least_squares, neighbours=neighbours)
    if limb is not None:
        freedom = replace(freedom, joints=limb.joints if freedom.joints is None else freedom.joints)
        if all(isinstance(one, OrientationTarget) and one.joint == limb.end for one in targets):
            alone = replace(freedom, joints=(limb.end,))
            turned = chosen(skeleton, motion, targets, freedom=alone, options=options)
            if turned.reached.all() or freedom.joints == alone.joints:
                return turned
            helped = chosen(skeleton, turned.motion, targets, freedom=freedom, options=options)
            iterations = turned.iterations + helped.iterations
            return replace(helped, residual_before=turned.residual_before, iterations=iterations)
    return chosen(skeleton, motion, targets, freedom=freedom, options=options)


def _refuse_poles(targets: Sequence[Target]) -> None:
    """Raise `EditError` if a target has a pole, which only the closed form for limbs can follow."""
    for number, target in enumerate(targets):
        if isinstance(target, PositionTarget) and target.pole is not None:
            raise EditError(
                "a pole works only with the two-bone solver; constrain the position of a wrist or ankle in all axes, "
                "without joint limits, without turning joints above the limb, and without other constraints in the "
                "same frames except an orientation of the same joint",
                code="solver-unfit",
                where=f"targets[{number}].pole",
            )


def solve_ccd(
    skeleton: Skeleton,
    motion: Motion,
    targets: Sequence[Target],
    *,
    freedom: Freedom = _ANYWHERE,
    options: SolverOptions = _OPTIONS,
    neighbours: Neighbours | None = None,
) -> SolvedPoses:
    """Solve by cyclic coordinate descent: each joint in turn, from the targets to the root, gets its best rotation.

    For one target, the best rotation is the shortest rotation that aims at the target (Wright 2015). For several
    targets, it is the solution of Wahba's problem (Davenport's q-method). For a hinge, it is the best angle within the
    limits of the hinge. The best pose of all sweeps is returned.

    Parameters
    ----------
    skeleton : Skeleton    J joints
    motion : Motion    F frames
    targets : sequence of targets    C targets
    freedom : Freedom    joints that may turn
    options : SolverOptions    tolerances and iterations
    neighbours : Neighbours, optional    order of the frames in time; None solves each frame alone

    Returns
    -------
    SolvedPoses    F frames and the errors before and after

    Raises
    ------
    EditError    if a target is invalid (the error names it), or if `freedom.root_moves` is True
    """
    from marey_motion.editing.inverse_kinematics import ccd_kernels

    if freedom.root_moves:
        raise EditError(
            "cyclic coordinate descent cannot shift the root; use least squares",
            code="solver-unfit",
            where="root_moves",
        )
    problem = pose_problem(skeleton, motion, targets, freedom)
    found, room = problem.found, problem.descent_scratch
    solve_in_order(ccd_kernels.descend, problem, options, room, found, neighbours)
    return _solved(motion, problem, found)


def solve_least_squares(
    skeleton: Skeleton,
    motion: Motion,
    targets: Sequence[Target],
    *,
    freedom: Freedom = _ANYWHERE,
    options: SolverOptions = _OPTIONS,
    neighbours: Neighbours | None = None,
) -> SolvedPoses:
    """Solve by damped least squares over all targets, with the analytic Jacobian of rotation-vector displacements.

    Minimises the sum of the weighted squared errors and of the squared displacements (`regularisation_m` metres per
    radian), so that rotations that do not affect a target stay unchanged. Joints at a limit slide along it.

    Parameters
    ----------
    skeleton : Skeleton    J joints
    motion : Motion    F frames
    targets : sequence of targets    C targets
    freedom : Freedom    joints that may turn
    options : SolverOptions    tolerances and iterations
    neighbours : Neighbours, optional    order of the frames in time; None solves each frame alone

    Returns
    -------
    SolvedPoses    F frames and the errors before and after

    Raises
    ------
    EditError    if a target is invalid; the error names it
    """
    from marey_motion.editing.inverse_kinematics import least_squares_kernels

    problem = pose_problem(skeleton, motion, targets, freedom)
    found, room = problem.found, problem.least_squares_scratch(options.regularisation_m)
    solve_in_order(least_squares_kernels.solve_frames, problem, options, room, found, neighbours)
    return _solved(motion, problem, found)


def solve_two_bone(
    skeleton: Skeleton,
    motion: Motion,
    limb: TwoBoneLimb,
    position: PositionTarget,
    *,
    orientation: OrientationTarget | None = None,
    ending: Ending = "carried",
    damping_zone_rad: float = 0.0,
    options: SolverOptions = _OPTIONS,
    neighbours: Neighbours | None = None,
) -> SolvedPoses:
    """Bring a limb's end to a position in closed form; a limb that is too short is straightened towards the position.

    The middle joint opens or closes in the plane of the limb; then the limb is aimed (Lee and Shin 1999, 5.3).

    Parameters
    ----------
    skeleton : Skeleton    J joints
    motion : Motion    F frames
    limb : TwoBoneLimb    the limb
    position : PositionTarget    target of the limb's end
    orientation : OrientationTarget, optional    orientation of the limb's end
    ending : str    used without `orientation`: "carried" keeps the local rotation of the limb's end, "held" keeps its
        orientation in the world
    damping_zone_rad : float    within this angle of the straight limb, in radians, changes of the middle joint are
        damped, so that the joint does not snap (Kovar, Schreiner and Gleicher 2002); targets that need such angles are
        missed slightly
    options : SolverOptions    tolerances
    neighbours : Neighbours, optional    order of the frames in time; None solves each frame alone

    Returns
    -------
    SolvedPoses    F frames and the errors before and after

    Raises
    ------
    EditError    if the joints form no limb, if a target is not for the limb's end, or if `position` leaves an axis free
    """
    from marey_motion.editing.inverse_kinematics import two_bone_kernels

    targets: tuple[Target, ...] = (position,) if orientation is None else (position, orientation)
    if limb_targets(targets, limb) is None:
        raise EditError(
            "in the two-bone solver, all targets must be for the end of the limb, and the position target "
            "must constrain all three axes",
            where="targets",
        )
    path = skeleton.path_to_root(limb.end)
    if not {limb.middle, limb.start} <= set(path) or not limb.start < limb.middle < limb.end:
        raise EditError(
            "the joint `middle` of a limb must be a descendant of `start`, and `end` a descendant of `middle`",
            code="chain-invalid",
            where="limb",
        )
    problem = pose_problem(skeleton, motion, targets, Freedom(limb.joints))
    found = problem.found
    _measure(problem, options, found.before, found)
    before, reached_before = problem.rotations.copy(), found.reached.copy()
    kernel_limb = _kernel_limb(problem, limb, "given" if orientation else ending, damping_zone_rad)
    two_bone_kernels.reach_frames(
        kernel_limb,
        problem.body,
        np.ascontiguousarray(problem.targets.values[:, 0, :3]),
        _STILL if orientation is None else np.ascontiguousarray(problem.targets.values[:, 1]),
        problem.roots,
        problem.rotations,
        problem.descent_scratch,
    )
    if neighbours is not None:
        pole = None if position.pole is None else np.asarray(position.pole, dtype=np.float64)
        swivel_coherently(kernel_limb, problem, before, neighbours, pole)
    _measure(problem, options, found.after, found)
    worse = _restore_better(problem, before, found, _ROUNDING if position.pole is None else _WITH_POLE)
    found.reached[worse] = reached_before[worse]
    return _solved(motion, problem, found)


def _kernel_limb(
    problem: IkProblem, limb: TwoBoneLimb, ending: Literal["carried", "held", "given"], damping_zone_rad: float
) -> _LimbKernel:
    from marey_motion.editing.inverse_kinematics import two_bone_kernels

    start, middle, end = np.searchsorted(problem.joints, (limb.start, limb.middle, limb.end)).tolist()
    endings = {
        "carried": two_bone_kernels.CARRIED,
        "held": two_bone_kernels.HELD,
        "given": two_bone_kernels.GIVEN,
    }
    hinge = np.array(limb.hinge or (0.0, 0.0, 0.0))
    offset = problem.targets.offsets[0]
    return _LimbKernel(start, middle, end, offset, hinge, float(damping_zone_rad), endings[ending])


def _restore_better(problem: IkProblem, before: Floats, found: SolverResult, allowed: float) -> Flags:
    """Restore the given pose and its errors in each frame whose error was increased by the closed form.

    `before` (F, K, 4) are the given local rotations, and `allowed` is by how much the sum of squared errors may
    increase. The error can increase if the wrist turns a tool away from its target. In all other frames, the number of
    iterations is set to 1. Returns (F,) whether each frame was restored.
    """
    squares = problem.targets.scales**2
    worse: Flags = (found.after**2) @ squares > (found.before**2) @ squares + allowed
    problem.rotations[worse] = before[worse]
    found.after[worse] = found.before[worse]
    found.iterations[~worse] = 1
    return worse


def _measure(problem: IkProblem, options: SolverOptions, residuals: Floats, found: SolverResult) -> None:
    from marey_motion.editing.inverse_kinematics import pose_kernels

    pose_kernels.measure_frames(
        problem.body,
        problem.targets,
        (float(options.tolerance_m), float(options.tolerance_rad)),
        problem.roots,
        problem.rotations,
        problem.descent_scratch,
        residuals,
        found.reached,
    )


def measure_residuals(skeleton: Skeleton, motion: Motion, targets: Sequence[Target]) -> Floats:
    """Compute the error of each target in each frame.

    Parameters
    ----------
    skeleton : Skeleton    J joints
    motion : Motion    F frames
    targets : sequence of targets    C targets

    Returns
    -------
    (F, C) float64    metres for position targets, radians for orientation and look-at targets
    """
    problem = pose_problem(skeleton, motion, targets, _ANYWHERE)
    found = problem.found
    _measure(problem, _OPTIONS, found.before, found)
    return found.before


def _solved(motion: Motion, problem: IkProblem, found: SolverResult) -> SolvedPoses:
    return SolvedPoses(problem.put_back(motion), found.before, found.after, found.iterations, found.reached)
