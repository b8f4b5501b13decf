"""Compiled search for the nearest pose, kept apart so that importing the rest of the package does not load numba."""

from __future__ import annotations

import numpy as np

from marey_motion.kernels import compiled


@compiled
def nearest_of_others(queries, query_groups, points, groups, found):
    """Fill `found` (Q,) with the distance of each query (Q, P, 3) from the nearest of N poses (N, P, 3).

    The distance of two poses is the sum over their P points. A query is compared only with poses whose `groups` (N,)
    differ from its own, `query_groups` (Q,); the result is infinite if there are no such poses. The pose that was
    nearest to the previous query is tried first, so that most other poses are ruled out early.
    """
    before = 0
    for q in range(queries.shape[0]):
        best, best_row = np.inf, before
        for step in range(-1, points.shape[0]):
            row = before if step < 0 else step
            if groups[row] == query_groups[q]:
                continue
            distance = 0.0
            for p in range(points.shape[1]):
                square = 0.0
                for c in range(3):
                    difference = np.float64(queries[q, p, c]) - np.float64(points[row, p, c])
                    square += difference * difference
                distance += np.sqrt(square)
                if distance >= best:
                    break
            if distance < best:
                best, best_row = distance, row
        found[q] = best
        before = best_row
