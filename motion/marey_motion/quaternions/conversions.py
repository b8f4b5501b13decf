"""Conversion of unit quaternions from and to matrices, axes and angles, rotation vectors and Euler angles."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike

from marey_motion.arrays import AnyFloats, Floats
from marey_motion.errors import RotationError
from marey_motion.quaternions.components import cross, joined, parts, rotation_vector, unit, widened

# Sine below which an angle next to gimbal lock carries no information in float64.
LOCKED = 1e-7
# Blocks of so many rotations keep their temporaries in the first-level caches.
EULER_BLOCK = 4096


def from_matrix(matrix: ArrayLike) -> AnyFloats:
    """Convert rotation matrices to quaternions.

    Parameters
    ----------
    matrix : (..., 3, 3)    rotation matrices, which act on column vectors

    Returns
    -------
    (..., 4)    unit quaternions

    Raises
    ------
    RotationError    for matrices that scale, shear or mirror

    Notes
    -----
    Shepperd's (1978) four formulas for q are the rows of the matrix 4·q·qᵀ. The row with the largest diagonal element
    is used, because it has no cancellation.
    """
    (m,), dtype = widened((matrix, 3))
    if m.shape[-2:] != (3, 3):
        raise RotationError(f"the matrices have shape {m.shape}; expected (..., 3, 3)", where="matrix")
    _check_orthonormal(m)
    outer = np.empty((*m.shape[:-2], 4, 4))
    trace = np.einsum("...ii->...", m)
    outer[..., 0, 0] = 1.0 + trace
    for i, (j, k) in enumerate(((1, 2), (2, 0), (0, 1))):
        outer[..., i + 1, i + 1] = 1.0 - trace + 2.0 * m[..., i, i]
        outer[..., 0, i + 1] = outer[..., i + 1, 0] = m[..., k, j] - m[..., j, k]
        outer[..., j + 1, k + 1] = outer[..., k + 1, j + 1] = m[..., j, k] + m[..., k, j]
    largest = np.argmax(np.einsum("...ii->...i", outer), axis=-1)
    row = np.take_along_axis(outer, largest[..., None, None], axis=-2)[..., 0, :]
    return unit(row, "quaternion").astype(dtype, copy=False)


def as_matrix(q: ArrayLike) -> AnyFloats:
    """Convert quaternions to rotation matrices.

    Parameters
    ----------
    q : (..., 4)    unit quaternions

    Returns
    -------
    (..., 3, 3)    rotation matrices, which act on column vectors
    """
    (q,), dtype = widened((q, 4))
    w, x, y, z = parts(q)
    m = np.empty((*q.shape[:-1], 3, 3))
    m[..., 0, 0] = 1.0 - 2.0 * (y * y + z * z)
    m[..., 0, 1] = 2.0 * (x * y - w * z)
    m[..., 0, 2] = 2.0 * (x * z + w * y)
    m[..., 1, 0] = 2.0 * (x * y + w * z)
    m[..., 1, 1] = 1.0 - 2.0 * (x * x + z * z)
    m[..., 1, 2] = 2.0 * (y * z - w * x)
    m[..., 2, 0] = 2.0 * (x * z - w * y)
    m[..., 2, 1] = 2.0 * (y * z + w * x)
    m[..., 2, 2] = 1.0 - 2.0 * (x * x + y * y)
    return m.astype(dtype, copy=False)


def from_axis_angle(axis: ArrayLike, angle_rad: ArrayLike) -> AnyFloats:
    """Make rotations from axes and angles.

    Parameters
    ----------
    axis : (..., 3)    directions of any length but zero
    angle_rad : (...)    radians

    Returns
    -------
    (..., 4)    unit quaternions

    Raises
    ------
    RotationError    if an axis has zero length
    """
    (axis,), dtype = widened((axis, 3))
    half = 0.5 * np.asarray(angle_rad, dtype=np.float64)[..., None]
    return joined(np.cos(half), unit(axis, "axis") * np.sin(half)).astype(dtype, copy=False)


def from_rotation_vector(vector: ArrayLike) -> AnyFloats:
    """Make rotations about vectors, by angles equal to the lengths of the vectors (the exponential map).

    Parameters
    ----------
    vector : (..., 3)    radians

    Returns
    -------
    (..., 4)    unit quaternions
    """
    (vector,), dtype = widened((vector, 3))
    angle = np.linalg.norm(vector, axis=-1, keepdims=True)
    # numpy's sinc is sin(pi x) / (pi x), exact at zero.
    return joined(np.cos(0.5 * angle), 0.5 * np.sinc(angle / (2.0 * np.pi)) * vector).astype(dtype, copy=False)


def as_rotation_vector(q: ArrayLike) -> AnyFloats:
    """Convert quaternions to rotation vectors: unit axis times angle, from 0 to pi (the logarithmic map).

    Parameters
    ----------
    q : (..., 4)    unit quaternions

    Returns
    -------
    (..., 3)    radians
    """
    (q,), dtype = widened((q, 4))
    return rotation_vector(q).astype(dtype, copy=False)


def from_euler(order: str, angles_rad: ArrayLike, *, intrinsic: bool = True) -> AnyFloats:
    """Make rotations from Euler angles.

    Intrinsic rotations turn about the axes of the moving frame in the order written, as in the channels of BVH: "zxy"
    is Z·X·Y. Extrinsic rotations turn about fixed axes, so that the first letter acts first.

    Parameters
    ----------
    order : str    one to three of the letters x, y and z, one per angle
    angles_rad : (..., n)    radians, in the order of the letters
    intrinsic : bool    turn about moving axes

    Returns
    -------
    (..., 4)    unit quaternions

    Raises
    ------
    RotationError    for any other order
    """
    axes = _euler_axes(order)
    (angles,), dtype = widened((angles_rad, len(axes)))
    flat = angles.reshape(-1, len(axes))
    result = np.empty((len(flat), 4))
    for start in range(0, len(flat), EULER_BLOCK):
        block = slice(start, start + EULER_BLOCK)
        _euler_block(axes, flat[block].T, result[block].T, intrinsic=intrinsic)
    return result.reshape(*angles.shape[:-1], 4).astype(dtype, copy=False)


def as_euler(q: ArrayLike, order: str, *, intrinsic: bool = True) -> AnyFloats:
    """Convert quaternions to Euler angles about three axes.

    Intrinsic rotations turn about the axes of the moving frame in the order written: "zxy" is Z·X·Y. Extrinsic
    rotations turn about fixed axes, so that the first letter acts first. The middle angle is from -pi/2 to pi/2, or
    from 0 to pi if the first and last axes are the same. In gimbal lock, only the sum or the difference of the first
    and last angles is defined; the angle of the rotation that acts first is then set to zero.

    Parameters
    ----------
    q : (..., 4)    unit quaternions
    order : str    three letters, such as "zxy"
    intrinsic : bool    turn about moving axes

    Returns
    -------
    (..., 3)    radians, in the order of the letters

    Raises
    ------
    RotationError    unless the order names three axes

    Notes
    -----
    Method of Bernardes and Viollet (2022): one arctangent gives half the sum of the first and last angles, another
    arctangent gives half the difference.
    """
    axes = _euler_axes(order)
    if len(axes) != 3:
        raise RotationError(f"the order {order!r} contains {len(axes)} axes, but three are needed", where="order")
    (q,), dtype = widened((q, 4))
    first, middle, last = axes if intrinsic else axes[::-1]
    proper = first == last
    third = 3 - first - middle if proper else last
    sign = 1.0 if (first, middle, third) in ((0, 1, 2), (1, 2, 0), (2, 0, 1)) else -1.0
    w, i, j, k = q[..., 0], q[..., 1 + first], q[..., 1 + middle], sign * q[..., 1 + third]
    near, far = ((w, i), (j, k)) if proper else ((w - j, i - k), (w + j, i + k))
    near_length, far_length = np.hypot(*near), np.hypot(*far)
    near_phase, far_phase = np.arctan2(near[1], near[0]), np.arctan2(far[1], far[0])
    near_phase = np.where(near_length < LOCKED, far_phase, near_phase)
    far_phase = np.where(far_length < LOCKED, near_phase, far_phase)
    opening = 2.0 * np.arctan2(far_length, near_length)
    angles = np.empty((*q.shape[:-1], 3))
    angles[..., 0] = near_phase + far_phase
    angles[..., 1] = opening if proper else opening - 0.5 * np.pi
    angles[..., 2] = near_phase - far_phase if proper else sign * (far_phase - near_phase)
    angles -= 2.0 * np.pi * np.round(angles / (2.0 * np.pi))
    return (angles if intrinsic else angles[..., ::-1]).astype(dtype, copy=False)


def _check_orthonormal(m: Floats) -> None:
    error = np.abs(np.einsum("...ik,...jk->...ij", m, m) - np.eye(3)).max(axis=(-2, -1), initial=0.0)
    determinant = np.sum(cross(m[..., 0, :], m[..., 1, :]) * m[..., 2, :], axis=-1)
    wrong = ~(error <= 1e-3) | ~(determinant > 0.0)
    if np.any(wrong):
        index = tuple(int(i) for i in np.argwhere(wrong)[0])
        kind = "mirrors" if error[index] <= 1e-3 else "scales or shears"
        raise RotationError(f"the matrix at index {index} is not a rotation: it {kind}", where="matrix")


def _euler_axes(order: str) -> tuple[int, ...]:
    axes = tuple("xyz".find(letter) for letter in order.lower())
    if not 1 <= len(axes) <= 3 or -1 in axes or any(a == b for a, b in pairwise(axes)):
        raise RotationError(
            f"{order!r} is not an order of axes; write it as in 'zxy', with no axis twice in a row", where="order"
        )
    return axes


def _euler_block(axes: tuple[int, ...], angles: Floats, result: Floats, *, intrinsic: bool) -> None:
    """Fill `result` (4, n) with n products of rotations by `angles` (len(axes), n) about the coordinate axes `axes`."""
    half = 0.5 * np.ascontiguousarray(angles)
    cosines, sines = np.cos(half), np.sin(half)
    turns = list(zip(axes, cosines, sines, strict=True))
    w: Floats = np.ones(angles.shape[1])
    v: list[Floats] = [np.zeros(angles.shape[1]) for _ in range(3)]
    for axis, c, s in turns if intrinsic else reversed(turns):
        i, j, k = axis, (axis + 1) % 3, (axis + 2) % 3
        w, v[i], v[j], v[k] = w * c - v[i] * s, v[i] * c + w * s, v[j] * c + v[k] * s, v[k] * c - v[j] * s
    result[0] = w
    result[1:] = v
