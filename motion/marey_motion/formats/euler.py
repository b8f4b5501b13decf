"""Conversion between quaternions and the Euler angles of files; each joint has its own order of axes.

Angles are intrinsic: channels Z, X, Y mean R = Rz · Rx · Ry.
"""

from __future__ import annotations

import numpy as np

from marey_motion.kernels import compiled

NO_COLUMN = -1

# Minimax polynomials of sine and cosine on [-π/4, π/4], good to the last bit of a double.
_S1, _S2, _S3 = -1.66666666666666324348e-01, 8.33333333332248946124e-03, -1.98412698298579493134e-04
_S4, _S5, _S6 = 2.75573137070700676789e-06, -2.50507602534068634195e-08, 1.58969099521155010221e-10
_C1, _C2, _C3 = 4.16666666666666019037e-02, -1.38888888888741095749e-03, 2.48015872894767294178e-05
_C4, _C5, _C6 = -2.75573143513906633035e-07, 2.08757232129817482790e-09, -1.13596475577881948265e-11
_HALF_DEGREE = np.pi / 360.0
_EXACTLY_REDUCED_DEG = 1e9


@compiled
def _half_angle(angle_deg):
    """Compute cosine and sine of half an angle given in degrees.

    Angles are reduced exactly, in degrees, before the conversion to radians. The operations are the same on every
    machine, so a file gives the same bytes everywhere.
    """
    if abs(angle_deg) > _EXACTLY_REDUCED_DEG:
        angle_deg = np.fmod(angle_deg, 720.0)
    turns = np.rint(angle_deg / 180.0)
    quadrant = np.int64(turns) & 3
    y = (angle_deg - 180.0 * turns) * _HALF_DEGREE
    z = y * y
    sine = y + y * z * (_S1 + z * (_S2 + z * (_S3 + z * (_S4 + z * (_S5 + z * _S6)))))
    cosine = 1.0 - 0.5 * z + z * z * (_C1 + z * (_C2 + z * (_C3 + z * (_C4 + z * (_C5 + z * _C6)))))
    if quadrant == 0:
        return cosine, sine
    if quadrant == 1:
        return -sine, cosine
    if quadrant == 2:
        return -cosine, -sine
    return sine, -cosine


@compiled
def rotations_from_euler(values, columns, axes, rotations):
    """Fill local rotations from channel values; the signs of the quaternions do not jump between frames.

    Parameters
    ----------
    values : (F, C) float64    degrees in the rotation columns
    columns : (J, 3) int64    column of the first, second and third turn of each joint; `NO_COLUMN` if the joint has
        fewer turns
    axes : (J, 3) int64    axis of each turn: 0, 1, 2 for x, y, z
    rotations : (F, J, 4) float32    filled with unit quaternions (w, x, y, z)
    """
    for frame in range(values.shape[0]):
        for joint in range(columns.shape[0]):
            w, x, y, z = 1.0, 0.0, 0.0, 0.0
            for turn in range(3):
                column = columns[joint, turn]
                if column == NO_COLUMN:
                    break
                c, s = _half_angle(values[frame, column])
                axis = axes[joint, turn]
                if axis == 0:
                    w, x, y, z = w * c - x * s, x * c + w * s, y * c + z * s, z * c - y * s
                elif axis == 1:
                    w, x, y, z = w * c - y * s, x * c - z * s, y * c + w * s, z * c + x * s
                else:
                    w, x, y, z = w * c - z * s, x * c + y * s, y * c - x * s, z * c + w * s
            if frame == 0:
                flip = w < 0.0
            else:
                before = rotations[frame - 1, joint]
                flip = w * before[0] + x * before[1] + y * before[2] + z * before[3] < 0.0
            if flip:
                w, x, y, z = -w, -x, -y, -z
            rotations[frame, joint, 0] = w
            rotations[frame, joint, 1] = x
            rotations[frame, joint, 2] = y
            rotations[frame, joint, 3] = z


