"""Coherent swivels: the middle joint of a limb, such as an elbow, moves smoothly from frame to frame.

The closed form for two bones turns a limb from its given direction to the direction of the target, on the shortest way.
If the two directions are nearly opposite, the shortest way leads to one side in one frame and to the other side in the
next frame, and the middle joint flips although the end of the limb stays where it is. This module therefore adds a
swivel that is close to the shortest way if this way is unambiguous, and that changes slowly from frame to frame.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from marey_motion.arrays import Floats
from marey_motion.editing.inverse_kinematics.problem import IkProblem
from marey_motion.editing.inverse_kinematics.targets import Neighbours

COHERENT_RAD = 0.05
"""Largest change of the swivel between two frames, in radians, at which a run of frames is not corrected."""
LEAST_CLARITY = 1e-4
POLE_FRAMES = 2.0
"""Number of frames over which swivels towards a pole are smoothed."""


def swivel_coherently(
    limb: Any, problem: IkProblem, before: Floats, neighbours: Neighbours, pole: Floats | None
) -> None:
    """Swivel a solved limb so that its middle joint moves smoothly; changes the rotations of `problem`.

    Without a pole, a run of frames stays as it is if the limb swivels by at most `COHERENT_RAD` between two frames, or
    if the correction would not slow down the fastest movement of the limb in this run.

    Parameters
    ----------
    limb : named tuple    the limb, as the two-bone kernels read it
    problem : IkProblem    F solved frames
    before : (F, K, 4) float64    local rotations before they were solved
    neighbours : Neighbours    order of the frames in time
    pole : (3,) float64, optional    point in the world, in metres, to which the middle joint is directed
    """
    from marey_motion.editing.inverse_kinematics import swivel_kernels

    count, work, reach = len(neighbours.frames), problem.descent_scratch, neighbours.reach
    lines, jumps, turns = np.zeros((count, 3)), np.zeros(count), np.zeros(count)
    posed = limb, problem.body, problem.roots
    swivel_kernels.measure_swivels(*posed, before, problem.rotations, work, lines, jumps, turns)
    goal, clear = np.zeros(count), (0.5 + 0.5 * np.cos(turns)) ** 2
    if pole is not None:
        swivel_kernels.pole_swivels(*posed, problem.rotations, pole, work, goal, clear)
        reach = POLE_FRAMES
    angles = np.zeros(count)
    for start, stop in neighbours.runs:
        part = slice(start, stop)
        jumps[start] = 0.0
        if pole is not None or np.abs(jumps[part]).max() > COHERENT_RAD:
            angles[part] = _even_swivels(goal[part], jumps[part], clear[part], reach)
    if not angles.any():
        return
    alone = problem.rotations.copy()
    swivel_kernels.swivel_frames(*posed, angles, lines, problem.rotations, work)
    if pole is None:
        steps = [_limb_speeds(limb, problem, rotations) for rotations in (alone, problem.rotations)]
        for start, stop in neighbours.runs:
            part = slice(start, stop - 1)
            worst = [sum(float(one[part].max(initial=0.0)) for one in both) for both in steps]
            if worst[1] >= worst[0]:
                problem.rotations[start:stop] = alone[start:stop]


def _limb_speeds(limb: Any, problem: IkProblem, rotations: Floats) -> tuple[Floats, Floats]:
    """Compute the speed (F - 1,) of the upper bone's direction in the world, and of the first joint's local rotation.

    Both are in radians per frame. The speed of the bone does not include a twist of a straight limb, and the speed of
    the joint does not include a rotation of the body.
    """
    from marey_motion.editing.inverse_kinematics import swivel_kernels

    bones = np.zeros((len(rotations), 3))
    swivel_kernels.fill_upper_bones(limb, problem.body, problem.roots, rotations, problem.descent_scratch, bones)
    turns = np.sum(rotations[1:, limb.start] * rotations[:-1, limb.start], axis=-1)
    moved = np.linalg.norm(np.diff(bones, axis=0), axis=-1)
    return np.asarray(moved), np.asarray(2.0 * np.arccos(np.minimum(np.abs(turns), 1.0)))


def _even_swivels(goal: Floats, jumps: Floats, clear: Floats, reach: float) -> Floats:
    """Compute swivels (n,) that are near the desired swivels `goal` and turn the limb evenly from frame to frame.

    Minimises Σ clear (a - goal)² + reach² Σ (Δa + jumps)² over the swivels a. `goal` contains angles on a circle;
    `clear`, from 0 to 1, is small where a desired swivel is ambiguous; `jumps` is the swivel of the uncorrected limb
    from the frame before to each frame; and `reach` is the number of frames over which swivels are smoothed. All angles
    are in radians.
    """
    from scipy.linalg import solveh_banded

    carried = np.cumsum(jumps)  # sum of the swivels if none is corrected
    data = _unwrapped(goal + carried, clear)
    weights = np.maximum(clear, LEAST_CLARITY)
    stiff = reach**2
    bands = np.zeros((2, len(data)))
    bands[0] = weights
    bands[0, 1:] += stiff
    bands[0, :-1] += stiff
    bands[1, :-1] = -stiff
    smooth = solveh_banded(bands, weights * data, lower=True, check_finite=False)
    return np.asarray(smooth - carried, dtype=np.float64)


def _unwrapped(angles: Floats, clear: Floats) -> Floats:
    """Add full turns to angles (n,) in radians, so that successive angles differ by at most half a turn.

    Only angles with enough weight `clear` (n,) are compared. An angle with less weight gets the full turns of the last
    compared angle before it.
    """
    weighted = np.flatnonzero(clear >= min(0.05, float(clear.max())))
    turns = np.round(np.diff(angles[weighted]) / (2.0 * np.pi))
    full = np.zeros(len(angles))
    full[weighted[1:]] = turns
    return angles - 2.0 * np.pi * np.cumsum(full)
