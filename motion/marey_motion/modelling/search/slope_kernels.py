"""Compiled derivatives of the constraints' points and times with respect to the latent vectors of one or more steps.

A step's own latent vector moves its joints through spline, quaternion normalisation and forward kinematics; the latent
vectors of earlier steps move the step's placement, which is its position and heading at its start in the world. `moved`
(3, W) is the derivative of the placement (heading, x, z) with respect to all W numbers of the stacked latent vectors,
in which the numbers of the step itself begin at `first`.
"""

from __future__ import annotations

import math

import numpy as np

from marey_motion.kernels import compiled, rotate_vector
from marey_motion.modelling.search.objective_kernels import (
    DIRECTION,
    HEADING,
    ORIENTATION,
    POINT,
    POSITION,
    TIME,
    _aims,
    _angle_factors,
    _crossed,
    _items,
    _pose,
    _residual,
    _times,
)

# Below it the limit is nearer than the quotient of small differences.
_SMALL_ANGLE = 1e-3


@compiled
def _joint_slopes(chains, local, rotations, shifts, spins):
    """Fill `shifts` and `spins` (V, 3, k) with the derivatives of V joints' positions and rotations.

    They are derivatives with respect to the k spatial scores, in canonical coordinates. `objective_kernels._pose`
    computes `local` and `rotations`.
    """
    for node in range(chains.parents.shape[0]):
        first, parent = chains.columns[node], chains.parents[node]
        w, x, y, z, length = local[node]
        arm = np.zeros(3)
        if parent >= 0:
            offset = chains.offsets[node]
            arm[0], arm[1], arm[2] = rotate_vector(rotations[parent], offset[0], offset[1], offset[2])
        for score in range(chains.directions.shape[0]):
            a, b, c, d = chains.directions[score, first : first + 4]
            # Twice the vector part of dq · conj(q): what of dq changes the length alone falls out.
            turn_x = 2.0 * (w * b - a * x - c * z + d * y) / length
            turn_y = 2.0 * (w * c - a * y - d * x + b * z) / length
            turn_z = 2.0 * (w * d - a * z - b * y + c * x) / length
            if parent < 0:
                spins[node, 0, score], spins[node, 1, score], spins[node, 2, score] = turn_x, turn_y, turn_z
                for axis in range(3):
                    shifts[node, axis, score] = chains.directions[score, first - 3 + axis]
            else:
                turn_x, turn_y, turn_z = rotate_vector(rotations[parent], turn_x, turn_y, turn_z)
                px, py, pz = spins[parent, 0, score], spins[parent, 1, score], spins[parent, 2, score]
                spins[node, 0, score] = px + turn_x
                spins[node, 1, score] = py + turn_y
                spins[node, 2, score] = pz + turn_z
                shifts[node, 0, score] = shifts[parent, 0, score] + py * arm[2] - pz * arm[1]
                shifts[node, 1, score] = shifts[parent, 1, score] + pz * arm[0] - px * arm[2]
                shifts[node, 2, score] = shifts[parent, 2, score] + px * arm[1] - py * arm[0]


