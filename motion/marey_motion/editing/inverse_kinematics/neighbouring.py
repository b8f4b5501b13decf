"""Order in which iterative solvers solve frames, so that joints do not jump between neighbouring frames."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from marey_motion import quaternions
from marey_motion.arrays import AnyFloats, Floats, Ints
from marey_motion.editing.inverse_kinematics.problem import IkProblem, SolverResult
from marey_motion.editing.inverse_kinematics.targets import Neighbours, SolverOptions

JUMP_RAD = 0.1
"""Largest angle, in radians, between the changes that the solver makes to a joint in two successive frames.

If a joint exceeds this angle, it jumps, and the run of frames is solved again.
"""


def solve_in_order(
    kernel: Callable[..., None], problem: IkProblem, options: SolverOptions, room: Any, found: SolverResult,
    neighbours: Neighbours | None,
) -> None:  # fmt: skip
    """Solve each frame alone; a run of frames in which a joint jumps is then solved a second time.

    In the second pass, each frame starts with the change of its neighbour in time.

    Parameters
    ----------
    kernel : callable    an iterative solver, such as `ccd_kernels.descend`
    problem : IkProblem    F frames, which are changed
    options : SolverOptions    tolerances and iterations
    room : named tuple    scratch arrays of the kernel
    found : SolverResult    filled by the kernel
    neighbours : Neighbours, optional    order of the frames in time; None solves each frame alone
    """
    given = problem.rotations.copy(), problem.roots.copy()
    frames = len(problem.roots)
    ends = (int(options.most_iterations), float(options.tolerance_m), float(options.tolerance_rad))
    order, carried = np.arange(frames), np.full(frames, -1)
    kernel(problem.body, problem.targets, ends, *given, order, carried, problem.roots, problem.rotations, room, found)
    if neighbours is None:
        return
    order, carried = _changes_to_carry(given[0], problem.rotations, neighbours)
    kernel(problem.body, problem.targets, ends, *given, order, carried, problem.roots, problem.rotations, room, found)


def _changes_to_carry(given: Floats, solved: Floats, neighbours: Neighbours) -> tuple[Ints, Ints]:
    """Find the frames to solve again, each starting with the change of its neighbour.

    In a run with a jump, the frame with the smallest change stays as it is. From this frame on, the other frames are
    solved one after another: first forwards in time, then backwards.

    Parameters
    ----------
    given, solved : (F, K, 4) float64    local rotations before and after each frame was solved alone
    neighbours : Neighbours    order of the frames in time

    Returns
    -------
    (n,) int    rows in the order in which they are solved again; empty if no joint jumps
    (n,) int    rows whose changes these rows start with
    """
    changes = quaternions.multiply(quaternions.conjugate(given), solved)
    sizes = _angles(changes).max(axis=1)
    jumps = _angles(quaternions.multiply(quaternions.conjugate(changes[:-1]), changes[1:])).max(axis=1)
    order: list[int] = []
    carried: list[int] = []
    for start, stop in neighbours.runs:
        if jumps[start : stop - 1].max(initial=0.0) > JUMP_RAD:
            first = start + int(np.argmin(sizes[start:stop]))
            order += [*range(first + 1, stop), *range(first - 1, start - 1, -1)]
            carried += [*range(first, stop - 1), *range(first, start, -1)]
    return np.array(order, dtype=np.int64), np.array(carried, dtype=np.int64)


def _angles(rotations: AnyFloats) -> Floats:
    """Compute the angles (..., ), in radians, of rotations (..., 4)."""
    sines = np.linalg.norm(rotations[..., 1:], axis=-1)
    return np.asarray(2.0 * np.arctan2(sines, np.abs(rotations[..., 0])), dtype=np.float64)
