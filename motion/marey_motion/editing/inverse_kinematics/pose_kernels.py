"""Poses in inverse kinematics: positions of the relevant joints, errors of targets, and limits."""

from __future__ import annotations

import math

from marey_motion.editing.inverse_kinematics.rotation_kernels import (
    TINY,
    about,
    cross,
    direction,
    dot,
    exponential,
    length,
    logarithm,
    minus,
    perpendicular,
    plus,
    put_vector,
    rotated,
    rotation_at,
    scaled,
    twist_angle,
    unit,
    vector_at,
)
from marey_motion.kernels import compiled, inverse, product, put_rotation

# Kinds of targets.
POSITION, ORIENTATION, LOOK_AT = 0, 1, 2

# Columns of a joint's limits.
REFERENCE, TWIST_AXIS, SIDE_AXIS, TWIST_RANGE, SWING_RANGE, LIMIT_COLUMNS = 0, 4, 7, 10, 12, 14


@compiled
def place_joints(parents, offsets, root, local, spins, places):
    """Fill world rotations `spins` (K, 4) and positions `places` (K, 3) from local rotations (K, 4) and root (3,)."""
    put_rotation(spins, 0, rotation_at(local, 0))
    put_vector(places, 0, (root[0], root[1], root[2]))
    for k in range(1, parents.shape[0]):
        parent = parents[k]
        spin = rotation_at(spins, parent)
        put_rotation(spins, k, product(spin, rotation_at(local, k)))
        put_vector(places, k, plus(vector_at(places, parent), rotated(spin, vector_at(offsets, k))))


@compiled
def place_tips(targets, spins, places, tips, turns):
    """Fill `tips` (C, 3) and `turns` (C, 4) for a pose: for each target, its point's position and its joint's rotation.

    The point of a target is the one that the target constrains; it moves with the joint. `spins` (K, 4) and `places`
    (K, 3) are the rotations and positions of all joints in the pose. All four arrays are in world coordinates.
    """
    for c in range(targets.kinds.shape[0]):
        k = targets.joints[c]
        spin = rotation_at(spins, k)
        put_rotation(turns, c, spin)
        put_vector(tips, c, plus(vector_at(places, k), rotated(spin, vector_at(targets.offsets, c))))


@compiled
def look_error(gaze, goal):
    """Compute the rotation vector, in radians, from the unit direction `goal` to the unit direction `gaze`."""
    across = cross(goal, gaze)
    sine, cosine = length(across), dot(goal, gaze)
    if sine > TINY:
        return scaled(across, math.atan2(sine, cosine) / sine)
    return (0.0, 0.0, 0.0) if cosine > 0.0 else scaled(perpendicular(goal), math.pi)


@compiled
def target_error(targets, c, frame, tip, turn):
    """Compute the error of target `c` as three numbers along the axes of the world.

    The error of a position is `tip` minus the target, in metres, and 0 along the axes that the target leaves free. The
    error of an orientation is the rotation vector, in radians, from the target's rotation to `turn`. The error of a
    look-at target is the rotation vector, in radians, from the direction towards the target to the direction that the
    look-at axis has after the rotation `turn`.
    """
    values = targets.values[frame]
    if targets.kinds[c] == POSITION:
        off = minus(tip, vector_at(values, c))
        axes = targets.axes
        return off[0] * axes[c, 0], off[1] * axes[c, 1], off[2] * axes[c, 2]
    if targets.kinds[c] == ORIENTATION:
        return logarithm(product(turn, inverse(rotation_at(values, c))))
    gaze = rotated(turn, vector_at(targets.directions, c))
    return look_error(gaze, direction(minus(vector_at(values, c), tip)))


@compiled
def weigh_errors(targets, frame, tips, turns, errors, tolerance_m, tolerance_rad):
    """Fill `errors` (C, 3) with the error of each target in a pose.

    In the pose, the targets' points have the positions `tips` (C, 3), and their joints the rotations `turns` (C, 4).
    Returns the weighted sum of the squared errors, and whether all errors are within the tolerances.
    """
    cost, reached = 0.0, True
    for c in range(targets.kinds.shape[0]):
        error = target_error(targets, c, frame, vector_at(tips, c), rotation_at(turns, c))
        put_vector(errors, c, error)
        square = dot(error, error)
        cost += targets.scales[c] ** 2 * square
        tolerance = tolerance_m if targets.kinds[c] == POSITION else tolerance_rad
        reached = reached and square <= tolerance * tolerance
    return cost, reached


