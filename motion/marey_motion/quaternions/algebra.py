"""Rotations as unit quaternions (w, x, y, z).

Components are on the last axis; any leading axes broadcast. Arithmetic is done in float64 and the result has the
floating type of the arguments (float32 in, float32 out). Angles are radians. A rotation acts on column vectors, so
`multiply(a, b)` does `b` first. `from_x` makes rotations of another form, `as_x` gives that form back.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from marey_motion.arrays import AnyFloats, Floats
from marey_motion.errors import RotationError

# Below this length a direction is rounding noise.
TINY = 1e-12
# Sine below which an angle next to gimbal lock carries no information in float64.
LOCKED = 1e-7
# Length of the unnormalised quaternion between two directions below which its axis loses digits.
NEARLY_OPPOSITE = 0.1
# Blocks of so many rotations keep their temporaries in the first-level caches.
EULER_BLOCK = 4096


@overload
def identity(*leading: int) -> Floats: ...
@overload
def identity(*leading: int, dtype: type[np.floating[Any]]) -> AnyFloats: ...
def identity(*leading: int, dtype: type[np.floating[Any]] = np.float64) -> AnyFloats:
    """Make rotations that change nothing.

    Parameters
    ----------
    leading : int    sizes of the leading axes
    dtype : floating type    type of the result

    Returns
    -------
    (*leading, 4)    unit quaternions
    """
    result = np.zeros((*leading, 4), dtype=dtype)
    result[..., 0] = 1.0
    return result


def multiply(a: ArrayLike, b: ArrayLike) -> AnyFloats:
    """Multiply quaternions (the Hamilton product a·b): the rotation that does `b`, then `a`.

    Parameters
    ----------
    a, b : (..., 4)    quaternions; leading axes broadcast

    Returns
    -------
    (..., 4)    the product
    """
    (a, b), dtype = _widened((a, 4), (b, 4))
    return _product(a, b).astype(dtype, copy=False)


def conjugate(q: ArrayLike) -> AnyFloats:
    """Invert unit quaternions.

    Parameters
    ----------
    q : (..., 4)    unit quaternions

    Returns
    -------
    (..., 4)    the inverse rotations
    """
    (q,), dtype = _widened((q, 4))
    return (q * (1.0, -1.0, -1.0, -1.0)).astype(dtype, copy=False)


def normalise(q: ArrayLike) -> AnyFloats:
    """Bring quaternions to unit length.

    Parameters
    ----------
    q : (..., 4)    quaternions of any length but zero

    Returns
    -------
    (..., 4)    unit quaternions

    Raises
    ------
    RotationError    if one has no length
    """
    (q,), dtype = _widened((q, 4))
    return _unit(q, "quaternion").astype(dtype, copy=False)


def rotate_vectors(q: ArrayLike, v: ArrayLike) -> AnyFloats:
    """Rotate vectors.

    Parameters
    ----------
    q : (..., 4)    unit quaternions
    v : (..., 3)    vectors; leading axes broadcast

    Returns
    -------
    (..., 3)    the rotated vectors, in the unit of `v`
    """
    (q, v), dtype = _widened((q, 4), (v, 3))
    return _rotated(q, v).astype(dtype, copy=False)


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
    All four of Shepperd's (1978) forms are laid out as rows of 4·q·qᵀ; the row with the largest diagonal is exact
    wherever the others cancel.
    """
    (m,), dtype = _widened((matrix, 3))
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
    return _unit(row, "quaternion").astype(dtype, copy=False)


