"""Rotations as unit quaternions (w, x, y, z).

Components are on the last axis; any leading axes broadcast. Arithmetic is done in float64 and the result has the
floating type of the arguments (float32 in, float32 out). Angles are radians. A rotation acts on column vectors, so
`multiply(a, b)` applies `b` first. Functions named `from_…` convert another form of rotations to quaternions; functions
named `as_…` convert quaternions to another form.
"""

from __future__ import annotations

from marey_motion.quaternions.algebra import (
    NEARLY_OPPOSITE,
    angle_between,
    angular_velocity,
    between_vectors,
    conjugate,
    identity,
    multiply,
    normalise,
    perpendicular,
    rate_from_steps,
    rotate_vectors,
    slerp,
    twist_swing,
    unroll,
)
from marey_motion.quaternions.components import TINY
from marey_motion.quaternions.conversions import (
    EULER_BLOCK,
    as_euler,
    as_matrix,
    as_rotation_vector,
    from_axis_angle,
    from_euler,
    from_matrix,
    from_rotation_vector,
)

__all__ = [
    "EULER_BLOCK",
    "NEARLY_OPPOSITE",
    "TINY",
    "angle_between",
    "angular_velocity",
    "as_euler",
    "as_matrix",
    "as_rotation_vector",
    "between_vectors",
    "conjugate",
    "from_axis_angle",
    "from_euler",
    "from_matrix",
    "from_rotation_vector",
    "identity",
    "multiply",
    "normalise",
    "perpendicular",
    "rate_from_steps",
    "rotate_vectors",
    "slerp",
    "twist_swing",
    "unroll",
]
