"""Kernels of searches by example: distances of windows, balls of poses, and groups of samples."""

from __future__ import annotations

import math

import numpy as np

from marey_motion.kernels import compiled, contracted, inlined
from marey_motion.perception.map_kernels import ANGLE, EUCLID, MANHATTAN, ONE_MINUS_DOT, SIGMOID
from marey_motion.similarity.bounding_kernels import row_bound


@compiled
def loosened(most, samples):
    """Compute a limit for the sum of the lower bounds of `samples` distances, with a margin for rounding errors.

    If a sum in single precision exceeds the limit, the mean distance certainly exceeds `most`.
    """
    return (most + 1e-5) * samples / (1.0 - 1e-4)


@inlined
def _shaped(x, shaping, exponent):
    """Apply a shaping F to a difference x."""
    if shaping == SIGMOID:
        return x / (x + 1.0)
    if shaping == MANHATTAN:
        return x
    if shaping == EUCLID:
        return x * x
    return x**exponent


@inlined
def _angle(square, measure):
    """Compute the measure of an angle from the squared chord between quaternions."""
    if measure == ONE_MINUS_DOT:
        return 0.5 * square
    half = 2.0 * math.asin(min(0.5 * math.sqrt(square), 1.0))
    return 2.0 * half if measure == ANGLE else half


@inlined
def _apart(a, b, rotated, place, rotations_at, measure):
    """Compute the distance between two rows in one vector or rotation, which is selected by `rotated` and `place`."""
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
def pose_distance(a, b, tables, rotations_at):
    """Compute the distance between two rows by the metric."""
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
def group_samples(query, tables, rotations_at, most, groups, distances):
    """Divide samples into at most `most` groups of similar samples, and return the number of groups.

    The first sample of each new group is the one farthest from the first samples of all earlier groups. Fills groups
    (T,) with the group of each sample, and distances (T,) with its distance from the first sample of this group.
    """
    distances[:] = np.inf
    first = 0
    for group in range(most):
        for t in range(query.shape[0]):
            distance = pose_distance(query[first], query[t], tables, rotations_at)
            if distance < distances[t]:
                distances[t], groups[t] = distance, group
        first = int(np.argmax(distances))
        if distances[first] == 0.0:
            return group + 1
    return most


@compiled
def _places_of(steps, runs, length, layout, places, rows):
    """Locate the given steps in a shard, for windows whose last compared pose is `length` rows after the start.

    Fills places (n, 2) with the ball of each step and its number within the ball, and rows (n, 2) with the half-open
    range of rows in the step at which windows can start.
    """
    starts, firsts, ball_firsts = runs
    size, per_ball = layout[0], layout[1]
    run: int = 0
    for place in range(steps.shape[0]):
        while steps[place] >= firsts[run + 1]:
            run += 1
        step = steps[place] - firsts[run]
        places[place] = ball_firsts[run] + step // per_ball, step % per_ball
        rows[place, 0] = starts[run] + step * size
        rows[place, 1] = max(rows[place, 0], min(rows[place, 0] + size, starts[run + 1] - length))


@compiled
def _windows_in(rows, windows):
    """Fill windows (n, 2) with step and first row of the windows in ranges of rows; return their number."""
    count = 0
    for place in range(rows.shape[0]):
        for row in range(rows[place, 0], rows[place, 1]):
            windows[count] = place, row
            count += 1
    return count


@contracted
def _still_near(query, rows, bounds, places, windows, layout, tables, limit):
    """Return the indices of the windows whose sum of distances is not certainly above a limit.

    The sum of a window begins with the bounds of the groups of samples. For one sample after another, the bound of its
    group is replaced by the tighter bound for the exact row. A window is dropped as soon as its sum exceeds `limit`.
    """
    samples, offsets, groups, _, turns = query
    by_group, step_sums = bounds
    size, per_ball, vectors, distances = layout
    near = np.empty(windows.shape[0], np.int64)
    count = 0
    for window in range(windows.shape[0]):
        place, first = windows[window, 0], windows[window, 1]
        total = step_sums[place]
        for t in turns:
            ball = places[place, 0] + (places[place, 1] + offsets[t] // size) // per_ball
            exact = row_bound(samples[t], rows[first + offsets[t]], tables, vectors, distances)
            total += exact - by_group[groups[t], ball]
            if total > limit:
                break
        if total <= limit:
            near[count] = window
            count += 1
    return near[:count]


@compiled
def step_distances(query, shard, bounds, steps, runs, layout, tables, rotations_at, most, out):
    """Lower the elements of out (n, size) to the distances of the windows that start in n steps of `size` rows.

    An element does not change if it is already less than the distance, if the distance is above `most`, or if the
    window exceeds its run.

    * query holds samples (T, width), offsets (T,), groups (T,), the order in which the distances of samples are added,
      and the order in which their bounds are computed.
    * bounds holds the bounds of groups (G, balls), and their sums (n,) for the steps.
    * steps (n,) are ascending.
    * runs holds the first rows, steps and balls of all runs.
    * layout holds the numbers of rows per step, of steps per ball and of vectors, and a scratch array with an element
      for each vector and rotation.
    """
    samples, offsets, _, order, _ = query
    size, count = layout[0], samples.shape[0]
    places, rows = np.empty((steps.shape[0], 2), np.int64), np.empty((steps.shape[0], 2), np.int64)
    _places_of(steps, runs, np.max(offsets), layout, places, rows)
    windows = np.empty((steps.shape[0] * size, 2), np.int64)
    windows = windows[: _windows_in(rows, windows)]
    near = np.arange(windows.shape[0])
    if most < np.inf:
        near = _still_near(query, shard, bounds, places, windows, layout, tables, loosened(most, count))
    limit = most * count * (1.0 + 1e-12)
    for window in near:
        place, row = windows[window]
        total = 0.0
        for t in order:
            total += pose_distance(samples[t], shard[row + offsets[t]], tables, rotations_at)
            if total > limit:
                break
        if total <= limit:
            out[place, row - rows[place, 0]] = min(out[place, row - rows[place, 0]], total / count)


@compiled
def balls(rows, starts, size, vectors, rotations, centres, radii):
    """Fill the centres (width, balls) and radii (vectors + rotations, balls) of balls of `size` rows.

    Run r has the rows [starts[r], starts[r + 1]). The last ball of a run may have fewer than `size` rows.
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
