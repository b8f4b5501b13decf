"""Vectors and rotations (w, x, y, z) as tuples, for kernels that turn one joint at a time."""

from __future__ import annotations

import math

from marey_motion.kernels import compiled, product

# Below this length a direction is rounding noise.
TINY = 1e-12


@compiled
def vector_at(array, row):
    return array[row, 0], array[row, 1], array[row, 2]


@compiled
def rotation_at(array, row):
    return array[row, 0], array[row, 1], array[row, 2], array[row, 3]


@compiled
def put_vector(array, row, v):
    array[row, 0], array[row, 1], array[row, 2] = v


@compiled
def plus(a, b):
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


@compiled
def minus(a, b):
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@compiled
def scaled(a, factor):
    return a[0] * factor, a[1] * factor, a[2] * factor


@compiled
def dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@compiled
def cross(a, b):
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@compiled
def length(a):
    return math.sqrt(dot(a, a))


@compiled
def direction(a):
    """Compute the unit vector along `a`; the zero vector if `a` is zero."""
    size = length(a)
    return scaled(a, 1.0 / size) if size > TINY else (0.0, 0.0, 0.0)


@compiled
def perpendicular(a):
    """Compute a unit vector perpendicular to `a`, from the coordinate axis with the largest angle to `a`."""
    x, y, z = abs(a[0]), abs(a[1]), abs(a[2])
    axis = (1.0, 0.0, 0.0)
    if y <= x and y <= z:
        axis = (0.0, 1.0, 0.0)
    elif z < x:
        axis = (0.0, 0.0, 1.0)
    return direction(cross(a, axis))


@compiled
def unit(q):
    size = 1.0 / math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    return q[0] * size, q[1] * size, q[2] * size, q[3] * size


@compiled
def rotated(q, v):
    axis = (q[1], q[2], q[3])
    twice = scaled(cross(axis, v), 2.0)
    return plus(plus(v, scaled(twice, q[0])), cross(axis, twice))


@compiled
def exponential(v):
    """Compute the rotation about the axis `v` by an angle that is the length of `v`, in radians."""
    half = 0.5 * length(v)
    share = 0.5 * math.sin(half) / half if half > 1e-8 else 0.5
    return math.cos(half), v[0] * share, v[1] * share, v[2] * share


@compiled
def logarithm(q):
    """Compute the rotation vector (axis times angle, at most π) of a rotation."""
    sign = -1.0 if q[0] < 0.0 else 1.0
    v = (sign * q[1], sign * q[2], sign * q[3])
    sine = length(v)
    share = 2.0 * math.atan2(sine, sign * q[0]) / sine if sine > TINY else 2.0
    return scaled(v, share)


@compiled
def between(a, b):
    """Compute the shortest rotation from unit vector `a` to unit vector `b`; the identity if one of them is zero."""
    if dot(a, a) < 0.5 or dot(b, b) < 0.5:
        return 1.0, 0.0, 0.0, 0.0
    middle = plus(a, b)
    w = 0.5 * dot(middle, middle)
    if w > 1e-9:
        x, y, z = cross(a, b)
        return unit((w, x, y, z))
    # Opposite vectors: half a turn about any perpendicular, then the remaining rotation.
    i, j, k = perpendicular(a)
    x, y, z = cross(b, a)
    return product(unit((1.0 - dot(a, b), x, y, z)), (0.0, i, j, k))


@compiled
def twist_angle(q, axis):
    """Compute the angle, in radians from -π to π, by which the rotation `q` turns about the unit vector `axis`.

    `q` is decomposed into swing · twist, where the twist is a rotation about the axis.
    """
    angle = 2.0 * math.atan2(dot((q[1], q[2], q[3]), axis), q[0])
    if angle > math.pi:
        angle -= 2.0 * math.pi
    return angle + 2.0 * math.pi if angle < -math.pi else angle


@compiled
def about(axis, angle):
    """Compute the quaternion (w, x, y, z), as a tuple, of the rotation about a unit vector by an angle in radians."""
    sine = math.sin(0.5 * angle)
    return math.cos(0.5 * angle), axis[0] * sine, axis[1] * sine, axis[2] * sine
