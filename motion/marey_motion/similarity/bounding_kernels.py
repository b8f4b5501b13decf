"""Kernels of searches by example: lower bounds of the distances of poses and windows from an example.

A row holds the features of one pose. A ball encloses a few consecutive rows of a clip: it has a centre and a radius for
each vector and each rotation. If a vector of a pose has the distance d from the centre, its distance from the same
vector of any row in the ball is at least d minus the radius, by the triangle inequality. For rotations, this holds for
the chord of quaternions, which is never longer than half of the angle. The shapings F increase, so the bounds of single
vectors and rotations give a bound of the metric. Several samples (compared poses) of the example can be enclosed in a
ball, too. If the radius of this ball is also subtracted, one bound holds for all these samples.

All arithmetic is in single precision. Inner loops run over adjacent numbers of one-dimensional arrays, so that the
compiler uses vector instructions.
"""

from __future__ import annotations

import math

import numpy as np

from marey_motion.kernels import contracted, contracted_inlined
from marey_motion.perception.map_kernels import ANGLE, EUCLID, MANHATTAN, ONE_MINUS_DOT, SIGMOID

_CHUNK = 512
"""Number of balls that are computed at a time: large, for few calls, but small enough for the processor's cache."""


@contracted_inlined
def _add_rotation_bounds(w, u, v, z, cw, cu, cv, cz, radii, reach, factor, measure, more, x):
    """Add to x (n,) factor · lower bound of the distance from a rotation to the rotations in each of n balls.

    If `more` is false, x is overwritten instead.
    """
    if measure == ANGLE:
        factor = factor * np.float32(2.0)
    for j in range(x.shape[0]):
        aw, au, av, az = cw[j], cu[j], cv[j], cz[j]
        minus = (w - aw) * (w - aw) + (u - au) * (u - au) + (v - av) * (v - av) + (z - az) * (z - az)
        plus = (w + aw) * (w + aw) + (u + au) * (u + au) + (v + av) * (v + av) + (z + az) * (z + az)
        d = max(np.float32(math.sqrt(min(minus, plus))) - (radii[j] + reach), np.float32(0.0))
        d = factor * (np.float32(0.5) * d * d if measure == ONE_MINUS_DOT else d)
        x[j] = x[j] + d if more else d


@contracted_inlined
def _add_vector_bounds(u, v, z, cu, cv, cz, radii, reach, factor, more, x):
    """Add to x (n,) factor · lower bound of the distance from a vector to the vectors in each of n balls.

    If `more` is false, x is overwritten instead.
    """
    for j in range(x.shape[0]):
        du, dv, dz = u - cu[j], v - cv[j], z - cz[j]
        d = factor * max(np.float32(math.sqrt(du * du + dv * dv + dz * dz)) - (radii[j] + reach), np.float32(0.0))
        x[j] = x[j] + d if more else d


@contracted_inlined
def _add_shaped(x, weight, shaping, exponent, raw):
    """Add weight · F(x) to raw (n,), where F is the shaping."""
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


@contracted_inlined
def _add_constant(constant, always, raw, total):
    """Add the distances by a component to total (n,): raw (n,) plus the constant of the component.

    Where raw is 0, the constant is added only if `always` is true.
    """
    for j in range(raw.shape[0]):
        total[j] += raw[j] + (constant if always or raw[j] > np.float32(0.0) else np.float32(0.0))


@contracted
def bounds_within(q, reaches, centres, radii, begin, end, tables, vectors, x, raw, total):
    """Fill total (n,) with lower bounds of the distances from a ball of samples to the rows in the balls [begin, end).

    q (width,) and reaches (41,) are the centre and the radii of the ball of samples; x and raw (n,) are scratch arrays.
    """
    rotated, places, factors, weights, starts, constants, shapings, exponents, measure, always = tables
    total[:] = np.float32(0.0)
    for c in range(constants.shape[0]):
        raw[:] = np.float32(0.0)
        for t in range(starts[c], starts[c + 1]):
            for side in range(2):
                p, factor = places[t, side], np.float32(factors[t, side])
                if p >= 0 and rotated[t]:
                    r, at = vectors + p, 3 * vectors + 4 * p
                    _add_rotation_bounds(
                        q[at], q[at + 1], q[at + 2], q[at + 3], centres[at, begin:end], centres[at + 1, begin:end],
                        centres[at + 2, begin:end], centres[at + 3, begin:end], radii[r, begin:end], reaches[r], factor,
                        measure, side > 0, x,
                    )  # fmt: skip
                elif p >= 0:
                    at = 3 * p
                    _add_vector_bounds(
                        q[at], q[at + 1], q[at + 2], centres[at, begin:end], centres[at + 1, begin:end],
                        centres[at + 2, begin:end], radii[p, begin:end], reaches[p], factor, side > 0,
                        x,
                    )  # fmt: skip
            _add_shaped(x, np.float32(weights[t]), shapings[c], exponents[c], raw)
        _add_constant(np.float32(constants[c]), always, raw, total)


