"""Compiled exact search, kept apart so that importing the rest of the package does not load numba.

`index` is a `marey_motion.matching.search.SearchIndex`; queries are normalised like its rows. Rows are database rows.
"""

from __future__ import annotations

import numpy as np
from numba import njit

_compiled = njit(cache=True, nogil=True, boundscheck=False, error_model="numpy")


@_compiled
def cost_of(index, row, query):  # type: ignore[no-untyped-def]
    """Squared distance of a row, selectable or not, to the query (D,): float64, summed in the order of dimensions."""
    values = index.rows[row]
    cost = 0.0
    for d in range(query.shape[0]):
        difference = values[d] - query[d]
        cost += difference * difference
    return cost


@_compiled
def nearest(index, query, warm_row, skip_start, skip_stop):  # type: ignore[no-untyped-def]
    """The selectable row of least cost outside [skip_start, skip_stop) and its cost; (-1, inf) when there is none.

    The lowest row wins a tie. `warm_row` is a row likely to be near, or -1; it changes the time taken, never the answer.
    """
    best_row, best_cost = -1, np.inf
    for row in range(index.rows.shape[0]):
        if index.selectable[row] and not skip_start <= row < skip_stop:
            cost = cost_of(index, row, query)
            if cost < best_cost:
                best_row, best_cost = row, cost
    return best_row, best_cost


@_compiled
def nearest_weighted(index, query, weights, skip_start, skip_stop):  # type: ignore[no-untyped-def]
    """As `nearest`, each dimension's squared difference multiplied by its weight (D,), at least 0."""
    best_row, best_cost = -1, np.inf
    for row in range(index.rows.shape[0]):
        if index.selectable[row] and not skip_start <= row < skip_stop:
            cost = 0.0
            for d in range(query.shape[0]):
                difference = index.rows[row, d] - query[d]
                cost += difference * difference * weights[d]
            if cost < best_cost:
                best_row, best_cost = row, cost
    return best_row, best_cost


@_compiled
def nearest_of_each(index, queries, rows, costs):  # type: ignore[no-untyped-def]
    """Fill rows and costs (Q,) with the nearest of each query (Q, D)."""
    for q in range(queries.shape[0]):
        rows[q], costs[q] = nearest(index, queries[q], -1, 0, 0)
