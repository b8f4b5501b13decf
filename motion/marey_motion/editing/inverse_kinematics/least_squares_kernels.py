"""Damped least squares: all targets are solved at once, and joints are displaced as little as the targets allow.

The unknowns are displacements of the local rotations, as rotation vectors in each joint's own frame, and of the root.
There are many more unknowns than targets, so the damped normal equations are solved in the space of the targets (the
Woodbury identity): with a diagonal D, (JᵀJ + D)⁻¹ = D⁻¹ - D⁻¹Jᵀ(1 + J·D⁻¹·Jᵀ)⁻¹J·D⁻¹.
"""

from __future__ import annotations

import math

from marey_motion.editing.inverse_kinematics.jacobian_kernels import fill_jacobian
from marey_motion.editing.inverse_kinematics.pose_kernels import (
    carry_change,
    measure,
    store_residuals,
    within_limits,
)
from marey_motion.editing.inverse_kinematics.rotation_kernels import (
    TINY,
    cross,
    direction,
    dot,
    exponential,
    length,
    logarithm,
    put_vector,
    rotation_at,
    unit,
    vector_at,
)
from marey_motion.kernels import compiled, inverse, product, put_rotation

LONGEST_STEP_RAD = 1.0
FIRST_DAMPING, LEAST_DAMPING, MOST_DAMPING = 1e-2, 1e-12, 1e8
DAMPING_DECREASE, DAMPING_INCREASE = 0.02, 8.0
# An accepted step that improves the objective by less than this share is the last one: while targets are missed, and
# once they are reached and only the displacement still shrinks.
CONVERGED_SHARE, REACHED_SHARE = 1e-13, 1e-3
# Passes in which joints at a limit are found, for each step.
LIMIT_PASSES = 6
LIMIT_REACHED_RAD = 1e-9


@compiled
def _displace(body, local, root, first_local, first_root, work):
    """Fill `work.displacement` (3·V + 3,), and return the weighted sum of the squared displacements.

    The displacements are those of the V movable joints and of the root, from the initial pose (`first_local`,
    `first_root`) to the pose (`local`, `root`).
    """
    columns, cost = 0, 0.0
    for k in range(local.shape[0]):
        if body.movable[k]:
            moved = logarithm(product(inverse(rotation_at(first_local, k)), rotation_at(local, k)))
            for axis in range(3):
                work.displacement[columns] = moved[axis]
                cost += work.displacement_weights[columns] * moved[axis] ** 2
                columns += 1
    for axis in range(3):
        work.displacement[columns] = root[axis] - first_root[axis]
        cost += work.displacement_weights[columns] * work.displacement[columns] ** 2
        columns += 1
    return cost


@compiled
def _fill_inverse_diagonal(body, damping, work):
    """Fill `work.inverse_diagonal` (3·V + 3,), the diagonal of D⁻¹.

    The diagonal matrix D is the sum of the damping and the weights of the displacements.
    """
    columns = 0
    for k in range(body.parents.shape[0]):
        if body.movable[k]:
            flexible = (1.0 - body.stiffness[k]) ** 2
            for _ in range(3):
                work.inverse_diagonal[columns] = 1.0 / (work.displacement_weights[columns] + damping / flexible)
                columns += 1
    for _ in range(3):
        work.inverse_diagonal[columns] = (
            1.0 / (work.displacement_weights[columns] + damping) if body.root_moves else 0.0
        )
        columns += 1


@compiled
def _apply_inverse(work, vector, out):
    """Fill `out` with D⁻¹·vector; the components along directions that `_block` has excluded are removed.

    `work.inverse_diagonal` is the diagonal of D⁻¹ (see `_fill_inverse_diagonal`).
    """
    for v in range(work.blocked.shape[0]):
        known, along = work.blocked[v], 0.0
        for i in range(3):
            along += work.outward[v, i] * vector[3 * v + i]
        for i in range(3):
            kept = vector[3 * v + i] if known < 2 else 0.0
            if known == 1:
                kept -= along * work.outward[v, i]
            elif known == 2:
                kept = along * work.outward[v, i]
            out[3 * v + i] = work.inverse_diagonal[3 * v + i] * kept
    first = 3 * work.blocked.shape[0]
    for i in range(first, first + 3):
        out[i] = work.inverse_diagonal[i] * vector[i]


