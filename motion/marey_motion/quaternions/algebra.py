"""Products, interpolation, shortest rotations and rates of unit quaternions."""

from __future__ import annotations

from typing import Any, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from marey_motion.arrays import AnyFloats, Floats
from marey_motion.quaternions.components import TINY, cross, joined, product, rotation_vector, unit, widened

# Length of the unnormalised quaternion between two directions below which its axis loses digits.
NEARLY_OPPOSITE = 0.1


@overload
def identity(*leading: int) -> Floats: ...
@overload
def identity(*leading: int, dtype: type[np.floating[Any]]) -> AnyFloats: ...
def identity(*leading: int, dtype: type[np.floating[Any]] = np.float64) -> AnyFloats:
    """Make identity rotations.

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
    """Multiply quaternions (the Hamilton product a·b): the rotation that applies `b`, then `a`.

    Parameters
    ----------
    a, b : (..., 4)    quaternions; leading axes broadcast

    Returns
    -------
    (..., 4)    the product
    """
    (a, b), dtype = widened((a, 4), (b, 4))
    return product(a, b).astype(dtype, copy=False)


def conjugate(q: ArrayLike) -> AnyFloats:
    """Invert unit quaternions.

    Parameters
    ----------
    q : (..., 4)    unit quaternions

    Returns
    -------
    (..., 4)    the inverse rotations
    """
    (q,), dtype = widened((q, 4))
    return (q * (1.0, -1.0, -1.0, -1.0)).astype(dtype, copy=False)


def normalise(q: ArrayLike) -> AnyFloats:
    """Scale quaternions to unit length.

    Parameters
    ----------
    q : (..., 4)    quaternions of any length but zero

    Returns
    -------
    (..., 4)    unit quaternions

    Raises
    ------
    RotationError    if a quaternion has zero length
    """
    (q,), dtype = widened((q, 4))
    return unit(q, "quaternion").astype(dtype, copy=False)


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
    (q, v), dtype = widened((q, 4), (v, 3))
    return _rotated(q, v).astype(dtype, copy=False)


def angle_between(a: ArrayLike, b: ArrayLike) -> AnyFloats:
    """Compute the angle of the shortest rotation between two rotations.

    Parameters
    ----------
    a, b : (..., 4)    unit quaternions; leading axes broadcast

    Returns
    -------
    (...)    radians, 0 to pi
    """
    (a, b), dtype = widened((a, 4), (b, 4))
    turn = product(a * (1.0, -1.0, -1.0, -1.0), b)
    angle: AnyFloats = 2.0 * np.arctan2(np.linalg.norm(turn[..., 1:], axis=-1), np.abs(turn[..., 0]))
    return angle.astype(dtype, copy=False)


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
    (a, b), dtype = widened((a, 4), (b, 4))
    t = np.asarray(t, dtype=np.float64)[..., None]
    b = np.where(np.sum(a * b, axis=-1, keepdims=True) < 0.0, -b, b)
    # The arc from chord lengths keeps its precision for nearly equal rotations, where arccos of the dot product fails.
    arc = 2.0 * np.arctan2(np.linalg.norm(b - a, axis=-1, keepdims=True), np.linalg.norm(b + a, axis=-1, keepdims=True))
    # sin(s·arc)/sin(arc) written with sinc, so that equal rotations need no case of their own.
    scale = np.sinc(arc / np.pi)
    result = ((1.0 - t) * np.sinc((1.0 - t) * arc / np.pi) * a + t * np.sinc(t * arc / np.pi) * b) / scale
    return unit(result, "quaternion").astype(dtype, copy=False)


def between_vectors(start: ArrayLike, end: ArrayLike, *, half_turn_axis: ArrayLike | None = None) -> AnyFloats:
    """Compute the shortest rotations from one direction to another.

    Opposite directions have no unique shortest rotation. For them, the result is half a turn about the component of
    `half_turn_axis` that is perpendicular to `start`. If `half_turn_axis` is None or parallel to `start`, the
    coordinate axis with the largest angle to `start` is used instead.

    Parameters
    ----------
    start, end : (..., 3)    directions of any length but zero
    half_turn_axis : (..., 3), optional    axis for opposite directions

    Returns
    -------
    (..., 4)    unit quaternions

    Raises
    ------
    RotationError    if a direction has zero length
    """
    (start, end), dtype = widened((start, 3), (end, 3))
    start, end = np.broadcast_arrays(unit(start, "start direction"), unit(end, "end direction"))
    middle = start + end
    # |start + end|² / 2 = 1 + cos(angle), without the cancellation of the right side.
    result = joined(0.5 * np.sum(middle * middle, axis=-1, keepdims=True), cross(start, end))
    opposite = np.linalg.norm(result, axis=-1) < NEARLY_OPPOSITE
    if np.any(opposite):
        turn_axis = None if half_turn_axis is None else np.broadcast_to(half_turn_axis, start.shape)[opposite]
        result[opposite] = _between_opposite(start[opposite], end[opposite], turn_axis)
    return unit(result, "quaternion").astype(dtype, copy=False)


def perpendicular(vector: ArrayLike, direction: ArrayLike) -> AnyFloats:
    """Compute the component of a vector that is perpendicular to a direction, scaled to unit length.

    Parameters
    ----------
    vector, direction : (..., 3)    vectors of any length but zero

    Returns
    -------
    (..., 3)    unit vectors

    Raises
    ------
    RotationError    if `vector` and `direction` are parallel
    """
    (vector, direction), dtype = widened((vector, 3), (direction, 3))
    direction = unit(direction, "direction")
    rest = vector - np.sum(vector * direction, axis=-1, keepdims=True) * direction
    return unit(rest, "perpendicular part").astype(dtype, copy=False)


def twist_swing(q: ArrayLike, axis: ArrayLike) -> tuple[AnyFloats, AnyFloats]:
    """Split rotations into a twist about an axis and a swing: q = swing · twist.

    The swing's axis is perpendicular to `axis`. If the swing is half a turn, the twist is not determined, and the
    identity is returned as the twist.

    Parameters
    ----------
    q : (..., 4)    unit quaternions
    axis : (..., 3)    directions of any length but zero

    Returns
    -------
    twist, swing : (..., 4) each    unit quaternions
    """
    (q, axis), dtype = widened((q, 4), (axis, 3))
    axis = unit(axis, "axis")
    along = np.sum(q[..., 1:] * axis, axis=-1, keepdims=True)
    twist = joined(q[..., :1], along * axis)
    length = np.linalg.norm(twist, axis=-1, keepdims=True)
    twist = np.where(length > TINY, twist / np.maximum(length, TINY), (1.0, 0.0, 0.0, 0.0))
    swing = product(q, twist * (1.0, -1.0, -1.0, -1.0))
    return twist.astype(dtype, copy=False), swing.astype(dtype, copy=False)


def unroll(q: ArrayLike, axis: int = 0) -> AnyFloats:
    """Choose the signs of quaternions so that neighbours in time are close.

    q and -q are the same rotation. The first frame keeps its sign, and each later frame gets the sign with which it is
    nearer to the frame before.

    Parameters
    ----------
    q : (..., 4)    quaternions
    axis : int    axis of time

    Returns
    -------
    (..., 4)    the same rotations
    """
    (q,), dtype = widened((q, 4))
    q = np.moveaxis(q, axis, 0)
    signs = np.ones(q.shape[:-1])
    signs[1:] = np.where(np.sum(q[1:] * q[:-1], axis=-1) < 0.0, -1.0, 1.0)
    return np.moveaxis(q * np.cumprod(signs, axis=0)[..., None], 0, axis).astype(dtype, copy=False)


def angular_velocity(q: ArrayLike, frame_rate_hz: float) -> AnyFloats:
    """Differentiate rotations over time.

    The shortest rotation from each frame to the next gives a rate for the time between them. The result at a frame is
    the mean of the rates before and after it; for the first and last frame, the rates are extrapolated linearly.

    Parameters
    ----------
    q : (F, ..., 4)    unit quaternions
    frame_rate_hz : float    frames per second

    Returns
    -------
    (F, ..., 3)    radians per second, in the frame that the rotations map to
    """
    (q,), dtype = widened((q, 4))
    steps = rotation_vector(product(q[1:], q[:-1] * (1.0, -1.0, -1.0, -1.0))) * frame_rate_hz
    return rate_from_steps(steps, len(q)).astype(dtype, copy=False)


def rate_from_steps(steps: Floats, frame_count: int) -> Floats:
    """Compute rates at frames from rates between frames: means of adjacent rates, and linear extrapolation at the ends.

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


