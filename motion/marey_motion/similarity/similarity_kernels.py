"""Kernels of searches by example: distances of windows, and lower bounds of them.

A ball holds a few consecutive rows: a centre for each vector and rotation, and a radius. By the triangle inequality,
the distance of a joint from a pose to any row in the ball is at least the distance to the centre less the radius. For
rotations, this holds for the chord of quaternions, which is never longer than half of the angle. The shapings increase,
so the bounds of joints give a bound of the metric.
"""

from __future__ import annotations

import math

import numpy as np

from marey_motion.kernels import compiled, contracted, inlined
from marey_motion.perception.map_kernels import ANGLE, EUCLID, MANHATTAN, ONE_MINUS_DOT, SIGMOID

_CHUNK = 256


@inlined
def _shaped(x, shaping, exponent):  # type: ignore[no-untyped-def]
    """Apply a shaping F."""
    if shaping == SIGMOID:
        return x / (x + 1.0)
    if shaping == MANHATTAN:
        return x
    if shaping == EUCLID:
        return x * x
    return x**exponent


@inlined
def _angle(square, measure):  # type: ignore[no-untyped-def]
    """Compute the measure of an angle from the squared chord between quaternions."""
    if measure == ONE_MINUS_DOT:
        return 0.5 * square
    half = 2.0 * math.asin(min(0.5 * math.sqrt(square), 1.0))
    return 2.0 * half if measure == ANGLE else half


@inlined
def _apart(a, b, rotated, place, rotations_at, measure):  # type: ignore[no-untyped-def]
    """Compute the distance of one vector or rotation in two rows."""
    if rotated:
        at = rotations_at + 4 * place
        minus = 0.0
        plus = 0.0
        for i in range(4):
            one, other = np.float64(a[at + i]), np.float64(b[at + i])
            minus += (one - other) * (one - other)
            plus += (one + other) * (one + other)
        return _angle(min(minus, plus), measure)
    total = 0.0
    for i in range(3):
        step = np.float64(a[3 * place + i]) - np.float64(b[3 * place + i])
        total += step * step
    return math.sqrt(total)


@compiled
def pose_distance(a, b, tables, rotations_at):  # type: ignore[no-untyped-def]
    """Compute the distance of two rows."""
    rotated, places, factors, weights, starts, constants, shapings, exponents, measure, always = tables
    distance = 0.0
    for c in range(constants.shape[0]):
        raw = 0.0
        for t in range(starts[c], starts[c + 1]):
            x = factors[t, 0] * _apart(a, b, rotated[t], places[t, 0], rotations_at, measure)
            if places[t, 1] >= 0:
                x += factors[t, 1] * _apart(a, b, rotated[t], places[t, 1], rotations_at, measure)
            raw += weights[t] * _shaped(x, shapings[c], exponents[c])
        distance += raw
        if always or raw > 0.0:
            distance += constants[c]
    return distance


@compiled
def step_distances(query, offsets, rows, steps, starts, firsts, size, tables, rotations_at, most, out):  # type: ignore[no-untyped-def]
    """Fill out (n, size) with the distances of the windows that start in some steps, where they are less than out.

    The run r has the rows [starts[r], starts[r + 1]) and the steps [firsts[r], firsts[r + 1]). steps (n,) ascend.
    A distance is the mean over the query's samples, in any order. Windows whose distance is certainly above `most`, and
    windows that leave their run, get no distance.
    """
    samples = query.shape[0]
    length = np.max(offsets)
    limit = most * samples * (1.0 + 1e-12)
    run = 0
    for place in range(steps.shape[0]):
        while steps[place] >= firsts[run + 1]:
            run += 1
        first = starts[run] + (steps[place] - firsts[run]) * size
        for start in range(first, min(first + size, starts[run + 1] - length)):
            total = 0.0
            for t in range(samples):
                total += pose_distance(query[t], rows[start + offsets[t]], tables, rotations_at)
                if total > limit:
                    break
            if total <= limit:
                out[place, start - first] = min(out[place, start - first], total / samples)


@compiled
def balls(rows, starts, size, vectors, rotations, centres, radii):  # type: ignore[no-untyped-def]
    """Fill the centres (width, balls) and radii (vectors + rotations, balls) of balls of `size` rows.

    The run r has the rows [starts[r], starts[r + 1]); its last ball may have fewer.
    """
    width = rows.shape[1]
    ball = 0
    mean = np.empty(width)
    for run in range(starts.shape[0] - 1):
        for first in range(starts[run], starts[run + 1], size):
            last = min(first + size, starts[run + 1])
            mean[:] = 0.0
            for row in range(first, last):
                for p in range(rotations):  # q and -q are the same rotation
                    at = 3 * vectors + 4 * p
                    dot = 0.0
                    for i in range(4):
                        dot += rows[row, at + i] * rows[first, at + i]
                    sign = 1.0 if dot >= 0.0 else -1.0
                    for i in range(4):
                        mean[at + i] += sign * rows[row, at + i]
                for i in range(3 * vectors):
                    mean[i] += rows[row, i]
            for i in range(width):
                centres[i, ball] = mean[i] / (last - first)
            for p in range(vectors + rotations):
                at = 3 * p if p < vectors else 3 * vectors + 4 * (p - vectors)
                length = 3 if p < vectors else 4
                greatest = 0.0
                for row in range(first, last):
                    minus = 0.0
                    plus = 0.0
                    for i in range(length):
                        centre = np.float64(centres[at + i, ball])
                        minus += (rows[row, at + i] - centre) * (rows[row, at + i] - centre)
                        plus += (rows[row, at + i] + centre) * (rows[row, at + i] + centre)
                    greatest = max(greatest, minus if p < vectors else min(minus, plus))
                # Rounded up, so that the ball holds its rows in single precision, too.
                radii[p, ball] = math.sqrt(greatest) * (1.0 + 1e-5) + 1e-6
            ball += 1