@compiled
def _solve_positive(matrix, right):
    """Solve matrix·x = right for a positive definite matrix (m, m), and write x into `right` (m,).

    The lower triangle of `matrix` is overwritten by its Cholesky factor.
    """
    m = right.shape[0]
    for i in range(m):
        for j in range(i + 1):
            total = matrix[i, j]
            for k in range(j):
                total -= matrix[i, k] * matrix[j, k]
            matrix[i, j] = math.sqrt(total) if i == j else total / matrix[j, j]
    for i in range(m):
        for k in range(i):
            right[i] -= matrix[i, k] * right[k]
        right[i] /= matrix[i, i]
    for i in range(m - 1, -1, -1):
        for k in range(i + 1, m):
            right[i] -= matrix[k, i] * right[k]
        right[i] /= matrix[i, i]


@compiled
def _fill_step(work):
    """Fill `work.step` with -(JᵀJ + D)⁻¹·gradient; J is the Jacobian, D as in `_fill_inverse_diagonal`."""
    rows, columns = work.jacobian.shape
    _apply_inverse(work, work.gradient, work.step)
    for i in range(rows):
        _apply_inverse(work, work.jacobian[i], work.scaled_rows[i])
    for i in range(rows):
        total = 0.0
        for n in range(columns):
            total += work.jacobian[i, n] * work.step[n]
        work.right[i] = total
        for j in range(i + 1):
            total = 1.0 if i == j else 0.0
            for n in range(columns):
                total += work.jacobian[i, n] * work.scaled_rows[j, n]
            work.matrix[i, j] = total
    _solve_positive(work.matrix, work.right)
    for n in range(columns):
        total = work.step[n]
        for i in range(rows):
            total -= work.scaled_rows[i, n] * work.right[i]
        work.step[n] = -total


@compiled
def _block(work, v, over):
    """Exclude the direction `over` from further steps of the movable joint `v`.

    `work.blocked` counts the excluded directions of each joint. `work.outward` contains the excluded direction if
    there is one, and the only direction that remains free if there are two. Returns False, without a change, if all
    three directions were excluded before the call.
    """
    known = work.blocked[v]
    if known == 1:
        over = direction(cross(vector_at(work.outward, v), over))
    if known < 3:
        put_vector(work.outward, v, over)
        work.blocked[v] = known + 1
    return known < 3


@compiled
def _take_step(body, local, root, work):
    """Fill the trial pose `work.trial` and `work.trial_root`: `local` (K, 4) and `root` (3,) moved by `work.step`.

    Joints stay within their limits. Returns whether a limit excluded a further direction for any joint (see `_block`).
    """
    longest = 0.0
    for n in range(3 * work.blocked.shape[0]):
        longest = max(longest, abs(work.step[n]))
    share = min(1.0, LONGEST_STEP_RAD / longest) if longest > 0.0 else 1.0
    v, newly_blocked = 0, False
    for k in range(local.shape[0]):
        if not body.movable[k]:
            put_rotation(work.trial, k, rotation_at(local, k))
            continue
        step = (share * work.step[3 * v], share * work.step[3 * v + 1], share * work.step[3 * v + 2])
        new = unit(product(rotation_at(local, k), exponential(step)))
        if body.limited[k]:
            kept = within_limits(body.limits[k], new)
            over = logarithm(product(inverse(kept), new))
            gone = logarithm(product(inverse(rotation_at(local, k)), kept))
            # A joint that has not reached its limit moves up to it; a joint at its limit is blocked.
            if length(over) > LIMIT_REACHED_RAD and dot(gone, direction(over)) < LIMIT_REACHED_RAD:
                newly_blocked = _block(work, v, direction(over)) or newly_blocked
            new = kept
        put_rotation(work.trial, k, new)
        v += 1
    first = 3 * work.blocked.shape[0]
    for i in range(3):
        work.trial_root[i] = root[i] + share * work.step[first + i]
    return newly_blocked


@compiled
def _fill_gradient(work):
    for n in range(work.gradient.shape[0]):
        total = work.displacement_weights[n] * work.displacement[n]
        for c in range(work.errors.shape[0]):
            for i in range(3):
                total += work.jacobian[3 * c + i, n] * work.scaled_errors[3 * c + i]
        work.gradient[n] = total


@compiled
def _prepare(body, targets, frame, work):
    """Fill `work.jacobian` and `work.gradient` for the pose that was measured last.

    Returns the mean squared length of the rows of the Jacobian.
    """
    fill_jacobian(body, targets, frame, work, work.jacobian)
    for c in range(targets.kinds.shape[0]):
        for i in range(3):
            work.scaled_errors[3 * c + i] = targets.scales[c] * work.errors[c, i]
    _fill_gradient(work)
    size = 0.0
    for i in range(work.jacobian.shape[0]):
        for n in range(work.jacobian.shape[1]):
            size += work.jacobian[i, n] ** 2
    return size / work.jacobian.shape[0]


