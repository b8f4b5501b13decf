"""Errors of constraints and their derivatives, computed as in the least-squares solver, for tests."""

from __future__ import annotations

from collections.abc import Sequence

from marey_motion.arrays import Floats
from marey_motion.editing.inverse_kinematics import least_squares_kernels
from marey_motion.editing.inverse_kinematics.problem import pose_problem
from marey_motion.editing.inverse_kinematics.targets import Freedom, Target
from marey_motion.motion import Motion
from marey_motion.skeleton import Skeleton

ANYWHERE = Freedom()


def constraint_jacobian(
    skeleton: Skeleton, motion: Motion, targets: Sequence[Target], freedom: Freedom = ANYWHERE
) -> tuple[Floats, Floats, tuple[int, ...]]:
    """Return scaled errors (3·C,) of the first frame, their derivatives (3·C, 3·V + 3), and the V joints that vary.

    The first 3·V columns belong to displacements d of local rotations, q·exp(d), in the order of the returned joints.
    The last three columns belong to the translation of the root. They are zero if `freedom` does not let the root move.
    """
    problem = pose_problem(skeleton, motion, targets, freedom)
    room = problem.least_squares_scratch(0.0)
    least_squares_kernels.residuals_and_jacobian(problem.body, problem.targets, problem.roots, problem.rotations, room)
    return room.scaled_errors, room.jacobian, tuple(problem.joints[problem.body.movable].tolist())
