"""Rotations as unit quaternions (w, x, y, z).

Components are on the last axis; any leading axes broadcast. Arithmetic is done in float64 and the result has the
floating type of the arguments (float32 in, float32 out). Angles are radians. A rotation acts on column vectors, so
`multiply(a, b)` does `b` first. `from_x` makes rotations of another form, `as_x` gives that form back.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any

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


def identity(*leading: int, dtype: type[np.floating[Any]] = np.float64) -> AnyFloats:
    """Rotations that change nothing, shape (*leading, 4)."""
    result = np.zeros((*leading, 4), dtype=dtype)
    result[..., 0] = 1.0
    return result


def multiply(a: ArrayLike, b: ArrayLike) -> AnyFloats:
    """The rotation that does `b`, then `a`: the Hamilton product a·b, shape (..., 4)."""
    (a, b), dtype = _widened((a, 4), (b, 4))
    return _product(a, b).astype(dtype, copy=False)


def conjugate(q: ArrayLike) -> AnyFloats:
    """The inverse of unit rotations (..., 4)."""
    (q,), dtype = _widened((q, 4))
    return (q * (1.0, -1.0, -1.0, -1.0)).astype(dtype, copy=False)


def normalise(q: ArrayLike) -> AnyFloats:
    """Quaternions (..., 4) at unit length; `RotationError` where one has no length."""
    (q,), dtype = _widened((q, 4))
    return _unit(q, "quaternion").astype(dtype, copy=False)


def rotate_vectors(q: ArrayLike, v: ArrayLike) -> AnyFloats:
    """Vectors (..., 3) turned by unit rotations (..., 4), shape (..., 3)."""
    (q, v), dtype = _widened((q, 4), (v, 3))
    return _rotated(q, v).astype(dtype, copy=False)


def from_matrix(matrix: ArrayLike) -> AnyFloats:
    """Rotations (..., 4) of rotation matrices (..., 3, 3), which act on column vectors.

    All four of Shepperd's (1978) forms are laid out as rows of 4·q·qᵀ; the row with the largest diagonal is exact
    wherever the others cancel. `RotationError` for matrices that scale, shear or mirror.
    """
    (m,), dtype = _widened((matrix, 3))
    if m.shape[-2:] != (3, 3):
        raise RotationError(f"shape {m.shape} where (..., 3, 3) is needed", where="matrix")
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
    """Rotation matrices (..., 3, 3), acting on column vectors, of unit rotations (..., 4)."""
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
    """Rotations (..., 4) by `angle_rad` (...) about the directions `axis` (..., 3), of any length but zero."""
    (axis,), dtype = _widened((axis, 3))
    half = 0.5 * np.asarray(angle_rad, dtype=np.float64)[..., None]
    return _joined(np.cos(half), _unit(axis, "axis") * np.sin(half)).astype(dtype, copy=False)


def from_rotation_vector(vector: ArrayLike) -> AnyFloats:
    """Rotations (..., 4) about the vectors (..., 3) by their length in radians (the exponential map)."""
    (vector,), dtype = _widened((vector, 3))
    angle = np.linalg.norm(vector, axis=-1, keepdims=True)
    # numpy's sinc is sin(pi x) / (pi x), exact at zero.
    return _joined(np.cos(0.5 * angle), 0.5 * np.sinc(angle / (2.0 * np.pi)) * vector).astype(dtype, copy=False)


def as_rotation_vector(q: ArrayLike) -> AnyFloats:
    """Axis times angle (..., 3), of at most half a turn, of unit rotations (..., 4) (the logarithmic map)."""
    (q,), dtype = _widened((q, 4))
    return _rotation_vector(q).astype(dtype, copy=False)


def angle_between(a: ArrayLike, b: ArrayLike) -> AnyFloats:
    """Angle (...) of the shortest rotation from `a` to `b`, both (..., 4), in 0 to pi."""
    (a, b), dtype = _widened((a, 4), (b, 4))
    turn = _product(a * (1.0, -1.0, -1.0, -1.0), b)
    angle: AnyFloats = 2.0 * np.arctan2(np.linalg.norm(turn[..., 1:], axis=-1), np.abs(turn[..., 0]))
    return angle.astype(dtype, copy=False)


def from_euler(order: str, angles_rad: ArrayLike, *, intrinsic: bool = True) -> AnyFloats:
    """Rotations (..., 4) of angles (..., n) about the n axes named in `order`, one to three letters of x, y and z.

    Intrinsic rotations turn about the axes of the moving frame in the order written, as in the channels of BVH: "zxy"
    is Z·X·Y. Extrinsic ones turn about fixed axes, so that the first letter acts first.
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
    """Angles (..., 3) in radians about three axes, such as "zxy", of unit rotations (..., 4); see `from_euler`.

    The middle angle is in -pi/2 to pi/2, or in 0 to pi where first and last axis are the same. In gimbal lock only the
    sum or the difference of the outer angles is defined: that of the turn that acts first is zero then.

    Notes
    -----
    Bernardes and Viollet (2022): half the sum and half the difference of the outer angles are each one arctangent.
    """
    axes = _euler_axes(order)
    if len(axes) != 3:
        raise RotationError(f"{order!r} names {len(axes)} axes, three are needed", where="order")
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
    """Rotations at fraction `t` (...) of the shorter arc from `a` to `b`, both (..., 4) (Shoemake 1985)."""
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
    """The shortest rotations (..., 4) from directions `start` to directions `end`, both (..., 3).

    Opposite directions have no shortest rotation: those turn half about `half_turn_axis` (..., 3), made perpendicular
    to `start`, or, without one, about the perpendicular next to the coordinate axis that `start` is farthest from.
    `RotationError` where a direction has no length.
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
    """The unit part (..., 3) of `vector` at a right angle to `direction`; `RotationError` where they are parallel."""
    (vector, direction), dtype = _widened((vector, 3), (direction, 3))
    direction = _unit(direction, "direction")
    rest = vector - np.sum(vector * direction, axis=-1, keepdims=True) * direction
    return _unit(rest, "perpendicular part").astype(dtype, copy=False)


def twist_swing(q: ArrayLike, axis: ArrayLike) -> tuple[AnyFloats, AnyFloats]:
    """Unit rotations (..., 4) as twist about the direction `axis` (..., 3), then swing: q = swing · twist.

    The swing's axis is perpendicular to `axis`. A swing of half a turn leaves the twist open; it is none then.
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
    """The same rotations (..., 4) with signs chosen so that neighbours along `axis` (time) are close.

    q and -q are one rotation; the first frame keeps its sign and each next one takes that of the nearer.
    """
    (q,), dtype = _widened((q, 4))
    q = np.moveaxis(q, axis, 0)
    signs = np.ones(q.shape[:-1])
    signs[1:] = np.where(np.sum(q[1:] * q[:-1], axis=-1) < 0.0, -1.0, 1.0)
    return np.moveaxis(q * np.cumprod(signs, axis=0)[..., None], 0, axis).astype(dtype, copy=False)


