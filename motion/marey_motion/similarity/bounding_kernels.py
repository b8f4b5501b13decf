"""Kernels of searches by example: lower bounds of the distances of poses and windows from an example.

A ball holds a few consecutive rows: a centre for each vector and rotation, and a radius. By the triangle inequality,
the distance of a joint from a pose to any row in the ball is at least the distance to the centre less the radius. For
rotations, this holds for the chord of quaternions, which is never longer than half of the angle. The shapings increase,
so the bounds of joints give a bound of the metric. Likewise, several samples of the example can be enclosed in a ball,
whose reach is subtracted, too: then one bound holds for all of them.

All arithmetic is in single precision. Inner loops run over adjacent numbers of one-dimensional arrays, so that the
compiler uses vector instructions.
"""

from __future__ import annotations

import math

import numpy as np

from marey_motion.kernels import compiled, contracted
from marey_motion.perception.map_kernels import ANGLE, EUCLID, MANHATTAN, ONE_MINUS_DOT, SIGMOID

_CHUNK = 512
"""Balls that are computed at a time: enough that calls cost little, and few enough for the processor's cache."""
_GAP = 32
"""Balls between two ranges that are computed rather than skipped."""
_RANGE_COST, _STEP_COST = 60, 15
"""Time for each range, and for the rows of a step, relative to the time for a ball."""


@contracted
def _add_rotation_bounds(w, u, v, z, cw, cu, cv, cz, radii, reach, factor, measure, x):
    """Add factor · lower bound of the distance from a rotation to those in n balls with centres (cw, cu, cv, cz)."""
    if measure == ANGLE:
        factor = factor * np.float32(2.0)
    for j in range(x.shape[0]):
        aw, au, av, az = cw[j], cu[j], cv[j], cz[j]
        minus = (w - aw) * (w - aw) + (u - au) * (u - au) + (v - av) * (v - av) + (z - az) * (z - az)
        plus = (w + aw) * (w + aw) + (u + au) * (u + au) + (v + av) * (v + av) + (z + az) * (z + az)
        d = max(np.float32(math.sqrt(min(minus, plus))) - (radii[j] + reach), np.float32(0.0))
        x[j] += factor * (np.float32(0.5) * d * d if measure == ONE_MINUS_DOT else d)


@contracted
def _add_vector_bounds(u, v, z, cu, cv, cz, radii, reach, factor, x):
    """Add factor · lower bound of the distance from a vector to those in n balls with centres (cu, cv, cz)."""
    for j in range(x.shape[0]):
        du, dv, dz = u - cu[j], v - cv[j], z - cz[j]
        x[j] += factor * max(np.float32(math.sqrt(du * du + dv * dv + dz * dz)) - (radii[j] + reach), np.float32(0.0))


@contracted
def _add_shaped(x, weight, shaping, exponent, raw):
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
def _add_constant(constant, always, raw, total):
    """Add a component and its constant."""
    for j in range(raw.shape[0]):
        total[j] += raw[j] + (constant if always or raw[j] > np.float32(0.0) else np.float32(0.0))


@contracted
def bounds_within(q, reaches, centres, radii, begin, end, tables, vectors, x, raw, total):
    """Fill total (n,) with lower bounds of the distances from a ball of poses to the rows in the balls [begin, end).

    q (width,) and reaches (41,) are centre and radii of the ball of poses; x and raw (n,) are scratch arrays.
    """
    rotated, places, factors, weights, starts, constants, shapings, exponents, measure, always = tables
    total[:] = np.float32(0.0)
    for c in range(constants.shape[0]):
        raw[:] = np.float32(0.0)
        for t in range(starts[c], starts[c + 1]):
            x[:] = np.float32(0.0)
            for side in range(2):
                p, factor = places[t, side], np.float32(factors[t, side])
                if p >= 0 and rotated[t]:
                    r, at = vectors + p, 3 * vectors + 4 * p
                    _add_rotation_bounds(
                        q[at], q[at + 1], q[at + 2], q[at + 3], centres[at, begin:end], centres[at + 1, begin:end],
                        centres[at + 2, begin:end], centres[at + 3, begin:end], radii[r, begin:end], reaches[r], factor,
                        measure, x,
                    )  # fmt: skip
                elif p >= 0:
                    at = 3 * p
                    _add_vector_bounds(
                        q[at], q[at + 1], q[at + 2], centres[at, begin:end], centres[at + 1, begin:end],
                        centres[at + 2, begin:end], radii[p, begin:end], reaches[p], factor, x,
                    )  # fmt: skip
            _add_shaped(x, np.float32(weights[t]), shapings[c], exponents[c], raw)
        _add_constant(np.float32(constants[c]), always, raw, total)