@compiled
def euler_from_rotations(rotations, axes, angles_deg):
    """Fill Euler angles from quaternions, through rotation matrices; the inverse of `rotations_from_euler`.

    Of the two solutions, the one nearer to the angles of the previous frame is used, and whole turns are added so that
    angles do not jump. In gimbal lock (middle angle ±90°), the third angle stays as in the previous frame, and the
    first angle is computed.

    Parameters
    ----------
    rotations : (F, J, 4) float    unit quaternions (w, x, y, z)
    axes : (J, 3) int64    three different axes in the order of the turns
    angles_deg : (F, J, 3) float64    filled, in the order of the turns
    """
    matrix = np.empty((3, 3))
    to_deg = 180.0 / np.pi
    for joint in range(axes.shape[0]):
        i, j, k = axes[joint, 0], axes[joint, 1], axes[joint, 2]
        parity = 1.0 if (j - i) % 3 == 1 else -1.0
        last0 = last1 = last2 = 0.0
        for frame in range(rotations.shape[0]):
            _fill_matrix(rotations[frame, joint], matrix)
            cosine = np.hypot(matrix[i, i], matrix[i, j])
            middle = np.arctan2(parity * matrix[i, k], cosine)
            if cosine > 1e-7:
                first = np.arctan2(-parity * matrix[j, k], matrix[k, k])
                third = np.arctan2(-parity * matrix[i, j], matrix[i, i])
            else:
                third = last2
                sine3, cosine3 = np.sin(third), np.cos(third)
                # Undo the third turn: what is left of column j belongs to the first turn alone.
                column_k = cosine3 * matrix[k, j] + parity * sine3 * matrix[k, i]
                column_j = cosine3 * matrix[j, j] + parity * sine3 * matrix[j, i]
                first = np.arctan2(parity * column_k, column_j)
            if frame > 0:
                first, middle, third = _nearest_solution(first, middle, third, last0, last1, last2)
            last0, last1, last2 = first, middle, third
            angles_deg[frame, joint, 0] = first * to_deg
            angles_deg[frame, joint, 1] = middle * to_deg
            angles_deg[frame, joint, 2] = third * to_deg


@compiled
def _fill_matrix(q, matrix):
    w, x, y, z = np.float64(q[0]), np.float64(q[1]), np.float64(q[2]), np.float64(q[3])
    scale = 2.0 / (w * w + x * x + y * y + z * z)
    matrix[0, 0] = 1.0 - scale * (y * y + z * z)
    matrix[0, 1] = scale * (x * y - w * z)
    matrix[0, 2] = scale * (x * z + w * y)
    matrix[1, 0] = scale * (x * y + w * z)
    matrix[1, 1] = 1.0 - scale * (x * x + z * z)
    matrix[1, 2] = scale * (y * z - w * x)
    matrix[2, 0] = scale * (x * z - w * y)
    matrix[2, 1] = scale * (y * z + w * x)
    matrix[2, 2] = 1.0 - scale * (x * x + y * y)


@compiled
def _nearest_solution(first, middle, third, last0, last1, last2):
    turn = 2.0 * np.pi
    a0 = first + turn * np.rint((last0 - first) / turn)
    a1 = middle + turn * np.rint((last1 - middle) / turn)
    a2 = third + turn * np.rint((last2 - third) / turn)
    b0, b1, b2 = first + np.pi, np.pi - middle, third + np.pi
    b0 += turn * np.rint((last0 - b0) / turn)
    b1 += turn * np.rint((last1 - b1) / turn)
    b2 += turn * np.rint((last2 - b2) / turn)
    cost_a = abs(a0 - last0) + abs(a1 - last1) + abs(a2 - last2)
    cost_b = abs(b0 - last0) + abs(b1 - last1) + abs(b2 - last2)
    if cost_b < cost_a:
        return b0, b1, b2
    return a0, a1, a2
