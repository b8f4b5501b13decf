"""Rotations as quaternions (w, x, y, z).

All functions take arrays with the components on the last axis and any leading axes, which broadcast.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.floating]


def identity(*leading: int, dtype: type[np.floating] = np.float64) -> Floats:
    """Rotations that change nothing, shape (*leading, 4)."""
    result = np.zeros((*leading, 4), dtype=dtype)
    result[..., 0] = 1.0
    return result


def multiply(a: Floats, b: Floats) -> Floats:
    """The rotation that first does `b`, then `a`: Hamilton product a·b, shape (..., 4)."""
    aw, ax, ay, az = np.moveaxis(a, -1, 0)
    bw, bx, by, bz = np.moveaxis(b, -1, 0)
    return np.stack(
        (
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ),
        axis=-1,
    )


def rotate_vectors(q: Floats, v: Floats) -> Floats:
    """Vectors (..., 3) turned by unit rotations (..., 4), shape (..., 3)."""
    u = q[..., 1:]
    t = 2.0 * np.cross(u, v)
    return v + q[..., :1] * t + np.cross(u, t)
