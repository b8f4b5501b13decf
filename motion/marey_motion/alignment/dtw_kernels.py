"""Compiled dynamic time warping, kept apart so that importing the rest of the package does not load numba."""

from __future__ import annotations

import numpy as np
from numba import njit

# Steps by which a cell was reached; of equal costs the lowest wins.
BOTH, FIRST, SECOND = 0, 1, 2

_compiled = njit(cache=True, nogil=True, boundscheck=False, error_model="numpy")


@_compiled
def align(costs, path):  # type: ignore[no-untyped-def]
    """Fill `path` backwards from the end; the least total and the number of cells."""
    n, m = costs.shape
    steps = np.zeros((n, m), np.uint8)
    totals = np.empty(m)
    totals[0] = costs[0, 0]
    for j in range(1, m):
        totals[j] = totals[j - 1] + costs[0, j]
        steps[0, j] = SECOND
    for i in range(1, n):
        diagonal = totals[0]
        left = totals[0] + costs[i, 0]
        totals[0] = left
        steps[i, 0] = FIRST
        for j in range(1, m):
            above = totals[j]
            best, step = diagonal, BOTH
            if above < best:
                best, step = above, FIRST
            if left < best:
                best, step = left, SECOND
            left = best + costs[i, j]
            totals[j] = left
            steps[i, j] = step
            diagonal = above
    return totals[m - 1], _walk_back(steps, path)


@_compiled
def _walk_back(steps, path):  # type: ignore[no-untyped-def]
    i, j, length = steps.shape[0] - 1, steps.shape[1] - 1, 0
    while True:
        path[length, 0], path[length, 1] = i, j
        length += 1
        if i == 0 and j == 0:
            return length
        step = steps[i, j]
        if step != SECOND:
            i -= 1
        if step != FIRST:
            j -= 1


@_compiled
def align_limited(costs, max_run, path):  # type: ignore[no-untyped-def]
    """As `align`, with at most `max_run` steps 1-0, or 0-1, in a row.

    Per cell there is a total for each way to have come: state 0 by a step in both, r by r steps in the first in a row,
    max_run + r by r steps in the second.
    """
    n, m = costs.shape
    states = 1 + 2 * max_run
    # The state before, where it is not told by the state itself: for a step in both, a first 1-0, a first 0-1.
    before = np.zeros((n, m, 3), np.uint8)
    above = np.full((m, states), np.inf)
    here = np.full((m, states), np.inf)
    for i in range(n):
        for j in range(m):
            here[j, :] = np.inf
            if i == 0 and j == 0:
                here[0, 0] = costs[0, 0]
                continue
            cost = costs[i, j]
            if i > 0 and j > 0:
                state = _least(above[j - 1], 0, states, 0, 0)
                here[j, 0], before[i, j, 0] = above[j - 1, state] + cost, state
            if i > 0 and max_run > 0:
                state = _least(above[j], 0, 1, max_run + 1, states)
                here[j, 1], before[i, j, 1] = above[j, state] + cost, state
                for run in range(2, max_run + 1):
                    here[j, run] = above[j, run - 1] + cost
            if j > 0 and max_run > 0:
                state = _least(here[j - 1], 0, max_run + 1, 0, 0)
                here[j, max_run + 1], before[i, j, 2] = here[j - 1, state] + cost, state
                for run in range(2, max_run + 1):
                    here[j, max_run + run] = here[j - 1, max_run + run - 1] + cost
        above, here = here, above
    state = _least(above[m - 1], 0, states, 0, 0)
    total = above[m - 1, state]
    return total, _walk_back_limited(before, max_run, state, path) if np.isfinite(total) else 0


@_compiled
def _least(totals, start, stop, other_start, other_stop):  # type: ignore[no-untyped-def]
    """The first of the least among totals[start:stop] and totals[other_start:other_stop]."""
    best = start
    for state in range(start, stop):
        if totals[state] < totals[best]:
            best = state
    for state in range(other_start, other_stop):
        if totals[state] < totals[best]:
            best = state
    return best


@_compiled
def _walk_back_limited(before, max_run, state, path):  # type: ignore[no-untyped-def]
    i, j, length = before.shape[0] - 1, before.shape[1] - 1, 0
    while True:
        path[length, 0], path[length, 1] = i, j
        length += 1
        if i == 0 and j == 0:
            return length
        if state == 0:
            state = before[i, j, 0]
            i -= 1
            j -= 1
        elif state <= max_run:
            state = before[i, j, 1] if state == 1 else state - 1
            i -= 1
        else:
            state = before[i, j, 2] if state == max_run + 1 else state - 1
            j -= 1


@_compiled
def _distances_of_frame(points, others, row):  # type: ignore[no-untyped-def]
    """Fill row (m,) with the mean distance of points (P, 3) from each frame of others (P, 3, m)."""
    count = points.shape[0]
    row[:] = 0.0
    for p in range(count):
        x, y, z = points[p, 0], points[p, 1], points[p, 2]
        for j in range(row.shape[0]):
            dx, dy, dz = others[p, 0, j] - x, others[p, 1, j] - y, others[p, 2, j] - z
            row[j] += np.sqrt(dx * dx + dy * dy + dz * dz)
    for j in range(row.shape[0]):
        row[j] /= count


@_compiled
def distances(a, b, out):  # type: ignore[no-untyped-def]
    """Fill out (n, m); a (n, P, 3), b (P, 3, m)."""
    for i in range(a.shape[0]):
        _distances_of_frame(a[i], b, out[i])


@_compiled
def total_within(a, b, rest, limit):  # type: ignore[no-untyped-def]
    """Least total of a way through the distances of a (n, P, 3) and b (P, 3, m); infinite when it is above `limit`.

    rest (n,): what the rows after each row cost at the least. Every way passes every row, and totals never fall along
    it: once the least of a row and the rest are above the limit, so is the end.
    """
    n, m = a.shape[0], b.shape[2]
    costs = np.empty(m)
    totals = np.empty(m)
    for i in range(n):
        _distances_of_frame(a[i], b, costs)
        least = np.inf
        diagonal = left = np.inf
        for j in range(m):
            above = totals[j] if i > 0 else np.inf
            left = costs[0] if i == 0 and j == 0 else min(diagonal, above, left) + costs[j]
            totals[j] = left
            diagonal = above
            least = min(least, left)
        if least + rest[i] > limit:
            return np.inf
    return totals[m - 1] if totals[m - 1] <= limit else np.inf


@_compiled
def box_costs(a, low, high, out):  # type: ignore[no-untyped-def]
    """Fill out (n,) with the mean distance of the points of each frame of a (n, P, 3) from the nearest of B boxes.

    low, high (P, 3, B).
    """
    points, boxes = low.shape[0], low.shape[2]
    costs = np.empty(boxes)
    for i in range(a.shape[0]):
        costs[:] = 0.0
        for p in range(points):
            x, y, z = a[i, p, 0], a[i, p, 1], a[i, p, 2]
            for box in range(boxes):
                dx = max(low[p, 0, box] - x, x - high[p, 0, box], 0.0)
                dy = max(low[p, 1, box] - y, y - high[p, 1, box], 0.0)
                dz = max(low[p, 2, box] - z, z - high[p, 2, box], 0.0)
                costs[box] += np.sqrt(dx * dx + dy * dy + dz * dz)
        least = costs[0]
        for box in range(1, boxes):
            least = min(least, costs[box])
        out[i] = least / points
