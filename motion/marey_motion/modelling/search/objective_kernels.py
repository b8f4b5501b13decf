"""Compiled evaluation of constraints, in a separate module so that importing other modules does not load numba.

`chains`, `clocks` and `rows` are a `tracking.Chains`, a `tracking.Clocks` and an `objective.Rows`. Latent vectors are
handled one by one, so that results do not depend on the number of vectors evaluated at once, or on threads. A placement
is (heading, x, z).

Derivatives of rotations are angular velocities in the world: turning by a small w takes q to (1, w / 2) q.
"""

from __future__ import annotations

import math

import numpy as np

from marey_motion.kernels import compiled, inverse, product, put_rotation, rotate_vector

POSITION, ORIENTATION, DIRECTION, POINT, HEADING, TIME = range(6)

# Sine of an angle below which its direction is rounding noise.
_TINY = 1e-9
# Angle below which series replace quotients of small numbers.
_SMALL = 1e-4


@compiled
def _pose(chains, latent, channels, local, positions, rotations):
    """Compute the poses of the V joints of `chains` for one latent vector, in canonical coordinates.

    Fills `channels` (X,) with the values of the channels for the scores in `latent`; `local` (V, 5) with the unit
    quaternion of each joint's local rotation, followed by the length of this quaternion before normalisation; and
    `positions` (V, 3) and `rotations` (V, 4) with the global position and rotation of each joint.
    """
    channels[:] = chains.mean
    for component in range(chains.directions.shape[0]):
        score = latent[component]
        for column in range(channels.shape[0]):
            channels[column] += score * chains.directions[component, column]
    for node in range(chains.parents.shape[0]):
        first, parent = chains.columns[node], chains.parents[node]
        w, x, y, z = channels[first], channels[first + 1], channels[first + 2], channels[first + 3]
        length = math.sqrt(w * w + x * x + y * y + z * z)
        local[node, 0], local[node, 1], local[node, 2] = w / length, x / length, y / length
        local[node, 3], local[node, 4] = z / length, length
        if parent < 0:
            rotations[node] = local[node, :4]
            positions[node] = channels[first - 3 : first]
        else:
            put_rotation(rotations, node, product(rotations[parent], local[node]))
            offset = chains.offsets[node]
            dx, dy, dz = rotate_vector(rotations[parent], offset[0], offset[1], offset[2])
            positions[node, 0] = positions[parent, 0] + dx
            positions[node, 1] = positions[parent, 1] + dy
            positions[node, 2] = positions[parent, 2] + dz


@compiled
def _items(chains, placement, positions, rotations, points, turns):
    """Convert the poses of joints to the n tracked points of `chains`, in the world.

    Fills `points` (n, 3), sums and differences of joint positions, and `turns` (n, 4), the rotation of one joint of
    each point.
    """
    cos, sin = math.cos(placement[0]), math.sin(placement[0])
    yaw = (math.cos(0.5 * placement[0]), 0.0, math.sin(0.5 * placement[0]), 0.0)
    for item in range(points.shape[0]):
        points[item] = 0.0
        for term in range(chains.term_starts[item], chains.term_starts[item + 1]):
            for axis in range(3):
                points[item, axis] += chains.term_signs[term] * positions[chains.term_nodes[term], axis]
        x, z, held = points[item, 0], points[item, 2], chains.held[item]
        points[item, 0] = cos * x + sin * z + held * placement[1]
        points[item, 2] = cos * z - sin * x + held * placement[2]
        put_rotation(turns, item, product(yaw, rotations[chains.turned[item]]))


@compiled
def _times(clocks, latent, first, log_steps, times):
    """Fill `times` (n,) with the time, in seconds from the start of the motion, of each canonical frame of `clocks`.

    `log_steps` (N - 1,) is filled with the lengths of the steps between canonical frames, in frames (not with their
    logarithms). The temporal scores begin at index `first` of the latent vector. Returns the factor by which all times
    are multiplied so that the duration is within its range, and the duration in seconds before this multiplication.
    """
    log_steps[:] = clocks.mean
    for component in range(clocks.directions.shape[0]):
        score = latent[first + component]
        for step in range(log_steps.shape[0]):
            log_steps[step] += score * clocks.directions[component, step]
    lasting = 0.0
    least, most = clocks.log_slope_bounds
    for step in range(log_steps.shape[0]):
        log_steps[step] = math.exp(min(max(log_steps[step], least), most))
        lasting += log_steps[step] * clocks.frame_s
    factor = min(max(lasting, clocks.range_s[0]), clocks.range_s[1]) / lasting
    for clock in range(times.shape[0]):
        total = 0.0
        for step in range(log_steps.shape[0]):
            total += clocks.weights[clock, step] * log_steps[step]
        times[clock] = factor * total
    return factor, lasting


@compiled
def _angle_factors(sine, cosine):
    """Compute an angle divided by its sine, and the derivative of this ratio with respect to the cosine."""
    angle = math.atan2(sine, cosine)
    if angle < _SMALL:
        return 1.0 + angle * angle / 6.0, -1.0 / 3.0
    sine = max(sine, _TINY)
    return angle / sine, -(sine - angle * cosine) / (sine * sine * sine)


@compiled
def _rotation_error(turn, target, out):
    """Fill `out` (3,) with the rotation vector from the rotation `target` to the rotation `turn`.

    The length of the vector is the angle between the two rotations.
    """
    w, x, y, z = product(turn, inverse(target))
    if w < 0.0:
        w, x, y, z = -w, -x, -y, -z
    sine = math.sqrt(x * x + y * y + z * z)
    factor = 2.0 if sine < _TINY else 2.0 * math.atan2(sine, w) / sine
    out[0], out[1], out[2] = factor * x, factor * y, factor * z