def angular_velocity(q: ArrayLike, frame_rate_hz: float) -> AnyFloats:
    """Angular velocity (F, ..., 3) in rad/s, in the frame the rotations (F, ..., 4) map to.

    The shortest rotation to the next frame, averaged over both neighbours; at the ends, their linear extrapolation.
    """
    (q,), dtype = _widened((q, 4))
    steps = _rotation_vector(_product(q[1:], q[:-1] * (1.0, -1.0, -1.0, -1.0))) * frame_rate_hz
    return rate_from_steps(steps, len(q)).astype(dtype, copy=False)


def rate_from_steps(steps: Floats, frame_count: int) -> Floats:
    """Rates at frames (F, ...) from those between frames (F - 1, ...): means inside, extrapolated at the ends."""
    rate = np.zeros((frame_count, *steps.shape[1:]))
    if frame_count == 2:
        rate[:] = steps[0]
    elif frame_count > 2:
        rate[1:-1] = 0.5 * (steps[1:] + steps[:-1])
        rate[0] = 1.5 * steps[0] - 0.5 * steps[1]
        rate[-1] = 1.5 * steps[-1] - 0.5 * steps[-2]
    return rate


def _widened(*arguments: tuple[ArrayLike, int]) -> tuple[list[Floats], np.dtype[Any]]:
    """The arguments as float64, their last axis checked, and the floating type the result should have."""
    arrays = [np.asarray(values) for values, _ in arguments]
    for array, (_, size) in zip(arrays, arguments, strict=True):
        if array.ndim == 0 or array.shape[-1] != size:
            raise RotationError(f"shape {array.shape} where (..., {size}) is needed")
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
    """Half a turn about a perpendicular of `start`, then the small turn left from -start to `end`, all (n, 3)."""
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
        raise RotationError(f"the matrix at {index} {kind}, so it is no rotation", where="matrix")


def _euler_axes(order: str) -> tuple[int, ...]:
    axes = tuple("xyz".find(letter) for letter in order.lower())
    if not 1 <= len(axes) <= 3 or -1 in axes or any(a == b for a, b in pairwise(axes)):
        raise RotationError(
            f"{order!r} is no order of axes; write such as 'zxy', no axis twice in a row", where="order"
        )
    return axes