@contracted
def _add_rotation_bounds(q, centres, radii, factor, measure, x):  # type: ignore[no-untyped-def]
    """Add lower bounds of the distances of a rotation from those in balls (4, n)."""
    zero = np.float32(0.0)
    w, u, v, z = q[0], q[1], q[2], q[3]
    cw, cu, cv, cz = centres[0], centres[1], centres[2], centres[3]
    if measure == ANGLE:
        factor = factor * np.float32(2.0)
    for j in range(radii.shape[0]):
        minus = (w - cw[j]) ** 2 + (u - cu[j]) ** 2 + (v - cv[j]) ** 2 + (z - cz[j]) ** 2
        plus = (w + cw[j]) ** 2 + (u + cu[j]) ** 2 + (v + cv[j]) ** 2 + (z + cz[j]) ** 2
        d = max(np.float32(math.sqrt(min(minus, plus))) - radii[j], zero)
        x[j] += factor * (np.float32(0.5) * d * d if measure == ONE_MINUS_DOT else d)


@contracted
def _add_vector_bounds(q, centres, radii, factor, x):  # type: ignore[no-untyped-def]
    """Add lower bounds of the distances of a vector from those in balls (3, n)."""
    u, v, z = q[0], q[1], q[2]
    cu, cv, cz = centres[0], centres[1], centres[2]
    for j in range(radii.shape[0]):
        d = (u - cu[j]) ** 2 + (v - cv[j]) ** 2 + (z - cz[j]) ** 2
        x[j] += factor * max(np.float32(math.sqrt(d)) - radii[j], np.float32(0.0))


@contracted
def _add_shaped(x, weight, shaping, exponent, raw):  # type: ignore[no-untyped-def]
    """Add weight · F(x)."""
    if shaping == SIGMOID:
        for j in range(x.shape[0]):
            raw[j] += weight * (x[j] / (x[j] + np.float32(1.0)))
    elif shaping == MANHATTAN:
        for j in range(x.shape[0]):
            raw[j] += weight * x[j]
    elif shaping == EUCLID:
        for j in range(x.shape[0]):
            raw[j] += weight * x[j] * x[j]
    else:
        for j in range(x.shape[0]):
            raw[j] += weight * np.float32(x[j] ** exponent)


@contracted
def pose_bounds(query, centres, radii, mine, tables, vectors, out):  # type: ignore[no-untyped-def]
    """Fill out (samples, balls) with lower bounds of the distances from each sample to the rows in the balls.

    Only balls b with mine[b] are filled: those to which the tables apply. All arithmetic is in single precision.
    """
    for begin in range(0, centres.shape[1], _CHUNK):
        some = slice(begin, min(begin + _CHUNK, centres.shape[1]))
        if np.any(mine[some]):
            for s in range(query.shape[0]):
                total = _bounds_of_sample(query[s], centres[:, some], radii[:, some], tables, vectors)
                for j in range(total.shape[0]):
                    if mine[begin + j]:
                        out[s, begin + j] = total[j]


@contracted
def _bounds_of_sample(q, centres, radii, tables, vectors):  # type: ignore[no-untyped-def]
    """Compute lower bounds (n,) of the distances from a sample to the rows in balls."""
    rotated, places, factors, weights, starts, constants, shapings, exponents, measure, always = tables
    total = np.zeros(centres.shape[1], np.float32)
    x, raw = np.empty_like(total), np.empty_like(total)
    for c in range(constants.shape[0]):
        raw[:] = np.float32(0.0)
        for t in range(starts[c], starts[c + 1]):
            x[:] = np.float32(0.0)
            for side in range(2):
                p, factor = places[t, side], np.float32(factors[t, side])
                if p >= 0 and rotated[t]:
                    at = 3 * vectors + 4 * p
                    ball = centres[at : at + 4], radii[vectors + p]
                    _add_rotation_bounds(q[at : at + 4], ball[0], ball[1], factor, measure, x)
                elif p >= 0:
                    _add_vector_bounds(q[3 * p : 3 * p + 3], centres[3 * p : 3 * p + 3], radii[p], factor, x)
            _add_shaped(x, np.float32(weights[t]), shapings[c], exponents[c], raw)
        for j in range(raw.shape[0]):
            total[j] += raw[j] + np.float32(constants[c] if always or raw[j] > 0.0 else 0.0)
    return total


@contracted
def step_bounds(poses, steps, firsts, ball_firsts, per_ball, out):  # type: ignore[no-untyped-def]
    """Fill out (S,) with lower bounds of the distances of all windows that start in a step.

    poses (samples, balls) holds bounds of single poses, and the samples are `steps` after the start. The run r has the
    steps [firsts[r], firsts[r + 1]), and balls of `per_ball` steps from ball_firsts[r]. Steps in which no window starts
    that is within the run get infinity.
    """
    samples = poses.shape[0]
    for run in range(firsts.shape[0] - 1):
        count = firsts[run + 1] - firsts[run]
        for place in range(count):
            if place + steps[samples - 1] >= count:
                out[firsts[run] + place] = np.inf
                continue
            total = 0.0
            for t in range(samples):
                total += poses[t, ball_firsts[run] + (place + steps[t]) // per_ball]
            # Less the rounding of single precision.
            out[firsts[run] + place] = total / samples * (1.0 - 1e-4) - 1e-5