@compiled
def track(chains, placement, moved, latent, first, points, turns, point_slopes, turn_slopes):
    """Fill `points` (n, 3) and `turns` (n, 4) with the tracked points and rotations of one step, in the world.

    Fills `point_slopes` and `turn_slopes` (n, 3, W) with the derivatives of the points and of the rotations with
    respect to `latent` (W,), the stacked latent vectors of all steps. `placement`, `moved` and `first` belong to the
    same step as `chains`; the introduction of this module describes them.
    """
    nodes, scores = chains.parents.shape[0], chains.directions.shape[0]
    channels, local = np.empty(chains.mean.shape[0]), np.empty((nodes, 5))
    positions, rotations = np.empty((nodes, 3)), np.empty((nodes, 4))
    shifts, spins = np.empty((nodes, 3, scores)), np.empty((nodes, 3, scores))
    own = latent[first:]
    _pose(chains, own, channels, local, positions, rotations)
    _items(chains, placement, positions, rotations, points, turns)
    _joint_slopes(chains, local, rotations, shifts, spins)
    cos, sin = math.cos(placement[0]), math.sin(placement[0])
    for item in range(points.shape[0]):
        held = chains.held[item]
        x, z = points[item, 0] - held * placement[1], points[item, 2] - held * placement[2]
        for column in range(moved.shape[1]):
            point_slopes[item, 0, column] = moved[0, column] * z + held * moved[1, column]
            point_slopes[item, 1, column] = 0.0
            point_slopes[item, 2, column] = -moved[0, column] * x + held * moved[2, column]
            turn_slopes[item, 0, column] = 0.0
            turn_slopes[item, 1, column] = moved[0, column]
            turn_slopes[item, 2, column] = 0.0
        for term in range(chains.term_starts[item], chains.term_starts[item + 1]):
            _add_turned(cos, sin, chains.term_signs[term], shifts[chains.term_nodes[term]], first, point_slopes[item])
        _add_turned(cos, sin, 1.0, spins[chains.turned[item]], first, turn_slopes[item])


@compiled
def _add_turned(cos, sin, sign, slopes, first, out):
    """Convert derivatives `slopes` (3, k) from canonical to world coordinates, and add them to `out` (3, W).

    `cos` and `sin` are the cosine and sine of the placement's heading; `sign` is a factor, 1 or -1. The columns of the
    k scores begin at `first`.
    """
    for score in range(slopes.shape[1]):
        x, z = slopes[0, score], slopes[2, score]
        out[0, first + score] += sign * (cos * x + sin * z)
        out[1, first + score] += sign * slopes[1, score]
        out[2, first + score] += sign * (cos * z - sin * x)


@compiled
def keep_time(clocks, latent, first, times, slopes):
    """Fill `times` (n,) with the times of canonical frames, in seconds, and `slopes` (n, W) with their derivatives.

    The temporal scores of the step begin at index `first` of the stacked latent vectors `latent` (W,).
    """
    steps = np.empty(clocks.mean.shape[0])
    factor, lasting = _times(clocks, latent, first, steps, times)
    least, most = math.exp(clocks.log_slope_bounds[0]), math.exp(clocks.log_slope_bounds[1])
    for step in range(steps.shape[0]):
        if not least < steps[step] < most:  # cut off: it stays as long, whatever the numbers are
            steps[step] = 0.0
    slopes[:] = 0.0
    for number in range(clocks.directions.shape[0]):
        longer = 0.0
        for step in range(steps.shape[0]):
            longer += clocks.frame_s * steps[step] * clocks.directions[number, step]
        for clock in range(times.shape[0]):
            total = 0.0
            for step in range(steps.shape[0]):
                total += clocks.weights[clock, step] * steps[step] * clocks.directions[number, step]
            if factor == 1.0:
                slopes[clock, first + number] = total
            else:  # the whole lasts as long as it may, whatever its steps
                slopes[clock, first + number] = factor * total - times[clock] * longer / lasting


@compiled
def _hat(v, out):
    """Fill `out` with the matrix whose product with any vector u is the cross product v × u."""
    out[0, 0], out[0, 1], out[0, 2] = 0.0, -v[2], v[1]
    out[1, 0], out[1, 1], out[1, 2] = v[2], 0.0, -v[0]
    out[2, 0], out[2, 1], out[2, 2] = -v[1], v[0], 0.0


@compiled
def _multiply(a, b):
    out = np.zeros((3, 3))
    for i in range(3):
        for j in range(3):
            for k in range(3):
                out[i, j] += a[i, k] * b[k, j]
    return out


@compiled
def _orientation_slope(residual, by_turn):
    """Fill `by_turn` (3, 3) with the inverse left Jacobian of the rotation vector `residual`.

    This is the derivative of the vector with respect to the rotation; it is finite up to half a turn.
    """
    angle = math.sqrt(residual[0] ** 2 + residual[1] ** 2 + residual[2] ** 2)
    factor = 1.0 / 12.0
    if angle > _SMALL_ANGLE:
        factor = (1.0 - 0.5 * angle / math.tan(0.5 * angle)) / (angle * angle)
    hat = np.empty((3, 3))
    _hat(residual, hat)
    square = _multiply(hat, hat)
    for i in range(3):
        for j in range(3):
            by_turn[i, j] = (1.0 if i == j else 0.0) - 0.5 * hat[i, j] + factor * square[i, j]