@compiled
def _try_step(body, damping, local, root, work):
    """Compute the pose after one damped step from the pose `local` and `root`.

    The new pose is `work.trial` and `work.trial_root`. Joints at a limit move only along this limit.
    """
    _fill_inverse_diagonal(body, damping, work)
    work.blocked[:] = 0
    for _ in range(LIMIT_PASSES):
        _fill_step(work)
        if not _take_step(body, local, root, work):
            break


@compiled
def _solve_frame(body, targets, frame, offsets, ends, carried, local, root, work, before, after):
    """Solve one frame: change the pose `local` (K, 4) and `root` (3,) in place.

    `before` and `after` (C,) are filled with the errors of the targets; `ends` are the stopping criteria (see
    `solve_frames`). If `carried`, the solver starts with the pose `work.trial` and `work.trial_root`, and changes it as
    little as possible. Returns the number of steps tried, and whether all targets are reached.
    """
    most_steps, tolerance_m, tolerance_rad = ends
    work.first[:] = local
    work.first_root[:] = root
    cost, reached = measure(body, targets, frame, offsets, root, local, work, tolerance_m, tolerance_rad)
    store_residuals(work.errors, before)
    changed = carried
    if carried:
        local[:] = work.trial
        root[:] = work.trial_root
        work.first_root[:] = root
    for k in range(local.shape[0]):
        if body.limited[k] and body.movable[k]:
            put_rotation(local, k, within_limits(body.limits[k], rotation_at(local, k)))
            changed = True
    if changed:
        work.first[:] = local
        cost, reached = measure(body, targets, frame, offsets, root, local, work, tolerance_m, tolerance_rad)
    store_residuals(work.errors, after)
    work.displacement[:] = 0.0
    steps = 0
    if reached:
        return steps, reached
    damping = FIRST_DAMPING * max(_prepare(body, targets, frame, work), TINY)
    while steps < most_steps:
        _try_step(body, damping, local, root, work)
        steps += 1
        trial, arrived = measure(
            body, targets, frame, offsets, work.trial_root, work.trial, work, tolerance_m, tolerance_rad
        )
        trial += _displace(body, work.trial, work.trial_root, work.first, work.first_root, work)
        if not trial < cost:
            damping *= DAMPING_INCREASE
            # Restores the displacements of the pose before the step; its Jacobian and gradient are unchanged.
            _displace(body, local, root, work.first, work.first_root, work)
            if damping > MOST_DAMPING:
                break
            continue
        local[:] = work.trial
        root[:] = work.trial_root
        store_residuals(work.errors, after)
        gained = cost - trial
        cost, reached = trial, arrived
        if gained < (REACHED_SHARE if reached else CONVERGED_SHARE) * trial:
            break
        damping = max(DAMPING_DECREASE * damping, LEAST_DAMPING)
        _prepare(body, targets, frame, work)
    return steps, reached


@compiled
def solve_frames(body, targets, ends, given_rotations, given_roots, order, carried, roots, rotations, work, found):
    """Solve the frames `order` (n,) in this order; change `roots` (F, 3) and `rotations` (F, K, 4) in place.

    `given_rotations` and `given_roots` are the poses of all frames before they were solved. The solver starts from the
    given pose of frame `order[i]`. If `carried[i]` is at least 0, the change from the given to the solved pose of frame
    `carried[i]` is first applied to this pose. Also fills the `SolverResult` `found`. `ends` holds the three stopping
    criteria: the maximum number of steps, and the tolerances in metres and in radians.
    """
    for n in range(order.shape[0]):
        f, other = order[n], carried[n]
        frame = min(f, targets.values.shape[0] - 1)
        offsets = body.offsets[min(f, body.offsets.shape[0] - 1)]
        if other >= 0:
            carry_change(body, given_rotations, rotations, f, other, work.trial)
            for i in range(3):
                work.trial_root[i] = given_roots[f, i] + roots[other, i] - given_roots[other, i]
        rotations[f] = given_rotations[f]
        roots[f] = given_roots[f]
        steps, reached = _solve_frame(
            body, targets, frame, offsets, ends, other >= 0, rotations[f], roots[f], work, found.before[f],
            found.after[f],
        )  # fmt: skip
        found.iterations[f] = steps
        found.reached[f] = reached


@compiled
def residuals_and_jacobian(body, targets, roots, rotations, work):
    """Fill `work.scaled_errors` and `work.jacobian` for the first frame of the poses `roots` and `rotations`."""
    measure(body, targets, 0, body.offsets[0], roots[0], rotations[0], work, 0.0, 0.0)
    work.displacement[:] = 0.0
    _prepare(body, targets, 0, work)