def as_matrix(q: ArrayLike) -> AnyFloats:
    """Convert quaternions to rotation matrices.

    Parameters
    ----------
    q : (..., 4)    unit quaternions

    Returns
    -------
    (..., 3, 3)    rotation matrices, which act on column vectors
    """
    (q,), dtype = _widened((q, 4))
    w, x, y, z = _parts(q)
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
    RotationError    if an axis has no length
    """
    (axis,), dtype = _widened((axis, 3))
    half = 0.5 * np.asarray(angle_rad, dtype=np.float64)[..., None]
    return _joined(np.cos(half), _unit(axis, "axis") * np.sin(half)).astype(dtype, copy=False)


def from_rotation_vector(vector: ArrayLike) -> AnyFloats:
    """Make rotations about vectors by their length (the exponential map).

    Parameters
    ----------
    vector : (..., 3)    radians

    Returns
    -------
    (..., 4)    unit quaternions
    """
    (vector,), dtype = _widened((vector, 3))
    angle = np.linalg.norm(vector, axis=-1, keepdims=True)
    # numpy's sinc is sin(pi x) / (pi x), exact at zero.
    return _joined(np.cos(0.5 * angle), 0.5 * np.sinc(angle / (2.0 * np.pi)) * vector).astype(dtype, copy=False)


def as_rotation_vector(q: ArrayLike) -> AnyFloats:
    """Convert quaternions to axis times angle, of at most half a turn (the logarithmic map).

    Parameters
    ----------
    q : (..., 4)    unit quaternions

    Returns
    -------
    (..., 3)    radians
    """
    (q,), dtype = _widened((q, 4))
    return _rotation_vector(q).astype(dtype, copy=False)


def angle_between(a: ArrayLike, b: ArrayLike) -> AnyFloats:
    """Compute the angle of the shortest rotation between two rotations.

    Parameters
    ----------
    a, b : (..., 4)    unit quaternions; leading axes broadcast

    Returns
    -------
    (...)    radians, 0 to pi
    """
    (a, b), dtype = _widened((a, 4), (b, 4))
    turn = _product(a * (1.0, -1.0, -1.0, -1.0), b)
    angle: AnyFloats = 2.0 * np.arctan2(np.linalg.norm(turn[..., 1:], axis=-1), np.abs(turn[..., 0]))
    return angle.astype(dtype, copy=False)


def from_euler(order: str, angles_rad: ArrayLike, *, intrinsic: bool = True) -> AnyFloats:
    """Make rotations from Euler angles.

    Intrinsic rotations turn about the axes of the moving frame in the order written, as in the channels of BVH: "zxy"
    is Z·X·Y. Extrinsic ones turn about fixed axes, so that the first letter acts first.

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
    (angles,), dtype = _widened((angles_rad, len(axes)))
    flat = angles.reshape(-1, len(axes))
    result = np.empty((len(flat), 4))
    for start in range(0, len(flat), EULER_BLOCK):
        block = slice(start, start + EULER_BLOCK)
        _euler_block(axes, flat[block].T, result[block].T, intrinsic=intrinsic)
    return result.reshape(*angles.shape[:-1], 4).astype(dtype, copy=False)


def as_euler(q: ArrayLike, order: str, *, intrinsic: bool = True) -> AnyFloats:
    """Convert quaternions to Euler angles about three axes; see `from_euler`.

    The middle angle is in -pi/2 to pi/2, or in 0 to pi where first and last axis are the same. In gimbal lock only the
    sum or the difference of the outer angles is defined: that of the turn that acts first is zero then.

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
    Bernardes and Viollet (2022): half the sum and half the difference of the outer angles are each one arctangent.
    """
    axes = _euler_axes(order)
    if len(axes) != 3:
        raise RotationError(f"the order {order!r} contains {len(axes)} axes, but three are needed", where="order")
    (q,), dtype = _widened((q, 4))
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


def slerp(a: ArrayLike, b: ArrayLike, t: ArrayLike) -> AnyFloats:
    """Interpolate along the shorter arc between two rotations (Shoemake 1985).

    Parameters
    ----------
    a, b : (..., 4)    unit quaternions
    t : (...)    fraction of the arc, 0 for `a` and 1 for `b`

    Returns
    -------
    (..., 4)    unit quaternions
    """
    (a, b), dtype = _widened((a, 4), (b, 4))
    t = np.asarray(t, dtype=np.float64)[..., None]
    b = np.where(np.sum(a * b, axis=-1, keepdims=True) < 0.0, -b, b)
    # The arc from chord lengths keeps its precision for nearly equal rotations, where arccos of the dot product fails.
    arc = 2.0 * np.arctan2(np.linalg.norm(b - a, axis=-1, keepdims=True), np.linalg.norm(b + a, axis=-1, keepdims=True))
    # sin(s·arc)/sin(arc) written with sinc, so that equal rotations need no case of their own.
    scale = np.sinc(arc / np.pi)
    result = ((1.0 - t) * np.sinc((1.0 - t) * arc / np.pi) * a + t * np.sinc(t * arc / np.pi) * b) / scale
    return _unit(result, "quaternion").astype(dtype, copy=False)


