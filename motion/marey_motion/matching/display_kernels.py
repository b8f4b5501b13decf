"""Compiled inertialisation of poses, in a separate module so that importing other modules does not load numba.

A pose is a row of 3 + 4·J numbers: the position of joint 0 in metres and the rotations (w, x, y, z) of J joints, joint
0 in the frame of the simulation root, the others in the frames of their parents. Offsets and velocities of rotations
are rotation vectors; they are added to a rotation by multiplying from the left.
"""

from __future__ import annotations

import numpy as np

from marey_motion.kernels import compiled, product

# Smaller offsets (in metres or radians) and velocities (per second) cannot be represented in float32 poses.
FORGOTTEN = 1e-9
# Half of an angle, squared, below which the first terms of the series are exact to the last bit.
SMALL = 1e-4


@compiled
def _exponential(x, y, z):
    """Compute the rotation about the axis (x, y, z) by an angle equal to the vector's length, in radians."""
    square = 0.25 * (x * x + y * y + z * z)
    if square < SMALL:
        cosine = 1.0 - square * (1.0 / 2.0 - square * (1.0 / 24.0 - square / 720.0))
        scale = 0.5 - square * (1.0 / 12.0 - square * (1.0 / 240.0 - square / 10080.0))
    else:
        half = np.sqrt(square)
        cosine, scale = np.cos(half), 0.5 * np.sin(half) / half
    return cosine, scale * x, scale * y, scale * z


@compiled
def _turn_to(pose, column, w, x, y, z):
    """Compute the rotation vector, of at most half a turn, from a rotation of a pose to the rotation (w, x, y, z).

    The rotation of the pose begins at index `column` of `pose`.
    """
    bw, bx, by, bz = (
        np.float64(pose[column]),
        np.float64(pose[column + 1]),
        np.float64(pose[column + 2]),
        np.float64(pose[column + 3]),
    )
    w, x, y, z = product((w, x, y, z), (bw, -bx, -by, -bz))
    if w < 0.0:
        w, x, y, z = -w, -x, -y, -z
    sine = np.sqrt(x * x + y * y + z * z)
    scale = 2.0 * np.arctan2(sine, w) / sine if sine > 1e-12 else 2.0
    return scale * x, scale * y, scale * z


@compiled
def _add_velocity(poses, places, successors, joints, moved, row, rate, velocities):
    """Add `rate` times the difference between a row and the next row of its clip to `velocities` (1 + M + K, 3).

    At the end of a clip, the difference between the last two rows is used instead. `velocities` contains the velocity
    of the root's position, then of M translations, then of K rotations.
    """
    if successors[row] < 0:  # a clip's end goes on as it came
        if row == 0 or successors[row - 1] != row:
            return
        row -= 1
    following = successors[row]
    here, ahead = poses[row], poses[following]
    for c in range(3):
        velocities[0, c] += rate * (np.float64(ahead[c]) - np.float64(here[c]))
        for m in range(moved.shape[0]):
            step = np.float64(places[following, moved[m], c]) - np.float64(places[row, moved[m], c])
            velocities[1 + m, c] += rate * step
    for k in range(joints.shape[0]):
        j, o = 3 + 4 * joints[k], 1 + moved.shape[0] + k
        turn = _turn_to(here, j, ahead[j], ahead[j + 1], ahead[j + 2], ahead[j + 3])
        for c in range(3):
            velocities[o, c] += rate * turn[c]


@compiled
def _show(pose, place, joints, moved, offsets, shown, shown_places):
    """Fill `shown` (3 + 4·K) and `shown_places` (M, 3) with K joints of a row's pose and M of the row's translations.

    `pose` and `place` are the pose and all translations of the row. `offsets` (1 + M + K, 3) of the root's position, of
    the translations and of the rotations are added.
    """
    for c in range(3):
        shown[c] = pose[c] + offsets[0, c]
        for m in range(moved.shape[0]):
            shown_places[m, c] = place[moved[m], c] + offsets[1 + m, c]
    for k in range(joints.shape[0]):
        j, o, s = 3 + 4 * joints[k], 1 + moved.shape[0] + k, 3 + 4 * k
        turn = _exponential(offsets[o, 0], offsets[o, 1], offsets[o, 2])
        shown[s], shown[s + 1], shown[s + 2], shown[s + 3] = product(turn, pose[j : j + 4])


