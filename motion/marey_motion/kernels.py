"""Compiler options and rotation arithmetic that every compiled function shares.

Only modules of compiled functions (kernels) import this module, because the import loads numba. A compiled caller
contains a copy of the functions of this module that it calls, so `marey_motion.warm_up` discards all compiled code when
this module changes.

Rotations are quaternions (w, x, y, z), given as tuples or as rows of an array. Stored results depend on the order of
the operations, because another order rounds differently.
"""

from __future__ import annotations

from functools import partial

from numba import njit

_options = partial(njit, cache=True, nogil=True, boundscheck=False, error_model="numpy")

compiled = _options()
# Fused multiply-add is the only deviation from IEEE arithmetic.
contracted = _options(fastmath={"contract"})
# For functions with so many arguments that a call costs as much as their work.
inlined = _options(forceinline=True)
contracted_inlined = _options(forceinline=True, fastmath={"contract"})


@_options(inline="always")
def product(a, b):
    """Return the rotation that applies `b`, then `a`.

    The function is inlined before types are inferred, so that the caller's options for floating-point arithmetic, such
    as fused multiply-add, also apply to this function.
    """
    return (
        a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
        a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
        a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
        a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
    )


@compiled
def put_rotation(array, row, q):
    """Write a quaternion to a row of an array."""
    array[row, 0], array[row, 1], array[row, 2], array[row, 3] = q


@compiled
def inverse(q):
    """Return the inverse of a unit quaternion."""
    return q[0], -q[1], -q[2], -q[3]


@compiled
def rotate_vector(q, x, y, z):
    """Rotate the vector (x, y, z) by a unit quaternion."""
    tx = 2.0 * (q[2] * z - q[3] * y)
    ty = 2.0 * (q[3] * x - q[1] * z)
    tz = 2.0 * (q[1] * y - q[2] * x)
    return (
        x + q[0] * tx + q[2] * tz - q[3] * ty,
        y + q[0] * ty + q[3] * tx - q[1] * tz,
        z + q[0] * tz + q[1] * ty - q[2] * tx,
    )
