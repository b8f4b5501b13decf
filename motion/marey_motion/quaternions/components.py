"""Arithmetic on the components of quaternions and vectors in float64, shared by algebra and conversions."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from marey_motion.arrays import Floats
from marey_motion.errors import RotationError

# Below this length a direction is rounding noise.
TINY = 1e-12


def widened(*arguments: tuple[ArrayLike, int]) -> tuple[list[Floats], np.dtype[Any]]:
    """Convert arguments to float64, check their last axis, and choose the floating type of the result.

    Parameters
    ----------
    *arguments : (array, int)    arrays, each with the size that its last axis must have

    Returns
    -------
    arrays, dtype    the arrays as float64, and the type that the result must have

    Raises
    ------
    RotationError    if a last axis has another size
    """
    arrays = [np.asarray(values) for values, _ in arguments]
    for array, (_, size) in zip(arrays, arguments, strict=True):
        if array.ndim == 0 or array.shape[-1] != size:
            raise RotationError(f"the array has shape {array.shape}; expected (..., {size})")
    floating = [a.dtype if np.issubdtype(a.dtype, np.floating) else np.dtype(np.float64) for a in arrays]
    return [array.astype(np.float64, copy=False) for array in arrays], np.result_type(*floating)


def parts(q: Floats) -> tuple[Floats, ...]:
    """Return the components of vectors or quaternions as separate arrays.

    Parameters
    ----------
    q : (..., n) float64    quaternions or vectors

    Returns
    -------
    n arrays (...) float64    views of the components
    """
    return tuple(q[..., component] for component in range(q.shape[-1]))


def joined(scalar: Floats, vector: Floats) -> Floats:
    """Join scalar and vector parts to quaternions.

    Parameters
    ----------
    scalar : (..., 1) float64    the components w
    vector : (..., 3) float64    the components x, y, z; leading axes broadcast

    Returns
    -------
    (..., 4) float64    quaternions
    """
    leading = np.broadcast_shapes(scalar.shape[:-1], vector.shape[:-1])
    result = np.empty((*leading, 4))
    result[..., :1] = scalar
    result[..., 1:] = vector
    return result


def product(a: Floats, b: Floats) -> Floats:
    """Multiply quaternions (the Hamilton product a·b), without checks of the arguments.

    Parameters
    ----------
    a, b : (..., 4) float64    quaternions; leading axes broadcast

    Returns
    -------
    (..., 4) float64    the product
    """
    aw, ax, ay, az = parts(a)
    bw, bx, by, bz = parts(b)
    result = np.empty((*np.broadcast_shapes(a.shape[:-1], b.shape[:-1]), 4))
    result[..., 0] = aw * bw - ax * bx - ay * by - az * bz
    result[..., 1] = aw * bx + ax * bw + ay * bz - az * by
    result[..., 2] = aw * by - ax * bz + ay * bw + az * bx
    result[..., 3] = aw * bz + ax * by - ay * bx + az * bw
    return result


def cross(a: Floats, b: Floats) -> Floats:
    """Compute cross products.

    Parameters
    ----------
    a, b : (..., 3) float64    vectors; leading axes broadcast

    Returns
    -------
    (..., 3) float64    the products
    """
    ax, ay, az = parts(a)
    bx, by, bz = parts(b)
    result = np.empty(np.broadcast_shapes(a.shape, b.shape))
    result[..., 0] = ay * bz - az * by
    result[..., 1] = az * bx - ax * bz
    result[..., 2] = ax * by - ay * bx
    return result


def rotation_vector(q: Floats) -> Floats:
    """Compute rotation vectors of at most half a turn from unit quaternions, without checks of the arguments.

    Parameters
    ----------
    q : (..., 4) float64    unit quaternions

    Returns
    -------
    (..., 3) float64    radians
    """
    q = np.where(q[..., :1] < 0.0, -q, q)
    sine = np.linalg.norm(q[..., 1:], axis=-1, keepdims=True)
    half = np.arctan2(sine, q[..., :1])
    vector: Floats = 2.0 * q[..., 1:] / np.sinc(half / np.pi)
    return vector


def unit(v: Floats, what: str) -> Floats:
    """Divide vectors or quaternions by their lengths.

    Parameters
    ----------
    v : (..., n) float64    vectors or quaternions
    what : str    noun for a single vector or quaternion, for the error message

    Returns
    -------
    (..., n) float64    the same directions, at unit length

    Raises
    ------
    RotationError    if a vector or quaternion has zero length
    """
    length: Floats = np.linalg.norm(v, axis=-1, keepdims=True)
    if not np.all(length > TINY):
        raise RotationError(f"a {what} of length zero has no direction")
    return v / length