@compiled
def measure(body, targets, frame, offsets, root, local, work, tolerance_m, tolerance_rad):
    """Fill positions, rotations and errors in `work` for the pose `local` (K, 4) and `root` (3,).

    `frame` selects the values of the targets, and `offsets` (K, 3) are the offsets of the joints. Returns the weighted
    sum of the squared errors, and whether all targets are reached.
    """
    place_joints(body.parents, offsets, root, local, work.spins, work.places)
    place_tips(targets, work.spins, work.places, work.tips, work.turns)
    return weigh_errors(targets, frame, work.tips, work.turns, work.errors, tolerance_m, tolerance_rad)


@compiled
def store_residuals(errors, out):
    for c in range(errors.shape[0]):
        out[c] = length(vector_at(errors, c))


@compiled
def carry_change(body, given, solved, f, other, out):
    """Fill `out` (K, 4) with the given pose of frame `f`, changed as the frame `other` was changed.

    `given` and `solved` (F, K, 4) are the local rotations before and after; joints with limits stay within them.
    """
    for k in range(out.shape[0]):
        rotation = rotation_at(given[f], k)
        if body.movable[k]:
            change = product(inverse(rotation_at(given[other], k)), rotation_at(solved[other], k))
            rotation = unit(product(rotation, change))
            if body.limited[k]:
                rotation = within_limits(body.limits[k], rotation)
        put_rotation(out, k, rotation)


@compiled
def nearest_in_range(angle, low, high):
    """Find the angle (radians, on the circle) in [low, high] that is nearest to `angle`."""
    if low <= angle <= high:
        return angle
    above = (angle - high) % (2.0 * math.pi)
    below = (low - angle) % (2.0 * math.pi)
    return high if above < below else low


@compiled
def within_limits(row, q):
    """Return the local rotation `q` of a joint, changed so that it is within the joint's limits.

    `row` (14,) is the joint's row of `JointChains.limits`.
    """
    reference = (row[0], row[1], row[2], row[3])
    axis, side = (row[4], row[5], row[6]), (row[7], row[8], row[9])
    turn = product(inverse(reference), q)
    twist = twist_angle(turn, axis)
    swing = logarithm(product(turn, about(axis, -twist)))
    forward = cross(axis, side)
    across, along = dot(swing, side), dot(swing, forward)
    across, along = _within_ellipse(across, along, row[SWING_RANGE], row[SWING_RANGE + 1])
    kept = nearest_in_range(twist, row[TWIST_RANGE], row[TWIST_RANGE + 1])
    swing = plus(scaled(side, across), scaled(forward, along))
    return unit(product(reference, product(exponential(swing), about(axis, kept))))


@compiled
def _within_ellipse(x, y, width, height):
    """Move the point (x, y) towards 0 until the point is inside the ellipse with the half axes `width` and `height`."""
    if width <= 0.0:
        x = 0.0
    if height <= 0.0:
        y = 0.0
    size = math.sqrt((x / width if width > 0.0 else 0.0) ** 2 + (y / height if height > 0.0 else 0.0) ** 2)
    return (x / size, y / size) if size > 1.0 else (x, y)


@compiled
def measure_frames(body, targets, tolerances, roots, rotations, work, residuals, reached):
    """Fill `residuals` (F, C), the errors of the targets, and `reached` (F,), whether a frame reaches all targets.

    `tolerances` are the tolerance in metres and the tolerance in radians.
    """
    tolerance_m, tolerance_rad = tolerances
    for f in range(rotations.shape[0]):
        frame = min(f, targets.values.shape[0] - 1)
        offsets = body.offsets[min(f, body.offsets.shape[0] - 1)]
        _, reached[f] = measure(body, targets, frame, offsets, roots[f], rotations[f], work, tolerance_m, tolerance_rad)
        store_residuals(work.errors, residuals[f])
