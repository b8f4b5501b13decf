"""Cyclic coordinate descent: each joint in turn gets the rotation that is best for all targets below that joint."""

from __future__ import annotations

import math

import numpy as np

from marey_motion.editing.inverse_kinematics.pose_kernels import (
    ORIENTATION,
    POSITION,
    SWING_RANGE,
    TWIST_RANGE,
    carry_change,
    measure,
    store_residuals,
    within_limits,
)
from marey_motion.editing.inverse_kinematics.rotation_kernels import (
    about,
    between,
    direction,
    exponential,
    logarithm,
    minus,
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

# The solver ends after this number of successive sweeps that each improve the objective by less than this share.
STALLED_SHARE = 1e-4
STALLED_SWEEPS = 4
# Weight of no rotation, relative to the targets, so that the smallest of equally good rotations is chosen.
STAYING = 1e-9


@compiled
def _pair_up(targets, frame, k, body, place, tips, turns, matrix):
    """Fill `matrix` (3, 3) with the sum Σ w·b·aᵀ over the pairs of vectors (a, b) that the targets define for joint k.

    Joint k rotates the vector a, and the target is reached when a coincides with b. The weight w is the squared scale
    of the target's error, or half of that square for orientations. `place` is the position of joint k; `tips` and
    `turns` are positions and rotations of the targets' points. Returns the number of pairs, and the unit vectors along
    a and b of the last pair of a position or look-at target.
    """
    matrix[:] = 0.0
    pairs = 0
    start, end = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    values = targets.values[frame]
    for c in range(targets.kinds.shape[0]):
        if not body.carries[k, c]:
            continue
        weight = targets.scales[c] ** 2
        tip, turn = vector_at(tips, c), rotation_at(turns, c)
        if targets.kinds[c] == ORIENTATION:
            rest = product(rotation_at(values, c), inverse(turn))
            for axis in range(3):
                a = (1.0 if axis == 0 else 0.0, 1.0 if axis == 1 else 0.0, 1.0 if axis == 2 else 0.0)
                _add_pair(matrix, 0.5 * weight, a, rotated(rest, a))
            pairs += 3
            continue
        if targets.kinds[c] == POSITION:
            goal = vector_at(values, c)
            axes = targets.axes
            goal = (
                goal[0] if axes[c, 0] > 0.0 else tip[0],
                goal[1] if axes[c, 1] > 0.0 else tip[1],
                goal[2] if axes[c, 2] > 0.0 else tip[2],
            )
            a, b = minus(tip, place), minus(goal, place)
        else:
            a, b = rotated(turn, vector_at(targets.directions, c)), direction(minus(vector_at(values, c), tip))
        _add_pair(matrix, weight, a, b)
        start, end = direction(a), direction(b)
        pairs += 1
    return pairs, start, end


@compiled
def _add_pair(matrix, weight, a, b):
    for i in range(3):
        for j in range(3):
            matrix[i, j] += weight * b[i] * a[j]


@compiled
def _davenport(matrix, form):
    """Fill `form` with Davenport's matrix (4, 4) of the sum `matrix` from `_pair_up`.

    The eigenvector of the largest eigenvalue of `form` is the best rotation, as a quaternion (q-method).
    """
    trace = matrix[0, 0] + matrix[1, 1] + matrix[2, 2]
    form[0, 0] = trace
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        form[0, i + 1] = form[i + 1, 0] = matrix[k, j] - matrix[j, k]
        for j in range(3):
            form[i + 1, j + 1] = matrix[i, j] + matrix[j, i] - (trace if i == j else 0.0)


@compiled
def _form_value(form, q):
    value = 0.0
    for i in range(4):
        for j in range(4):
            value += q[i] * form[i, j] * q[j]
    return value


@compiled
def _largest_eigenvector(form, vectors):
    """Compute the unit eigenvector of the largest eigenvalue of `form` (4, 4) by Jacobi's method, in place."""
    vectors[:] = 0.0
    for i in range(4):
        vectors[i, i] = 1.0
    for _ in range(12):
        off = 0.0
        for p in range(3):
            for q in range(p + 1, 4):
                off += form[p, q] ** 2
        size = form[0, 0] ** 2 + form[1, 1] ** 2 + form[2, 2] ** 2 + form[3, 3] ** 2
        if off <= 1e-30 * size:
            break
        for p in range(3):
            for q in range(p + 1, 4):
                if form[p, q] != 0.0:
                    _annihilate(form, vectors, p, q)
    best = 0
    for i in range(1, 4):
        if form[i, i] > form[best, best]:
            best = i
    sign = -1.0 if vectors[0, best] < 0.0 else 1.0
    return unit((sign * vectors[0, best], sign * vectors[1, best], sign * vectors[2, best], sign * vectors[3, best]))


@compiled
def _annihilate(form, vectors, p, q):
    slope = (form[q, q] - form[p, p]) / (2.0 * form[p, q])
    tangent = (1.0 if slope >= 0.0 else -1.0) / (abs(slope) + math.sqrt(slope * slope + 1.0))
    cosine = 1.0 / math.sqrt(tangent * tangent + 1.0)
    sine = tangent * cosine
    for i in range(4):
        a, b = form[i, p], form[i, q]
        form[i, p], form[i, q] = cosine * a - sine * b, sine * a + cosine * b
    for i in range(4):
        a, b = form[p, i], form[q, i]
        form[p, i], form[q, i] = cosine * a - sine * b, sine * a + cosine * b
    for i in range(4):
        a, b = vectors[i, p], vectors[i, q]
        vectors[i, p], vectors[i, q] = cosine * a - sine * b, sine * a + cosine * b


@compiled
def _best_turn(pairs, start, end, matrix, form, vectors):
    """Compute the smallest world rotation that turns the vectors of `_pair_up` as close as possible to their targets.

    `pairs`, `start`, `end` and `matrix` are the results of `_pair_up`; `form` and `vectors` (4, 4) are overwritten.
    """
    if pairs == 1:
        return between(start, end)
    _davenport(matrix, form)
    size = 0.0
    for i in range(4):
        for j in range(4):
            size += abs(form[i, j])
    form[0, 0] += STAYING * size
    return _largest_eigenvector(form, vectors)


@compiled
def _hinge_turn(limit, spin, local, flexible, matrix):
    """Compute the local rotation of a hinge after turning it by a share `flexible` of the way to its best angle.

    `limit` is the joint's row of `JointChains.limits`, `spin` its rotation in the world, `local` its local rotation,
    and `matrix` the sum from `_pair_up`.
    """
    reference, axis = (limit[0], limit[1], limit[2], limit[3]), (limit[4], limit[5], limit[6])
    now = twist_angle(product(inverse(reference), local), axis)
    hinge = rotated(product(spin, inverse(local)), rotated(reference, axis))
    # tr(R·Bᵀ) of a turn R about the hinge by φ is constant + across·sin φ + along·cos φ.
    along = matrix[0, 0] + matrix[1, 1] + matrix[2, 2]
    for i in range(3):
        for j in range(3):
            along -= hinge[i] * matrix[i, j] * hinge[j]
    across = (
        hinge[0] * (matrix[2, 1] - matrix[1, 2])
        + hinge[1] * (matrix[0, 2] - matrix[2, 0])
        + hinge[2] * (matrix[1, 0] - matrix[0, 1])
    )
    low, high = limit[TWIST_RANGE], limit[TWIST_RANGE + 1]
    best = now + math.atan2(across, along)
    best -= 2.0 * math.pi * math.floor((best + math.pi) / (2.0 * math.pi))
    if best < low or best > high:
        at_low = along * math.cos(low - now) + across * math.sin(low - now)
        at_high = along * math.cos(high - now) + across * math.sin(high - now)
        best = low if at_low > at_high else high
    return unit(product(reference, about(axis, now + flexible * (best - now))))


@compiled
def _turned_joint(body, k, spin, local, pairs, start, end, work):
    """Compute the new local rotation of joint k from the rotation `spin` in the world and the local rotation `local`.

    `pairs`, `start` and `end` are the results of `_pair_up`.
    """
    limit = body.limits[k]
    flexible = 1.0 - body.stiffness[k]
    if body.limited[k] and limit[SWING_RANGE] <= 0.0 and limit[SWING_RANGE + 1] <= 0.0:
        return _hinge_turn(limit, spin, local, flexible, work.matrix)
    turn = _best_turn(pairs, start, end, work.matrix, work.form, work.vectors)
    if flexible < 1.0:
        turn = exponential(scaled(logarithm(turn), flexible))
    above = product(spin, inverse(local))
    goal = unit(product(inverse(above), product(turn, spin)))
    if not body.limited[k]:
        return goal
    goal = within_limits(limit, goal)
    _davenport(work.matrix, work.form)
    turn = product(product(above, goal), inverse(spin))
    worse = _form_value(work.form, turn) < work.form[0, 0]
    return local if worse else goal


@compiled
def _sweep(body, targets, frame, local, work):
    """Turn every movable joint of the pose `local` (K, 4) once, from the tips of the chains to their root."""
    for k in range(body.parents.shape[0] - 1, -1, -1):
        if not body.movable[k]:
            continue
        place = vector_at(work.places, k)
        pairs, start, end = _pair_up(targets, frame, k, body, place, work.tips, work.turns, work.matrix)
        if pairs == 0:
            continue
        spin, old = rotation_at(work.spins, k), rotation_at(local, k)
        new = _turned_joint(body, k, spin, old, pairs, start, end, work)
        put_rotation(local, k, new)
        spun = product(product(spin, inverse(old)), new)
        turn = product(spun, inverse(spin))
        for c in range(targets.kinds.shape[0]):
            if body.carries[k, c]:
                arm = minus(vector_at(work.tips, c), place)
                put_vector(work.tips, c, plus(place, rotated(turn, arm)))
                put_rotation(work.turns, c, unit(product(turn, rotation_at(work.turns, c))))


@compiled
def _descend_frame(body, targets, frame, offsets, ends, carried, local, root, best, work, before, after):
    """Solve one frame: change the pose `local` (K, 4) in place.

    `before` and `after` (C,) are filled with the errors of the targets; `ends` are the stopping criteria (see
    `descend`). If `carried`, the solver starts with the pose `best` (K, 4), which is overwritten. Returns the number of
    sweeps, and whether all targets are reached.
    """
    most_sweeps, tolerance_m, tolerance_rad = ends
    cost, reached = measure(body, targets, frame, offsets, root, local, work, tolerance_m, tolerance_rad)
    store_residuals(work.errors, before)
    changed = carried
    for k in range(local.shape[0]):
        if carried:
            put_rotation(local, k, rotation_at(best, k))
        elif body.limited[k] and body.movable[k]:
            put_rotation(local, k, within_limits(body.limits[k], rotation_at(local, k)))
            changed = True
    if changed:
        cost, reached = measure(body, targets, frame, offsets, root, local, work, tolerance_m, tolerance_rad)
    best[:] = local
    least, stalled, sweeps, arrived = cost, 0, 0, reached
    store_residuals(work.errors, after)
    while not reached and sweeps < most_sweeps and stalled < STALLED_SWEEPS:
        _sweep(body, targets, frame, local, work)
        cost, reached = measure(body, targets, frame, offsets, root, local, work, tolerance_m, tolerance_rad)
        sweeps += 1
        stalled = 0 if cost < (1.0 - STALLED_SHARE) * least else stalled + 1
        if cost < least:
            least, arrived = cost, reached
            best[:] = local
            store_residuals(work.errors, after)
    local[:] = best
    return sweeps, arrived


@compiled
def descend(body, targets, ends, given_rotations, given_roots, order, carried, roots, rotations, work, found):
    """Solve the frames `order` (n,) in this order; change `rotations` (F, K, 4) and fill the `SolverResult` `found`.

    `given_rotations` and `given_roots` are the poses of all frames before they were solved. The solver starts from the
    given pose of frame `order[i]`. If `carried[i]` is at least 0, the change from the given to the solved pose of frame
    `carried[i]` is first applied to this pose. `ends` holds the three stopping criteria: the maximum number of sweeps,
    and the tolerances in metres and in radians.
    """
    best = np.empty(rotations.shape[1:])
    for n in range(order.shape[0]):
        f, other = order[n], carried[n]
        frame = min(f, targets.values.shape[0] - 1)
        offsets = body.offsets[min(f, body.offsets.shape[0] - 1)]
        if other >= 0:
            carry_change(body, given_rotations, rotations, f, other, best)
        rotations[f] = given_rotations[f]
        roots[f] = given_roots[f]
        sweeps, reached = _descend_frame(
            body, targets, frame, offsets, ends, other >= 0, rotations[f], roots[f], best, work,
            found.before[f], found.after[f],
        )  # fmt: skip
        found.iterations[f] = sweeps
        found.reached[f] = reached