@contracted
def pose_bounds(query, reaches, centres, radii, ranges, tables, vectors, out):
    """Fill out (G, balls) with lower bounds of the distances from G balls of poses to the rows in balls.

    query (G, width) and reaches (G, 41) are centres and radii of the balls of poses. ranges (n, 2) lists half-open
    ranges of balls to which the tables apply; the others are left as they are.
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
    """Add the bounds of the balls that are `later` balls after each."""
    for b in range(sums.shape[0] - later):
        sums[b] += bounds[b + later]


@contracted
def step_sums(poses, groups, steps, firsts, ball_firsts, per_ball, out):
    """Fill out (S,) with lower bounds of the sums of distances of all windows that start in a step.

    poses (G, balls) holds bounds of single poses. Sample t belongs to group groups[t], and is steps[t] after the start.
    The run r has the steps [firsts[r], firsts[r + 1]), and balls of `per_ball` steps from ball_firsts[r]. Steps in
    which no window starts that is within the run get infinity.
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


@compiled
def _covering_ranges(balls, ranges):
    """List half-open ranges that cover some balls, ascending, and return their number and the balls in them."""
    count, covered = 0, 0
    for place in range(balls.shape[0]):
        if count and balls[place] <= ranges[count - 1, 1] + _GAP:
            ranges[count - 1, 1] = balls[place] + 1
        else:
            covered += ranges[count - 1, 1] - ranges[count - 1, 0] if count else 0
            ranges[count, 0], ranges[count, 1] = balls[place], balls[place] + 1
            count += 1
    return count, covered + (ranges[count - 1, 1] - ranges[count - 1, 0] if count else 0)


@compiled
def narrow_steps(query, shard, bounds, places, layout, tables, limit):
    """Drop steps whose windows are certainly above a limit, by bounds of single samples.

    query holds samples (T, width), offsets (T,), groups (T,), and at last the order in which samples are used. shard
    holds rows, centres and radii. bounds holds those of groups (G, balls), room for those of samples (T, balls), and
    the sums (n,) of the steps. places (n, 2) are the ball in which each step lies, ascending, and its number in the
    ball. For one sample after the other, the bound of its group is replaced by its own. This ends when comparing the
    rows of the steps that are left takes less time.

    Returns the steps that are left (m,), and the number of samples whose bounds have been replaced.
    """
    samples, offsets, groups, _, turns = query
    _, centres, radii = shard
    by_group, by_sample, sums = bounds
    size, per_ball, vectors, _ = layout
    left = np.arange(sums.shape[0])
    balls, ranges = np.empty_like(left), np.empty((left.shape[0], 2), np.int64)
    reaches = np.zeros((1, radii.shape[0]), np.float32)
    for turn in range(samples.shape[0]):
        t = turns[turn]
        for i in range(left.shape[0]):
            balls[i] = places[left[i], 0] + (places[left[i], 1] + offsets[t] // size) // per_ball
        count, covered = _covering_ranges(balls[: left.shape[0]], ranges)
        if count * _RANGE_COST + covered > left.shape[0] * _STEP_COST:
            return left, turn
        pose_bounds(samples[t : t + 1], reaches, centres, radii, ranges[:count], tables, vectors, by_sample[t : t + 1])
        kept = 0
        for i in range(left.shape[0]):
            sums[left[i]] += by_sample[t, balls[i]] - by_group[groups[t], balls[i]]
            if sums[left[i]] <= limit:
                left[kept] = left[i]
                kept += 1
        left = left[:kept]
    return left, samples.shape[0]