@contracted
def pose_bounds(query, reaches, centres, radii, ranges, tables, vectors, out):
    """Fill `out` (G, B): a lower bound of the distances from each of G balls of samples to the rows in B balls of rows.

    `query` (G, width) and `reaches` (G, 41) are the centres and radii of the balls of samples; `centres` and `radii`
    are those of the balls of rows. `ranges` (n, 2) lists the half-open ranges of balls of rows to which `tables` apply.
    Columns of `out` for other balls of rows do not change.
    """
    x, raw, total = np.empty(_CHUNK, np.float32), np.empty(_CHUNK, np.float32), np.empty(_CHUNK, np.float32)
    for place in range(ranges.shape[0]):
        for begin in range(ranges[place, 0], ranges[place, 1], _CHUNK):
            end = min(begin + _CHUNK, ranges[place, 1])
            n = end - begin
            for g in range(query.shape[0]):
                bounds_within(
                    query[g], reaches[g], centres, radii, begin, end, tables, vectors, x[:n], raw[:n], total[:n]
                )
                out[g, begin:end] = total[:n]


@contracted
def _add_later(bounds, later, sums):
    """Add to each element of sums (balls,) the bound of the ball that is `later` balls after it."""
    for b in range(sums.shape[0] - later):
        sums[b] += bounds[b + later]


@contracted
def step_sums(poses, groups, steps, firsts, ball_firsts, per_ball, out):
    """Fill out (S,), for each of S steps, with a lower bound of the summed distances of any window that starts in it.

    poses (G, balls) holds the bounds that `pose_bounds` computes. Sample t of the example belongs to group groups[t],
    and is steps[t] steps after the start of the window. Run r (the rows of one clip) has the steps
    [firsts[r], firsts[r + 1]); its first ball is ball_firsts[r], and each ball has `per_ball` steps. A step gets
    infinity if windows that start in it exceed the run.
    """
    samples = groups.shape[0]
    # Windows that start in the same step of their balls have their samples in balls that are equally far apart.
    sums = np.zeros((per_ball, poses.shape[1]), np.float32)
    for phase in range(per_ball):
        for t in range(samples):
            _add_later(poses[groups[t]], (phase + steps[t]) // per_ball, sums[phase])
    for run in range(firsts.shape[0] - 1):
        count = firsts[run + 1] - firsts[run]
        for place in range(count):
            within = place + steps[samples - 1] < count
            ball = ball_firsts[run] + place // per_ball
            out[firsts[run] + place] = sums[place % per_ball, ball] if within else np.float32(np.inf)


@contracted_inlined
def _row_distances(sample, row, vectors, measure, distances):
    """Fill distances (41,) with the distances between two rows in each vector and each rotation; chords for angles."""
    for p in range(vectors):
        u, v, z = sample[3 * p] - row[3 * p], sample[3 * p + 1] - row[3 * p + 1], sample[3 * p + 2] - row[3 * p + 2]
        distances[p] = np.float32(math.sqrt(u * u + v * v + z * z))
    one, other = sample[3 * vectors :], row[3 * vectors :]
    factor = np.float32(2.0) if measure == ANGLE else np.float32(1.0)
    for p in range(distances.shape[0] - vectors):
        w, u, v, z = one[4 * p], one[4 * p + 1], one[4 * p + 2], one[4 * p + 3]
        aw, au, av, az = other[4 * p], other[4 * p + 1], other[4 * p + 2], other[4 * p + 3]
        minus = (w - aw) * (w - aw) + (u - au) * (u - au) + (v - av) * (v - av) + (z - az) * (z - az)
        plus = (w + aw) * (w + aw) + (u + au) * (u + au) + (v + av) * (v + av) + (z + az) * (z + az)
        square = min(minus, plus)
        half = np.float32(0.5) * square
        distances[vectors + p] = half if measure == ONE_MINUS_DOT else factor * np.float32(math.sqrt(square))


@contracted
def row_bound(sample, row, tables, vectors, distances):
    """Compute a lower bound of the distance between two rows in single precision; distances (41,) is a scratch array.

    The bound differs from the distance by rounding errors, and because chords are used instead of angles.
    """
    rotated, places, factors, weights, starts, constants, shapings, exponents, measure, always = tables
    _row_distances(sample, row, vectors, measure, distances)
    total = np.float32(0.0)
    for c in range(constants.shape[0]):
        raw = np.float32(0.0)
        for t in range(starts[c], starts[c + 1]):
            first = vectors if rotated[t] else 0
            x = np.float32(factors[t, 0]) * distances[first + places[t, 0]]
            if places[t, 1] >= 0:
                x += np.float32(factors[t, 1]) * distances[first + places[t, 1]]
            if shapings[c] == SIGMOID:
                raw += np.float32(weights[t]) * (x / (x + np.float32(1.0)))
            elif shapings[c] == MANHATTAN:
                raw += np.float32(weights[t]) * x
            elif shapings[c] == EUCLID:
                raw += np.float32(weights[t]) * x * x
            else:
                raw += np.float32(weights[t]) * np.float32(x ** exponents[c])
        total += raw
        if always or raw > np.float32(0.0):
            total += np.float32(constants[c])
    return total
