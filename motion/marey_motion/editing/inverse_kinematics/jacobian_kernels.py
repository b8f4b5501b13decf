"""Derivatives of the errors of targets with respect to displacements of joints and of the root."""

from __future__ import annotations

import math

from marey_motion.editing.inverse_kinematics.pose_kernels import ORIENTATION, POSITION
from marey_motion.editing.inverse_kinematics.rotation_kernels import (
    TINY,
    cross,
    direction,
    dot,
    length,
    minus,
    plus,
    rotated,
    rotation_at,
    scaled,
    vector_at,
)
from marey_motion.kernels import compiled


@compiled
def _turned_error(kind, error, gaze, goal, turn, drift):
    """Compute the change of an angular error if the joint turns by `turn` and the target direction by `drift`.

    `turn` and `drift` are small rotation vectors; `gaze` and `goal` are the unit directions of the look-at axis and
    of its target.
    """
    if kind == ORIENTATION:
        # The inverse left Jacobian of the rotation group at `error`.
        angle = length(error)
        half = 0.5 * angle
        share = (1.0 - half / math.tan(half)) / (angle * angle) if angle > 1e-4 else 1.0 / 12.0
        twice = cross(error, cross(error, turn))
        return plus(minus(turn, scaled(cross(error, turn), 0.5)), scaled(twice, share))
    return plus(cross(drift, error), _look_change(gaze, goal, minus(turn, drift)))


@compiled
def _look_change(gaze, goal, turn):
    """Compute the change of `look_error(gaze, goal)` if the gaze turns by the small rotation vector `turn`."""
    across = cross(goal, gaze)
    sine, cosine = length(across), dot(goal, gaze)
    if sine < 1e-9:
        return minus(turn, scaled(gaze, dot(gaze, turn)))
    axis = scaled(across, 1.0 / sine)
    moved = minus(scaled(turn, cosine), scaled(gaze, dot(goal, turn)))
    moved = minus(moved, scaled(axis, dot(axis, moved)))
    return plus(scaled(axis, dot(axis, turn)), scaled(moved, math.atan2(sine, cosine) / sine))


@compiled
def _fill_column(targets, frame, c, error, tip, turn, move, spin, jacobian, column):
    """Fill a column of the Jacobian: the derivatives of the error of target `c` with respect to one unknown.

    `tip` and `turn` are position and rotation of the target's point; `error` is the error of the target. A unit change
    of the unknown moves the point by `move` and turns it by `spin`.
    """
    if targets.kinds[c] == POSITION:
        axes = targets.axes
        change = (move[0] * axes[c, 0], move[1] * axes[c, 1], move[2] * axes[c, 2])
    elif targets.kinds[c] == ORIENTATION:
        change = _turned_error(ORIENTATION, error, error, error, spin, spin)
    else:
        way = minus(vector_at(targets.values[frame], c), tip)
        far = length(way)
        goal = direction(way)
        drift = scaled(cross(move, goal), 1.0 / max(far, TINY))  # the eye moves, the point does not
        gaze = rotated(turn, vector_at(targets.directions, c))
        change = _turned_error(targets.kinds[c], error, gaze, goal, spin, drift)
    for i in range(3):
        jacobian[3 * c + i, column] = targets.scales[c] * change[i]


@compiled
def fill_jacobian(body, targets, frame, work, jacobian):
    """Fill `jacobian` (3·C, 3·V + 3): the derivatives of the scaled errors of C targets.

    The unknowns are the displacements of the V movable joints and of the root.
    """
    jacobian[:] = 0.0
    columns = 0
    for k in range(body.parents.shape[0]):
        if not body.movable[k]:
            continue
        place, spin = vector_at(work.places, k), rotation_at(work.spins, k)
        for axis in range(3):
            own = (1.0 if axis == 0 else 0.0, 1.0 if axis == 1 else 0.0, 1.0 if axis == 2 else 0.0)
            turn = rotated(spin, own)
            for c in range(targets.kinds.shape[0]):
                if body.carries[k, c]:
                    tip = vector_at(work.tips, c)
                    move = cross(turn, minus(tip, place))
                    error, spun = vector_at(work.errors, c), rotation_at(work.turns, c)
                    _fill_column(targets, frame, c, error, tip, spun, move, turn, jacobian, columns)
            columns += 1
    if body.root_moves:
        for axis in range(3):
            move = (1.0 if axis == 0 else 0.0, 1.0 if axis == 1 else 0.0, 1.0 if axis == 2 else 0.0)
            for c in range(targets.kinds.shape[0]):
                error, spun = vector_at(work.errors, c), rotation_at(work.turns, c)
                tip, still = vector_at(work.tips, c), (0.0, 0.0, 0.0)
                _fill_column(targets, frame, c, error, tip, spun, move, still, jacobian, columns + axis)