@compiled
def _aim_slopes(pointing, wanted, distance, by_point, by_turn):
    """Fill `by_point` and `by_turn` (3, 3) with the derivatives of the error of a joint's axis.

    The error is the rotation vector angle / sin(angle) · (pointing × wanted). `pointing` and `wanted` are the unit
    directions of the axis and of the target. `by_turn` and `by_point` (3, 3) are the derivatives with respect to the
    joint's rotation and position. `distance` is the distance of the point to look at, or 0 for a constraint without
    such a point.
    """
    across = np.empty(3)
    sine = _crossed(pointing, wanted, across)
    cosine = pointing[0] * wanted[0] + pointing[1] * wanted[1] + pointing[2] * wanted[2]
    factor, bend = _angle_factors(sine, cosine)
    aims, goals = np.empty((3, 3)), np.empty((3, 3))
    _hat(pointing, aims)
    _hat(wanted, goals)
    turned = _multiply(goals, aims)
    by_aim = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            by_turn[i, j] = factor * turned[i, j] + bend * across[i] * across[j]
            by_aim[i, j] = factor * aims[i, j] + bend * across[i] * pointing[j]
    if distance > 0.0:
        for i in range(3):
            along = by_aim[i, 0] * wanted[0] + by_aim[i, 1] * wanted[1] + by_aim[i, 2] * wanted[2]
            for j in range(3):
                by_point[i, j] = (along * wanted[j] - by_aim[i, j]) / distance


@compiled
def _slopes_of(row, rows, points, turns, residual, by_point, by_turn):
    """Fill `by_point` and `by_turn` (3, 3) with derivatives of the error `residual` of the constraint with index `row`.

    They are derivatives with respect to the tracked point and the tracked rotation of the constraint.
    """
    kind, item = rows.kinds[row], rows.items[row]
    by_point[:], by_turn[:] = 0.0, 0.0
    if kind == POSITION:
        for axis in range(3):
            by_point[axis, axis] = rows.axes[row, axis]
    elif kind == ORIENTATION:
        _orientation_slope(residual, by_turn)
    elif kind == HEADING:
        x, z = points[item, 0], points[item, 2]
        square = x * x + z * z
        by_point[0, 0], by_point[0, 2] = z / square, -x / square
    elif kind in (DIRECTION, POINT):
        pointing, wanted = np.empty(3), np.empty(3)
        distance = _aims(kind, row, rows, points, turns, pointing, wanted)
        _aim_slopes(pointing, wanted, distance if kind == POINT else 0.0, by_point, by_turn)


@compiled
def linearise(rows, points, turns, times, point_slopes, turn_slopes, time_slopes, residuals, slopes):
    """Fill `residuals` (m, 3) with the errors of m constraints, and `slopes` (m, 3, W) with their derivatives.

    The derivatives are with respect to the W unknowns of the search. `rows` describes the constraints; the other arrays
    are values and derivatives of the tracked points, rotations and times.
    """
    room, by_point, by_turn = np.empty((2, 3)), np.empty((3, 3)), np.empty((3, 3))
    for row in range(rows.kinds.shape[0]):
        item = rows.items[row]
        _residual(row, rows, points, turns, times, room, residuals[row])
        slopes[row] = 0.0
        if rows.kinds[row] == TIME:
            slopes[row, 0] = time_slopes[item]
            continue
        _slopes_of(row, rows, points, turns, residuals[row], by_point, by_turn)
        for i in range(3):
            for column in range(slopes.shape[2]):
                total = 0.0
                for j in range(3):
                    total += by_point[i, j] * point_slopes[item, j, column]
                    total += by_turn[i, j] * turn_slopes[item, j, column]
                slopes[row, i, column] = total
