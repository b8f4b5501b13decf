"""Compiled costs of pairs of frames, kept apart so that importing the rest of the package does not load numba.

Inner loops run over the frames of the second motion, so frames are the last axis of that motion's arrays.
"""

from __future__ import annotations

import numpy as np

from marey_motion.kernels import compiled


@compiled
def _products(points, others, real, imaginary, heights):
    """Compare the points of one frame (P, 3) with each of m frames, `others` (P, 3, m).

    h = x + i·z is the horizontal position of a point in the single frame, and h' that of the same point in one of the
    m frames.
    `real` and `imaginary` (m,) are filled with the real and imaginary parts of the sum over the points of h times the
    complex conjugate of h'. `heights` (m,) are filled with the sums of the squared differences of height.
    """
    real[:] = 0.0
    imaginary[:] = 0.0
    heights[:] = 0.0
    for p in range(points.shape[0]):
        x, y, z = points[p, 0], points[p, 1], points[p, 2]
        xs, ys, zs = others[p, 0], others[p, 1], others[p, 2]
        for j in range(real.shape[0]):
            real[j] += x * xs[j] + z * zs[j]
            imaginary[j] += z * xs[j] - x * zs[j]
            rise = y - ys[j]
            heights[j] += rise * rise


@compiled
def turned(rows, columns, energies, other_energies, costs):
    """Fill `costs` (n, m) with the cost of each pair of frames after the best rotation about the vertical.

    rows (n, P, 3) and columns (P, 3, m) are the points of the two motions, centred in each frame; `energies` (n,) and
    `other_energies` (m,) are the sums of their squared horizontal distances from the centre.
    """
    n, m = costs.shape
    real, imaginary, heights = np.empty(m), np.empty(m), np.empty(m)
    for i in range(n):
        _products(rows[i], columns, real, imaginary, heights)
        for j in range(m):
            overlap = np.sqrt(real[j] * real[j] + imaginary[j] * imaginary[j])
            costs[i, j] = max(0.0, energies[i] + other_energies[j] - 2.0 * overlap) + heights[j]


@compiled
def turned_windows(a, b, window, costs):
    """Fill `costs` (n, m) like `turned`, but with one rotation and shift for all `window` frames of a window.

    `a` and `b` are the motions, as `cost.CostPoints`.
    """
    n, m = costs.shape
    width = m + window - 1
    sums = np.zeros((3, m))
    history = np.empty((window, 3, width))
    for row in range(n + window - 1):
        slot = row % window
        _products(a.rows[row], b.columns, history[slot, 0], history[slot, 1], history[slot, 2])
        i = row - window + 1
        if i < 0:
            continue
        _slide(history, row, window, sums)
        ax, az = a.centres[i, 0], a.centres[i, 1]
        for j in range(m):
            bx, bz = b.centres[j, 0], b.centres[j, 1]
            real = sums[0, j] - window * (ax * bx + az * bz)
            imaginary = sums[1, j] - window * (az * bx - ax * bz)
            ground = a.energies[i] + b.energies[j] - 2.0 * np.sqrt(real * real + imaginary * imaginary)
            costs[i, j] = (max(0.0, ground) + sums[2, j]) / window


@compiled
def _slide(history, row, window, sums):
    """Sum each of c matrices over windows of frames, along the diagonals, and write the sums to `sums` (c, m).

    The sums extend over `window` rows, the last of which is `row`. `history` (window, c, m + window - 1) is a ring
    buffer with the newest rows of the matrices.
    """
    sums[:] = 0.0
    for step in range(window):
        past = history[(row - window + 1 + step) % window]
        for channel in range(sums.shape[0]):
            values, total = past[channel], sums[channel]
            for j in range(total.shape[0]):
                total[j] += values[j + step]


@compiled
def _squares(points, others, row):
    row[:] = 0.0
    for p in range(points.shape[0]):
        x, y, z = points[p, 0], points[p, 1], points[p, 2]
        xs, ys, zs = others[p, 0], others[p, 1], others[p, 2]
        for j in range(row.shape[0]):
            dx, dy, dz = x - xs[j], y - ys[j], z - zs[j]
            row[j] += dx * dx + dy * dy + dz * dz


@compiled
def plain(rows, columns, costs):
    """Fill `costs` (n, m) with sums of squared distances of the points `rows` (n, P, 3) from `columns` (P, 3, m).

    The points contain the square roots of their weights as factors, see `cost.CostPoints`.
    """
    for i in range(costs.shape[0]):
        _squares(rows[i], columns, costs[i])


@compiled
def plain_windows(rows, columns, window, costs):
    """Fill `costs` (n, m) like `plain`, averaged over the `window` frames of each window."""
    n, m = costs.shape
    sums = np.zeros((1, m))
    history = np.empty((window, 1, m + window - 1))
    for row in range(n + window - 1):
        _squares(rows[row], columns, history[row % window, 0])
        if row >= window - 1:
            _slide(history, row, window, sums)
            costs[row - window + 1] = sums[0] / window
