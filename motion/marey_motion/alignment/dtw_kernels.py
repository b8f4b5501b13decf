"""Compiled dynamic time warping, kept apart so that importing the rest of the package does not load numba."""

from __future__ import annotations

import numpy as np

from marey_motion.kernels import compiled

# Steps that lead to a cell; if costs are equal, the lowest number is chosen.
BOTH, FIRST, SECOND = 0, 1, 2
LANES = 4


@compiled
def align(costs, path):
    """Fill the first rows of `path` with the cheapest path through `costs` (n, m), last cell first.

    Returns the total cost of the path and its number of cells.
    """
    n, m = costs.shape
    steps = np.empty((n, m), np.uint8)
    # The row before a block and the rows of the block, with an infinite border; only the first cell has a start.
    totals = np.full((LANES + 1, m + 1), np.inf)
    totals[0, 0] = 0.0
    whole = n - n % LANES if m >= LANES else 0
    for i in range(0, whole, LANES):
        _four_rows(costs[i : i + LANES], totals, steps[i : i + LANES])
        totals[0] = totals[LANES]
    for i in range(whole, n):
        _cells(costs[i], totals[0], totals[1], steps[i], 0, m)
        totals[0] = totals[1]
    return totals[0, m], _walk_back(steps, path)


@compiled
def _cheapest(both, first, second):
    """Find the least of three totals, and the number of its step.

    Step 0 advances both motions, step 1 the first motion alone, and step 2 the second motion alone. The code has no
    branches, because the processor could not predict them.
    """
    least = min(both, first, second)
    alone = least < both
    return least, np.uint8(alone) + np.uint8(alone & (least < first))


@compiled
def _cells(costs, before, totals, steps, start, stop):
    """Fill columns [start, stop) of one row of `totals` and `steps`, from the row `before` of totals.

    Column j of `costs` is column j + 1 of the totals.
    """
    for j in range(start, stop):
        least, steps[j] = _cheapest(before[j], before[j + 1], totals[j])
        totals[j + 1] = least + costs[j]


@compiled
def _four_rows(costs, totals, steps):
    """Fill four rows of `totals` and `steps` at once, as `_cells` does.

    Each row is computed one column behind the row above it, so that four cells, one of each row, are computed in
    parallel.
    """
    m = costs.shape[1]
    for row in range(LANES - 1):
        _cells(costs[row], totals[row], totals[row + 1], steps[row], 0, LANES - 1 - row)
    left_0, left_1, left_2, left_3 = totals[1, 3], totals[2, 2], totals[3, 1], totals[4, 0]
    past_0, past_1, past_2 = totals[1, 2], totals[2, 1], totals[3, 0]
    for j in range(LANES - 1, m):
        least_0, steps[0, j] = _cheapest(totals[0, j], totals[0, j + 1], left_0)
        least_1, steps[1, j - 1] = _cheapest(past_0, left_0, left_1)
        least_2, steps[2, j - 2] = _cheapest(past_1, left_1, left_2)
        least_3, steps[3, j - 3] = _cheapest(past_2, left_2, left_3)
        past_0, past_1, past_2 = left_0, left_1, left_2
        left_0, left_1 = least_0 + costs[0, j], least_1 + costs[1, j - 1]
        left_2, left_3 = least_2 + costs[2, j - 2], least_3 + costs[3, j - 3]
        totals[1, j + 1], totals[2, j], totals[3, j - 1], totals[4, j - 2] = left_0, left_1, left_2, left_3
    for row in range(1, LANES):
        _cells(costs[row], totals[row], totals[row + 1], steps[row], m - row, m)


@compiled
def _walk_back(steps, path):
    """Trace the path back from the last cell; fill `path`, last cell first, and return the number of its cells.

    `steps` (n, m) contains, for each cell, the number of the step that leads to it, as in `_cheapest`.
    """
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


@compiled
def total(costs):
    """Compute the total cost of the cheapest path through `costs` (n, m) in O(m) memory."""
    n, m = costs.shape
    totals = np.empty(m)
    for i in range(n):
        diagonal = left = np.inf
        for j in range(m):
            above = totals[j] if i > 0 else np.inf
            left = costs[0, 0] if i == 0 and j == 0 else min(diagonal, above, left) + costs[i, j]
            totals[j] = left
            diagonal = above
    return totals[m - 1]