def between_vectors(start: ArrayLike, end: ArrayLike, *, half_turn_axis: ArrayLike | None = None) -> AnyFloats:
    """Compute the shortest rotations from one direction to another.

    Opposite directions have no shortest rotation: those turn half about `half_turn_axis`, made perpendicular to
    `start`, or, without one, about the perpendicular next to the coordinate axis that `start` is farthest from.

    Parameters
    ----------
    start, end : (..., 3)    directions of any length but zero
    half_turn_axis : (..., 3), optional    axis for opposite directions

    Returns
    -------
    (..., 4)    unit quaternions

    Raises
    ------
    RotationError    if a direction has no length
    """
    (start, end), dtype = _widened((start, 3), (end, 3))
    start, end = np.broadcast_arrays(_unit(start, "start direction"), _unit(end, "end direction"))
    middle = start + end
    # |start + end|² / 2 = 1 + cos(angle), without the cancellation of the right side.
    result = _joined(0.5 * np.sum(middle * middle, axis=-1, keepdims=True), _cross(start, end))
    opposite = np.linalg.norm(result, axis=-1) < NEARLY_OPPOSITE
    if np.any(opposite):
        wished = None if half_turn_axis is None else np.broadcast_to(half_turn_axis, start.shape)[opposite]
        result[opposite] = _between_opposite(start[opposite], end[opposite], wished)
    return _unit(result, "quaternion").astype(dtype, copy=False)


def perpendicular(vector: ArrayLike, direction: ArrayLike) -> AnyFloats:
    """Compute the part of a vector at a right angle to a direction, at unit length.

    Parameters
    ----------
    vector, direction : (..., 3)    vectors of any length but zero

    Returns
    -------
    (..., 3)    unit vectors

    Raises
    ------
    RotationError    if the two are parallel
    """
    (vector, direction), dtype = _widened((vector, 3), (direction, 3))
    direction = _unit(direction, "direction")
    rest = vector - np.sum(vector * direction, axis=-1, keepdims=True) * direction
    return _unit(rest, "perpendicular part").astype(dtype, copy=False)


def twist_swing(q: ArrayLike, axis: ArrayLike) -> tuple[AnyFloats, AnyFloats]:
    """Split rotations into a twist about an axis and a swing: q = swing · twist.

    The swing's axis is perpendicular to `axis`. A swing of half a turn leaves the twist open; it is the identity then.

    Parameters
    ----------
    q : (..., 4)    unit quaternions
    axis : (..., 3)    directions of any length but zero

    Returns
    -------
    twist, swing : (..., 4) each    unit quaternions
    """
    (q, axis), dtype = _widened((q, 4), (axis, 3))
    axis = _unit(axis, "axis")
    along = np.sum(q[..., 1:] * axis, axis=-1, keepdims=True)
    twist = _joined(q[..., :1], along * axis)
    length = np.linalg.norm(twist, axis=-1, keepdims=True)
    twist = np.where(length > TINY, twist / np.maximum(length, TINY), (1.0, 0.0, 0.0, 0.0))
    swing = _product(q, twist * (1.0, -1.0, -1.0, -1.0))
    return twist.astype(dtype, copy=False), swing.astype(dtype, copy=False)


def unroll(q: ArrayLike, axis: int = 0) -> AnyFloats:
    """Choose the signs of quaternions so that neighbours in time are close.

    q and -q are one rotation; the first frame keeps its sign, and each later frame takes the sign nearer to the frame
    before it.

    Parameters
    ----------
    q : (..., 4)    quaternions
    axis : int    axis of time

    Returns
    -------
    (..., 4)    the same rotations
    """
    (q,), dtype = _widened((q, 4))
    q = np.moveaxis(q, axis, 0)
    signs = np.ones(q.shape[:-1])
    signs[1:] = np.where(np.sum(q[1:] * q[:-1], axis=-1) < 0.0, -1.0, 1.0)
    return np.moveaxis(q * np.cumprod(signs, axis=0)[..., None], 0, axis).astype(dtype, copy=False)


def angular_velocity(q: ArrayLike, frame_rate_hz: float) -> AnyFloats:
    """Differentiate rotations over time.

    The shortest rotation to the next frame, averaged over both neighbours; at the ends, their linear extrapolation.

    Parameters
    ----------
    q : (F, ..., 4)    unit quaternions
    frame_rate_hz : float    frames per second

    Returns
    -------
    (F, ..., 3)    radians per second, in the frame that the rotations map to
    """
    (q,), dtype = _widened((q, 4))
    steps = _rotation_vector(_product(q[1:], q[:-1] * (1.0, -1.0, -1.0, -1.0))) * frame_rate_hz
    return rate_from_steps(steps, len(q)).astype(dtype, copy=False)


def rate_from_steps(steps: Floats, frame_count: int) -> Floats:
    """Compute rates at frames from those between frames: means inside, extrapolated at the ends.

    Parameters
    ----------
    steps : (F - 1, ...) float64    rates between frames
    frame_count : int    number of frames F

    Returns
    -------
    (F, ...) float64    rates at frames; zero for a single frame
    """
    rate = np.zeros((frame_count, *steps.shape[1:]))
    if frame_count == 2:
        rate[:] = steps[0]
    elif frame_count > 2:
        rate[1:-1] = 0.5 * (steps[1:] + steps[:-1])
        rate[0] = 1.5 * steps[0] - 0.5 * steps[1]
        rate[-1] = 1.5 * steps[-1] - 0.5 * steps[-2]
    return rate