@compiled
def _show_row(pose, place, joints, moved, shown, shown_places):
    """Fill `shown` (3 + 4·K) with K joints of a row's pose, and `shown_places` (M, 3) with M of its translations.

    No offsets are added.
    """
    shown[:3] = pose[:3]
    for m in range(moved.shape[0]):
        shown_places[m] = place[moved[m]]
    for k in range(joints.shape[0]):
        shown[3 + 4 * k : 7 + 4 * k] = pose[3 + 4 * joints[k] : 7 + 4 * joints[k]]


@compiled
def _take_offsets(shown, shown_places, pose, place, joints, moved, offsets):
    """Fill `offsets` (1 + M + K, 3) with the difference of the displayed pose from the pose of a row.

    `shown` and `shown_places` are the displayed pose and translations; `pose` and `place` are the row's own.
    """
    for c in range(3):
        offsets[0, c] = shown[c] - pose[c]
        for m in range(moved.shape[0]):
            offsets[1 + m, c] = shown_places[m, c] - place[moved[m], c]
    for k in range(joints.shape[0]):
        o, s = 1 + moved.shape[0] + k, 3 + 4 * k
        turn = _turn_to(pose, 3 + 4 * joints[k], shown[s], shown[s + 1], shown[s + 2], shown[s + 3])
        offsets[o, 0], offsets[o, 1], offsets[o, 2] = turn


@compiled
def _decay(decay, offsets, velocities):
    """Advance all offsets and velocities by one tick, with the matrix `decay`; return whether any offset remains."""
    left = 0.0
    for k in range(offsets.shape[0]):
        for c in range(3):
            offset, velocity = offsets[k, c], velocities[k, c]
            offsets[k, c] = decay[0, 0] * offset + decay[0, 1] * velocity
            velocities[k, c] = decay[1, 0] * offset + decay[1, 1] * velocity
            left = max(left, abs(offsets[k, c]), abs(velocities[k, c]))
    return left > FORGOTTEN


@compiled
def inertialised(poses, places, successors, joints, moved, rows, cuts, decay, rate_hz, out, out_places):
    """Fill `out` (T, 3 + 4·K) and `out_places` (T, M, 3) with displayed poses of K joints and translations of M joints.

    When the display switches from one row of the database to another, an offset is added to the next poses, so that the
    displayed motion continues smoothly; the offset decays.

    Parameters
    ----------
    poses, places : (N, 3 + 4·J), (N, L, 3) poses and local translations of the N rows of the database
    successors : (N,) the row that follows each row in its clip, or -1
    joints, moved : (K,) indices of the wanted joints; (M,) indices of the wanted translations among the L translations
        of the database
    rows : (T,) the row that is displayed at each tick, that is, each frame of the display
    cuts : (T,) the row that a search chose at each tick instead of the displayed row (the successor of the chosen row
        is displayed next); -1 if the displayed clip continues
    decay : (2, 2) matrix that advances an offset and its velocity by one tick
    rate_hz : ticks per second
    """
    offsets = np.zeros((1 + moved.shape[0] + joints.shape[0], 3))
    velocities = np.zeros_like(offsets)
    blends = False
    for tick in range(rows.shape[0]):
        row, cut = rows[tick], cuts[tick]
        if blends:
            _show(poses[row], places[row], joints, moved, offsets, out[tick], out_places[tick])
        else:
            _show_row(poses[row], places[row], joints, moved, out[tick], out_places[tick])
        if cut >= 0:
            _take_offsets(out[tick], out_places[tick], poses[cut], places[cut], joints, moved, offsets)
            _add_velocity(poses, places, successors, joints, moved, row, rate_hz, velocities)
            _add_velocity(poses, places, successors, joints, moved, cut, -rate_hz, velocities)
            blends = True
        if blends:
            blends = _decay(decay, offsets, velocities)