@compiled
def align_limited(costs, max_run, path):
    """Fill `path` like `align`, with at most `max_run` consecutive steps in one motion alone.

    Returns the total cost, infinite if there is no such path, and the number of cells.
    """
    n, m = costs.shape
    # Least totals of the paths to each cell whose last step is not in the first alone, and not in the second alone.
    not_first, not_second = np.empty((n, m)), np.empty((n, m))
    runs, scratch = np.full((max_run, m), np.inf), np.empty((2, m))
    for i in range(n):
        before = max(0, i - 1)
        _limited_row(costs[i], i, not_first[before], not_second[before], runs, scratch, not_first[i], not_second[i])
    total = min(not_first[n - 1, m - 1], not_second[n - 1, m - 1])
    return total, _walk_back_limited(costs, max_run, not_first, not_second, path) if np.isfinite(total) else 0


@compiled
def align_limited_cyclic(costs, max_run, path):
    """Fill `path` like `align_limited`, with columns shifted so that the mean cost of the cells is least.

    Column `shift` becomes the first; the path counts columns from it. Returns the total cost, infinite if no shift has
    a path, the number of cells, and the shift.
    """
    n, m = costs.shape
    shifted, tried = np.empty((n, m)), np.empty_like(path)
    best, best_total, best_length, best_shift = np.inf, np.inf, 0, 0
    for shift in range(m):
        shifted[:, : m - shift] = costs[:, shift:]
        shifted[:, m - shift :] = costs[:, :shift]
        total, length = align_limited(shifted, max_run, tried)
        if length > 0 and total / length < best:
            best, best_total, best_length, best_shift = total / length, total, length, shift
            path[:length] = tried[:length]
    return best_total, best_length, best_shift


@compiled
def total_limited(costs, max_run):
    """Compute the total cost of the path of `align_limited`, in O(max_run·m) memory; infinite if there is no path."""
    n, m = costs.shape
    not_first, not_second = np.empty((2, m)), np.empty((2, m))
    runs, scratch = np.full((max_run, m), np.inf), np.empty((2, m))
    for i in range(n):
        now, before = i % 2, (i + 1) % 2
        _limited_row(costs[i], i, not_first[before], not_second[before], runs, scratch, not_first[now], not_second[now])
    return min(not_first[(n - 1) % 2, m - 1], not_second[(n - 1) % 2, m - 1])


@compiled
def _limited_row(costs, i, first_before, second_before, runs, scratch, not_first, not_second):
    """Compute the least totals of paths with limited runs to the cells of row `i`: `not_first` and `not_second` (m,).

    `not_first[j]` is the least total of the paths to cell j whose last step does not advance the first motion alone;
    `not_second[j]` is the least total of the paths whose last step does not advance the second motion alone.
    `first_before` and `second_before` are the values of `not_first` and `not_second` in the row before. Row r of `runs`
    (max_run, m) contains the totals of paths that end with r + 1 steps in the first motion alone; it is updated in
    place. `scratch` (2, m) is working memory for runs in the second motion alone. Such runs start from `not_second`,
    which depends only on the row before, so every loop runs over whole vectors.
    """
    m, max_run = costs.shape[0], runs.shape[0]
    if i == 0:
        not_second[:] = np.inf
        not_second[0] = costs[0]
    else:
        not_second[0] = np.inf
        for j in range(1, m):
            least = first_before[j - 1] if first_before[j - 1] < second_before[j - 1] else second_before[j - 1]
            not_second[j] = least + costs[j]
    not_first[:] = not_second
    if i > 0:
        for r in range(max_run - 1, -1, -1):
            source = first_before if r == 0 else runs[r - 1]
            for j in range(m):
                reached = source[j] + costs[j]
                runs[r, j] = reached
                not_second[j] = reached if reached < not_second[j] else not_second[j]
    source = not_second
    for r in range(max_run):
        target = scratch[r % 2]
        target[0] = np.inf
        for j in range(1, m):
            reached = source[j - 1] + costs[j]
            target[j] = reached
            not_first[j] = reached if reached < not_first[j] else not_first[j]
        source = target