@compiled
def _aims(kind, row, rows, points, turns, pointing, wanted):
    """Compute where a joint's axis points, and where the constraint with index `row` wants it to point.

    Fills `pointing` and `wanted` with unit directions (3,). Returns the distance from the joint to the point to look
    at, or 1 if the constraint is a direction. If the joint is at the point, any direction is right: `wanted` is set to
    `pointing`, and the result is 1.
    """
    item = rows.items[row]
    axis, target = rows.axes[row], rows.targets[row]
    pointing[0], pointing[1], pointing[2] = rotate_vector(turns[item], axis[0], axis[1], axis[2])
    wanted[:] = target[:3]
    distance = 1.0
    if kind == POINT:
        wanted -= points[item]
        distance = math.sqrt(wanted[0] * wanted[0] + wanted[1] * wanted[1] + wanted[2] * wanted[2])
        if distance < _TINY:  # it stands where it should look at: any direction is right
            wanted[:] = pointing
            return 1.0
        wanted /= distance
    return distance


@compiled
def _crossed(a, b, out):
    out[0] = a[1] * b[2] - a[2] * b[1]
    out[1] = a[2] * b[0] - a[0] * b[2]
    out[2] = a[0] * b[1] - a[1] * b[0]
    return math.sqrt(out[0] * out[0] + out[1] * out[1] + out[2] * out[2])


@compiled
def _residual(row, rows, points, turns, times, room, out):
    """Fill `out` (3,) with the error of the constraint with index `row`, in metres, radians or seconds.

    `points` and `turns` are the tracked points and rotations, and `times` the times that `_times` computes; `room`
    (2, 3) is overwritten.
    """
    kind, item, target = rows.kinds[row], rows.items[row], rows.targets[row]
    out[:] = 0.0
    if kind == POSITION:
        for axis in range(3):
            out[axis] = rows.axes[row, axis] * (points[item, axis] - target[axis])
    elif kind == ORIENTATION:
        _rotation_error(turns[item], target, out)
    elif kind == HEADING:
        # Forward is lateral times up: its (x, z) are (-lateral z, lateral x).
        error = math.atan2(-points[item, 2], points[item, 0]) - target[0]
        out[0] = error - 2.0 * math.pi * round(error / (2.0 * math.pi))
    elif kind == TIME:
        out[0] = times[item] - target[0]
    else:
        _aims(kind, row, rows, points, turns, room[0], room[1])
        sine = _crossed(room[0], room[1], out)
        cosine = room[0, 0] * room[1, 0] + room[0, 1] * room[1, 1] + room[0, 2] * room[1, 2]
        if sine < _TINY and cosine < 0.0:  # the opposite way: about any axis across
            across = np.argmin(np.abs(room[0]))
            room[1] = 0.0
            room[1, across] = 1.0
            out *= 0.0
            sine = _crossed(room[0], room[1], out)
            out *= math.pi / sine
        else:
            out *= _angle_factors(sine, cosine)[0]


@compiled
def errors(chains, clocks, rows, placement, latents, out):
    """Fill `out` (n, m) with the errors of n latent vectors (n, L) in m constraints, in metres, radians or seconds."""
    nodes, items = chains.parents.shape[0], chains.turned.shape[0]
    channels, local = np.empty(chains.mean.shape[0]), np.empty((nodes, 5))
    positions, rotations = np.empty((nodes, 3)), np.empty((nodes, 4))
    points, turns = np.empty((items, 3)), np.empty((items, 4))
    log_steps, times = np.empty(clocks.mean.shape[0]), np.empty(clocks.weights.shape[0])
    room, residual = np.empty((2, 3)), np.empty(3)
    spatial = chains.directions.shape[0]
    for n in range(latents.shape[0]):
        if nodes:
            _pose(chains, latents[n], channels, local, positions, rotations)
            _items(chains, placement, positions, rotations, points, turns)
        if times.shape[0]:
            _times(clocks, latents[n], spatial, log_steps, times)
        for row in range(rows.kinds.shape[0]):
            _residual(row, rows, points, turns, times, room, residual)
            square = residual[0] * residual[0] + residual[1] * residual[1] + residual[2] * residual[2]
            out[n, row] = math.sqrt(square)


@compiled
def costs(prices, errors, out):
    """Fill `out` (n,) with the costs of n latent vectors: sums of `errors` (n, m) times `prices` (m,) over constraints.

    The price of a constraint is its weight divided by its tolerance.
    """
    for n in range(out.shape[0]):
        total = 0.0
        for row in range(prices.shape[0]):
            total += prices[row] * errors[n, row]
        out[n] = total


@compiled
def track(chains, placement, latents, out):
    """Fill `out` (n, p, 3) with the p tracked points of `chains`, in the world, for latent vectors (n, L)."""
    nodes, items = chains.parents.shape[0], chains.turned.shape[0]
    channels, local = np.empty(chains.mean.shape[0]), np.empty((nodes, 5))
    positions, rotations, turns = np.empty((nodes, 3)), np.empty((nodes, 4)), np.empty((items, 4))
    for n in range(latents.shape[0]):
        _pose(chains, latents[n], channels, local, positions, rotations)
        _items(chains, placement, positions, rotations, out[n], turns)
