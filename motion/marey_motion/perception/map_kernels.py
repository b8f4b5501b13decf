"""Compiled motion maps: weighted shaped differences between all frames of two clips.

The points of joint class k are [starts[k], starts[k + 1]). The difference x of the class is scales[k] times the sum of
the distances of its points. Rows of a map come from a (n, P, C), columns from b (P, C, m) for P points with C
coordinates, so that inner loops run over adjacent numbers.
"""

from __future__ import annotations

import math

import numpy as np

from marey_motion.kernels import contracted, inlined

EUCLID, MANHATTAN, SIGMOID, POWER = 0, 1, 2, 3
HALF_ANGLE, ANGLE, ONE_MINUS_DOT = 0, 1, 2
# Series of the arcsine: below 0.1465, the greatest square it is used for, the first term left out is under one ulp.
_ARCSINE = tuple(math.comb(2 * n, n) / (4.0**n * (2 * n + 1)) for n in range(17))


@inlined
def _add(x, scale, weight, shaping, exponent, row):
    """Add weight · F(scale · x) to a row of the map."""
    if shaping == EUCLID:
        for j in range(row.shape[0]):
            row[j] += weight * (scale * x[j]) * (scale * x[j])
    elif shaping == MANHATTAN:
        for j in range(row.shape[0]):
            row[j] += weight * scale * x[j]
    elif shaping == SIGMOID:
        for j in range(row.shape[0]):
            row[j] += weight * (scale * x[j]) / (scale * x[j] + 1.0)
    else:
        for j in range(row.shape[0]):
            row[j] += weight * (scale * x[j]) ** exponent


@inlined
def _turns(a, b, cosines, sines):
    """Fill cosines and sines (m,) with the rotations about the vertical that superpose points b (P, 2, m) on a (P, 2).

    The points are on the ground, relative to their mean.
    """
    cosines[:] = 0.0
    sines[:] = 0.0
    for p in range(a.shape[0]):
        for j in range(cosines.shape[0]):
            cosines[j] += a[p, 0] * b[p, 0, j] + a[p, 1] * b[p, 1, j]
            sines[j] += a[p, 1] * b[p, 0, j] - a[p, 0] * b[p, 1, j]
    for j in range(cosines.shape[0]):
        length = math.sqrt(cosines[j] * cosines[j] + sines[j] * sines[j])
        # Points in one place have no best rotation.
        cosines[j] = cosines[j] / length if length > 0.0 else 1.0
        sines[j] = sines[j] / length if length > 0.0 else 0.0


@contracted
def vectors(a, b, starts, scales, weights, shape, ground, out):
    """Fill out (n, m) with Σ weight · F(x), where a and b hold vectors; shape is (shaping, exponent).

    ground holds the points on the ground, (n, P, 2) and (P, 2, m), by which each pair of frames is superposed; if P is
    0, the vectors are compared without superposition.
    """
    m = b.shape[2]
    turned = ground[0].shape[1] > 0
    x, cosines, sines = np.empty(m), np.empty(m), np.empty(m)
    for i in range(a.shape[0]):
        row = out[i]
        row[:] = 0.0
        if turned:
            _turns(ground[0][i], ground[1], cosines, sines)
        for k in range(weights.shape[0]):
            if weights[k] == 0.0:
                continue
            x[:] = 0.0
            for p in range(starts[k], starts[k + 1]):
                ax, ay, az = a[i, p, 0], a[i, p, 1], a[i, p, 2]
                if turned:
                    for j in range(m):
                        dx = ax - (cosines[j] * b[p, 0, j] - sines[j] * b[p, 2, j])
                        dy = ay - b[p, 1, j]
                        dz = az - (sines[j] * b[p, 0, j] + cosines[j] * b[p, 2, j])
                        x[j] += math.sqrt(dx * dx + dy * dy + dz * dz)
                else:
                    for j in range(m):
                        dx, dy, dz = ax - b[p, 0, j], ay - b[p, 1, j], az - b[p, 2, j]
                        x[j] += math.sqrt(dx * dx + dy * dy + dz * dz)
            _add(x, scales[k], weights[k], shape[0], shape[1], row)


@contracted
def rotations(a, b, starts, scales, weights, shape, measure, out):
    """Fill out (n, m) with Σ weight · F(x), where a and b hold unit quaternions of any sign.

    Angles are computed from the chord between quaternions: the arccosine of a dot product loses half of the digits of
    small angles, and is not 0 for equal rotations.
    """
    m = b.shape[2]
    x = np.empty(m)
    for i in range(a.shape[0]):
        row = out[i]
        row[:] = 0.0
        for k in range(weights.shape[0]):
            if weights[k] == 0.0:
                continue
            x[:] = 0.0
            for p in range(starts[k], starts[k + 1]):
                aw, ax, ay, az = a[i, p, 0], a[i, p, 1], a[i, p, 2], a[i, p, 3]
                for j in range(m):
                    bw, bx, by, bz = b[p, 0, j], b[p, 1, j], b[p, 2, j], b[p, 3, j]
                    minus = (
                        (aw - bw) * (aw - bw) + (ax - bx) * (ax - bx) + (ay - by) * (ay - by) + (az - bz) * (az - bz)
                    )
                    plus = (aw + bw) * (aw + bw) + (ax + bx) * (ax + bx) + (ay + by) * (ay + by) + (az + bz) * (az + bz)
                    chord = min(minus, plus)
                    if measure == ONE_MINUS_DOT:
                        x[j] += 0.5 * chord
                    else:
                        # The half angle is four times the arcsine of y: twice from the chord, twice from halving.
                        square = 0.25 * chord
                        square = square / (2.0 + 2.0 * math.sqrt(max(1.0 - square, 0.0)))
                        series = _ARCSINE[16]
                        for n in range(15, -1, -1):
                            series = series * square + _ARCSINE[n]
                        x[j] += (8.0 if measure == ANGLE else 4.0) * math.sqrt(square) * series
            _add(x, scales[k], weights[k], shape[0], shape[1], row)