@compiled
def _walk_back_limited(costs, max_run, not_first, not_second, path):
    """Trace the path back, one run of equal steps at a time; fill `path`, last cell first; return the number of cells.

    `not_first` and `not_second` (n, m) contain the least totals that `_limited_row` computes for each row.

    Equally cheap steps are preferred in this order: in both motions, in the first motion alone, in the second alone.
    """
    i, j, length = costs.shape[0] - 1, costs.shape[1] - 1, 0
    barred = BOTH  # the step that may not come next, so that two runs of the same step do not join to a longer one
    while i > 0 or j > 0:
        best, kind, steps = np.inf, BOTH, 1
        if i > 0 and j > 0:
            best = min(not_first[i - 1, j - 1], not_second[i - 1, j - 1]) + costs[i, j]
        if barred != FIRST:
            for run in range(1, min(max_run, i) + 1):
                reached = not_first[i - run, j]
                for step in range(i - run + 1, i + 1):
                    reached += costs[step, j]
                if reached < best:
                    best, kind, steps = reached, FIRST, run
        if barred != SECOND:
            for run in range(1, min(max_run, j) + 1):
                reached = not_second[i, j - run]
                for step in range(j - run + 1, j + 1):
                    reached += costs[i, step]
                if reached < best:
                    best, kind, steps = reached, SECOND, run
        for _ in range(steps):
            path[length, 0], path[length, 1] = i, j
            length += 1
            i -= kind != SECOND
            j -= kind != FIRST
        barred = kind
    path[length, 0], path[length, 1] = 0, 0
    return length + 1


@compiled
def _distances_of_frame(points, others, row):
    """Fill `row` (m,) with the mean distance between `points` (P, 3) and each frame of `others` (P, 3, m)."""
    count = points.shape[0]
    row[:] = 0.0
    for p in range(count):
        x, y, z = points[p, 0], points[p, 1], points[p, 2]
        for j in range(row.shape[0]):
            dx, dy, dz = others[p, 0, j] - x, others[p, 1, j] - y, others[p, 2, j] - z
            row[j] += np.sqrt(dx * dx + dy * dy + dz * dz)
    for j in range(row.shape[0]):
        row[j] /= count


@compiled
def distances(a, b, out):
    """Fill `out` (n, m) with the mean distance between the points of a (n, P, 3) and b (P, 3, m)."""
    for i in range(a.shape[0]):
        _distances_of_frame(a[i], b, out[i])


@compiled
def total_within(a, b, rest, limit):
    """Compute the total cost of the cheapest path for points a (n, P, 3) and b (P, 3, m); infinite if above `limit`.

    The cost of a cell is the mean distance of the points. `rest[i]` is a lower bound of the cost that a path adds after
    row i. Every path crosses every row, so the computation stops as soon as the least total in row i plus `rest[i]`
    exceeds the limit.
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


@compiled
def box_costs(a, low, high, out):
    """Fill `out` (n,) with the mean distance of the points of each frame of a (n, P, 3) from the nearest of B boxes.

    A box contains one bounding box for each point; `low` and `high` (P, 3, B) are their least and greatest coordinates.
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


@compiled
def range_bounds(points, starts, stops, low, high, one, others, limit, out):
    """Fill `out` (K,) with lower bounds of the costs of aligning range `one` with K other ranges of frames.

    points (N, P, 3); range r is [starts[r], stops[r]) and has the bounding box low[r], high[r] (P, 3). Costs are
    divided by the frames of the longer range. A bound that exceeds `limit` is not improved further.
    """
    for k in range(others.shape[0]):
        other = others[k]
        longer = max(stops[one] - starts[one], stops[other] - starts[other])
        most = limit * longer
        first = _mean_distance(points[starts[one]], points[starts[other]])
        last = _mean_distance(points[stops[one] - 1], points[stops[other] - 1])
        total = max(first, last)
        if total <= most:
            total = max(total, _cost_from_box(points, starts[one], stops[one], low[other], high[other], most))
        if total <= most:
            total = max(total, _cost_from_box(points, starts[other], stops[other], low[one], high[one], most))
        out[k] = total / longer


@compiled
def _mean_distance(a, b):
    total = 0.0
    for p in range(a.shape[0]):
        total += np.sqrt((a[p, 0] - b[p, 0]) ** 2 + (a[p, 1] - b[p, 1]) ** 2 + (a[p, 2] - b[p, 2]) ** 2)
    return total / a.shape[0]


@compiled
def _cost_from_box(points, start, stop, low, high, most):
    """Sum, over the frames [start, stop), the mean distance of the points (N, P, 3) from given boxes.

    The box of point p has the corners low[p] and high[p] (P, 3): it bounds this point in another range of frames. The
    sum is not continued once it exceeds `most`.
    """
    total = 0.0
    for i in range(start, stop):
        cost = 0.0
        for p in range(points.shape[1]):
            dx = max(low[p, 0] - points[i, p, 0], points[i, p, 0] - high[p, 0], 0.0)
            dy = max(low[p, 1] - points[i, p, 1], points[i, p, 1] - high[p, 1], 0.0)
            dz = max(low[p, 2] - points[i, p, 2], points[i, p, 2] - high[p, 2], 0.0)
            cost += np.sqrt(dx * dx + dy * dy + dz * dz)
        total += cost / points.shape[1]
        if total > most:
            break
    return total