def _rotated(q: Floats, v: Floats) -> Floats:
    twice = 2.0 * cross(q[..., 1:], v)
    return v + q[..., :1] * twice + cross(q[..., 1:], twice)


def _between_opposite(start: Floats, end: Floats, turn_axis: NDArray[Any] | None) -> Floats:
    """Find rotations (n, 4) from `start` (n, 3) to nearly opposite unit vectors `end` (n, 3).

    Each is half a turn about an axis perpendicular to `start`, then the small rotation from the opposite of `start` to
    `end`. `turn_axis` (..., 3) gives the axis of the half turn where `start` and `end` are exactly opposite; it may be
    None.
    """
    candidates = [cross(start, end), np.eye(3)[np.argmin(np.abs(start), axis=-1)]]
    if turn_axis is not None:
        candidates.insert(1, np.asarray(turn_axis, dtype=np.float64))
    axis = np.zeros_like(start)
    for candidate in reversed(candidates):
        across = candidate - np.sum(candidate * start, axis=-1, keepdims=True) * start
        axis = np.where(np.linalg.norm(across, axis=-1, keepdims=True) > TINY, across, axis)
    rest = joined(1.0 - np.sum(start * end, axis=-1, keepdims=True), cross(-start, end))
    return product(unit(rest, "quaternion"), joined(np.zeros(1), unit(axis, "axis")))