def _widened(*arguments: tuple[ArrayLike, int]) -> tuple[list[Floats], np.dtype[Any]]:
    """Convert arguments to float64, check their last axis, and choose the floating type of the result."""
    arrays = [np.asarray(values) for values, _ in arguments]
    for array, (_, size) in zip(arrays, arguments, strict=True):
        if array.ndim == 0 or array.shape[-1] != size:
            raise RotationError(f"the array has shape {array.shape}; expected (..., {size})")
    floating = [a.dtype if np.issubdtype(a.dtype, np.floating) else np.dtype(np.float64) for a in arrays]
    return [array.astype(np.float64, copy=False) for array in arrays], np.result_type(*floating)


def _euler_block(axes: tuple[int, ...], angles: Floats, result: Floats, *, intrinsic: bool) -> None:
    """Fill `result` (4, n) from `angles` (turns, n), multiplying one turn about a coordinate axis at a time."""
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


def _parts(q: Floats) -> tuple[Floats, ...]:
    return tuple(q[..., component] for component in range(q.shape[-1]))


def _joined(scalar: Floats, vector: Floats) -> Floats:
    leading = np.broadcast_shapes(scalar.shape[:-1], vector.shape[:-1])
    result = np.empty((*leading, 4))
    result[..., :1] = scalar
    result[..., 1:] = vector
    return result


def _product(a: Floats, b: Floats) -> Floats:
    aw, ax, ay, az = _parts(a)
    bw, bx, by, bz = _parts(b)
    result = np.empty((*np.broadcast_shapes(a.shape[:-1], b.shape[:-1]), 4))
    result[..., 0] = aw * bw - ax * bx - ay * by - az * bz
    result[..., 1] = aw * bx + ax * bw + ay * bz - az * by
    result[..., 2] = aw * by - ax * bz + ay * bw + az * bx
    result[..., 3] = aw * bz + ax * by - ay * bx + az * bw
    return result


def _cross(a: Floats, b: Floats) -> Floats:
    ax, ay, az = _parts(a)
    bx, by, bz = _parts(b)
    result = np.empty(np.broadcast_shapes(a.shape, b.shape))
    result[..., 0] = ay * bz - az * by
    result[..., 1] = az * bx - ax * bz
    result[..., 2] = ax * by - ay * bx
    return result


def _rotated(q: Floats, v: Floats) -> Floats:
    twice = 2.0 * _cross(q[..., 1:], v)
    return v + q[..., :1] * twice + _cross(q[..., 1:], twice)


def _between_opposite(start: Floats, end: Floats, wished: NDArray[Any] | None) -> Floats:
    """Compute rotations between nearly opposite vectors (n, 3): half a turn about a normal of `start`, then the
    rest."""
    candidates = [_cross(start, end), np.eye(3)[np.argmin(np.abs(start), axis=-1)]]
    if wished is not None:
        candidates.insert(1, np.asarray(wished, dtype=np.float64))
    axis = np.zeros_like(start)
    for candidate in reversed(candidates):
        across = candidate - np.sum(candidate * start, axis=-1, keepdims=True) * start
        axis = np.where(np.linalg.norm(across, axis=-1, keepdims=True) > TINY, across, axis)
    rest = _joined(1.0 - np.sum(start * end, axis=-1, keepdims=True), _cross(-start, end))
    return _product(_unit(rest, "quaternion"), _joined(np.zeros(1), _unit(axis, "axis")))


def _rotation_vector(q: Floats) -> Floats:
    q = np.where(q[..., :1] < 0.0, -q, q)
    sine = np.linalg.norm(q[..., 1:], axis=-1, keepdims=True)
    half = np.arctan2(sine, q[..., :1])
    vector: Floats = 2.0 * q[..., 1:] / np.sinc(half / np.pi)
    return vector


def _unit(v: Floats, what: str) -> Floats:
    length: Floats = np.linalg.norm(v, axis=-1, keepdims=True)
    if not np.all(length > TINY):
        raise RotationError(f"a {what} of length zero has no direction")
    return v / length


def _check_orthonormal(m: Floats) -> None:
    error = np.abs(np.einsum("...ik,...jk->...ij", m, m) - np.eye(3)).max(axis=(-2, -1), initial=0.0)
    determinant = np.sum(_cross(m[..., 0, :], m[..., 1, :]) * m[..., 2, :], axis=-1)
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
