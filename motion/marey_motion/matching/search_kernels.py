"""Compiled exact search, in a separate module so that importing other modules does not load numba.

`index` is a `marey_motion.matching.search.SearchIndex`; queries are normalised like its rows. Row numbers are those of
the database.

Proof that screening in float32 gives the same rows and costs as a search in float64 alone:

Let c be the cost of a row in exact arithmetic, c32 the cost computed by the screening, u = 2⁻²⁴, and ‖·‖ the norm with
the weights. Rounding row and query to float32 moves each by at most u times its norm, hence their distance √c by at
most u (‖row‖ + ‖query‖), which is less than half of `_Query.reach`. Each of the D terms of the sum then goes through at
most six roundings, and every addition is of nonnegative numbers, so c32 is the rounded vectors' cost times a factor
between (1 − u)^(D + 8) and (1 + u)^(D + 8):

    c32 ≤ (1 + u)^(D + 8) (√c + reach)²

If a row's cost is at most `best`, its c32 is at most the right side with c = best. `_limit` returns a greater value: it
multiplies by 1 + 4u (D + 8) instead of (1 + u)^(D + 8), and adds `least` for numbers near 0. So a row above the limit
is farther away than the best row and can be skipped; the costs of all other rows are computed again in float64, in the
order of the dimensions. A box's float32 bound obeys the same inequality, because in exact arithmetic it is at most the
cost of every rounded row in the box. The proof holds for all magnitudes. A fixed slack instead (1e-5 relative, 1e-6
absolute) would be enough only while the norms of row and query add up to less than about 40.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from marey_motion.kernels import compiled, inlined
from marey_motion.matching.search_lanes import LANES, box_costs, row_costs

# Rounding to the nearest float32 is relative to 2⁻²⁴ and, among denormal numbers or where those are taken as zero,
# absolute to less than 1e-37.
_ROUNDING = 2.0**-22
_SMALLEST = 1e-36


class _Query(NamedTuple):
    """A query during its search.

    Parameters
    ----------
    exact, exact_weights : (D,) float64 the query, and the weights of the squared differences
    rounded, weights : `exact` and `exact_weights` in float32, padded with zeros to the dimensions of the index
    skip_start, skip_stop : the rows [skip_start, skip_stop) are not considered
    reach, margin, least : terms of the bound that `_limit` computes
    sums, bounds : (16,) float32 arrays for the costs of the rows of a block, and for the lower bounds of 16 boxes
    """

    exact: Any
    exact_weights: Any
    rounded: Any
    weights: Any
    skip_start: int
    skip_stop: int
    reach: float
    margin: float
    least: float
    sums: Any
    bounds: Any


@inlined
def _cost(values, query, weights):
    cost = 0.0
    for d in range(query.shape[0]):
        difference = values[d] - query[d]
        cost += difference * difference * weights[d]
    return cost


@compiled
def cost_of(index, row, query):
    """Compute the squared distance of a row, selectable or not, from the query (D,).

    The terms are added in the order of the dimensions.
    """
    values = index.rows[row]
    cost = 0.0
    for d in range(query.shape[0]):
        difference = values[d] - query[d]
        cost += difference * difference
    return cost


@compiled
def _prepared(index, query, weights, skip_start, skip_stop):
    dimensions = index.blocks.shape[1]
    rounded = np.zeros(dimensions, np.float32)
    rounded_weights = np.zeros(dimensions, np.float32)
    square = 0.0
    largest = 0.0
    for d in range(query.shape[0]):
        rounded[d] = query[d]
        rounded_weights[d] = weights[d]
        square += query[d] * query[d]
        largest = max(largest, weights[d])
    reach = np.sqrt(largest) * ((np.sqrt(square) + index.radius) * _ROUNDING + _SMALLEST)
    return _Query(
        query,
        weights,
        rounded,
        rounded_weights,
        skip_start,
        skip_stop,
        reach,
        1.0 + (dimensions + 8) * _ROUNDING,
        _SMALLEST * max(1.0, largest),
        np.empty(LANES, np.float32),
        np.empty(LANES, np.float32),
    )


@inlined
def _limit(query, best):
    """Compute an upper bound of the float32 costs of all rows whose exact cost is at most `best`."""
    distance = np.sqrt(best) + query.reach
    return np.float32(distance * distance * query.margin + query.least)


@inlined
def _lane_of_least(sums, lanes):
    """Find the lane with the least sum among the lanes whose bits are set in `lanes`."""
    best = -1
    for lane in range(LANES):
        if lanes >> lane & 1 and (best < 0 or sums[lane] < sums[best]):
            best = lane
    return best


@inlined
def _screened_rows(index, query, block, limit):
    return row_costs(index.blocks, query.rounded, query.weights, query.sums, block, limit)


@inlined
def _screened_boxes(boxes, query, number, sums, limit):
    return box_costs(boxes, query.rounded, query.weights, sums, number, limit)


@inlined
def _choose_row(index, query, block, lanes, row, cost, limit):
    """Compare the best row so far with rows of a block: those whose bits are set in `lanes`.

    `row`, `cost` and `limit` are the best row so far, its exact cost, and the bound that `_limit` computes from the
    cost. Rows whose float32 cost is above the bound are skipped. Returns the new row, cost and limit.
    """
    while lanes:
        lane = _lane_of_least(query.sums, lanes)
        if query.sums[lane] > limit:
            break
        lanes ^= 1 << lane
        other = np.int64(index.block_rows[block, lane])
        if other == row or query.skip_start <= other < query.skip_stop:
            continue
        other_cost = _cost(index.rows[other], query.exact, query.exact_weights)
        if other_cost < cost or (other_cost == cost and other < row):
            row, cost, limit = other, other_cost, _limit(query, other_cost)
    return row, cost, limit


@inlined
def _search_group(index, query, group, row, cost, limit):
    """Compare the best row so far with the rows of a group of boxes.

    `row`, `cost` and `limit` are the best row so far, its exact cost, and a bound: rows with a greater float32 cost are
    skipped. Returns the new row, cost and limit.
    """
    boxes = _screened_boxes(index.boxes, query, group, query.bounds, limit)
    first = index.group_blocks[group]
    boxes &= (1 << (index.group_blocks[group + 1] - first)) - 1
    while boxes:
        box = _lane_of_least(query.bounds, boxes)
        if query.bounds[box] > limit:
            break
        boxes ^= 1 << box
        lanes = _screened_rows(index, query, first + box, limit)
        if lanes:
            row, cost, limit = _choose_row(index, query, first + box, lanes, row, cost, limit)
    return row, cost, limit


@compiled
def _search_boxes(index, query, row, cost, limit):
    """Search the nearest group of boxes first, for a tight limit, then the remaining groups in their order.

    Searching all groups in the order of their distance would visit a few per cent fewer groups, but take longer.
    `row`, `cost` and `limit` are the best row so far, its exact cost, and a bound: rows with a greater float32 cost are
    skipped. Returns the new row, cost and limit.
    """
    groups = index.boxes.shape[0]
    bounds = np.empty((index.group_boxes.shape[0], LANES), np.float32)
    for some in range(bounds.shape[0]):
        _screened_boxes(index.group_boxes, query, some, bounds[some], limit)
    bound = bounds.reshape(-1)
    nearest_group = 0
    for group in range(groups):
        if bound[group] < bound[nearest_group]:
            nearest_group = group
    if bound[nearest_group] <= limit:
        row, cost, limit = _search_group(index, query, nearest_group, row, cost, limit)
    for group in range(groups):
        if bound[group] <= limit and group != nearest_group:
            row, cost, limit = _search_group(index, query, group, row, cost, limit)
    return row, cost, limit


@compiled
def _search_blocks(index, query, start, stop, row, cost, limit):
    """Compare the best row so far with the rows of blocks [start, stop).

    `row`, `cost` and `limit` are the best row so far, its exact cost, and a bound: rows with a greater float32 cost are
    skipped. Returns the new row, cost and limit.
    """
    for block in range(start, stop):
        lanes = _screened_rows(index, query, block, limit)
        if lanes:
            row, cost, limit = _choose_row(index, query, block, lanes, row, cost, limit)
    return row, cost, limit


@compiled
def _nearest(index, query, weights, warm_row, skip_start, skip_stop):
    prepared = _prepared(index, query, weights, skip_start, skip_stop)
    row, cost, limit = np.int64(-1), np.inf, np.float32(np.inf)
    if warm_row >= 0:
        block = index.block_of_row[warm_row]
        row, cost, limit = _search_blocks(index, prepared, block, block + 1, row, cost, limit)
    if index.boxed:
        row, cost, limit = _search_boxes(index, prepared, row, cost, limit)
    else:
        row, cost, limit = _search_blocks(index, prepared, 0, index.blocks.shape[0], row, cost, limit)
    return row, cost


@compiled
def nearest(index, query, warm_row, skip_start, skip_stop):
    """Find the selectable row of least cost outside [skip_start, skip_stop).

    Returns the row and its cost, or (-1, inf) if there is none.

    Of several nearest rows, the row with the lowest number is returned. `warm_row` is a row that is likely to be near,
    or -1; it changes only the time of the search, not its result.
    """
    return _nearest(index, query, np.ones(query.shape[0]), warm_row, skip_start, skip_stop)


@compiled
def nearest_weighted(index, query, weights, skip_start, skip_stop):
    """Find the selectable row of least weighted cost outside [skip_start, skip_stop).

    The squared differences are multiplied by the non-negative `weights` (D,). Returns the row and its cost, or (-1,
    inf) if there is none.
    """
    return _nearest(index, query, weights, -1, skip_start, skip_stop)


@compiled
def nearest_of_each(index, queries, weights, warm_rows, skips, rows, costs):
    """Fill `rows` and `costs` (Q,) with the nearest row of each query (Q, D), and the cost of this row.

    `weights` (D,) multiply the squared differences. `warm_rows` (Q,) are rows likely to be near, or -1; `skips` (Q, 2)
    are the ranges [start, stop) of rows that are not considered.
    """
    for q in range(queries.shape[0]):
        rows[q], costs[q] = _nearest(index, queries[q], weights, warm_rows[q], skips[q, 0], skips[q, 1])


@compiled
def all_costs(index, query, weights, costs):
    """Fill `costs` (N,) with the cost of every row, selectable or not.

    The squared differences are multiplied by `weights` (D,).
    """
    for row in range(costs.shape[0]):
        costs[row] = _cost(index.rows[row], query, weights)


@compiled
def boxes_within(index, query, cost):
    """Count the blocks whose box has a squared distance of at most `cost` from the query.

    Any search for a row of this cost must visit at least these blocks.
    """
    prepared = _prepared(index, query, np.ones(query.shape[0]), 0, 0)
    limit = _limit(prepared, cost)
    count = 0
    for group in range(index.boxes.shape[0]):
        lanes = _screened_boxes(index.boxes, prepared, group, prepared.bounds, limit)
        for lane in range(index.group_blocks[group + 1] - index.group_blocks[group]):
            count += lanes >> lane & 1
    return count
