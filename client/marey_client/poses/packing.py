"""Compact form of poses for pages that play motion without a server; `web/src/motion/packed.ts` reads it.

Rotations become rotation vectors of 15 bits per component, and lengths become multiples of `LENGTH_STEP_M`. Each
channel is stored as differences between frames, in byte planes, deflated. The greatest error is 0.01 degrees per
joint, and 0.025 mm per axis of the root, if the root stays within 100 km of the origin.
"""

from __future__ import annotations

import math
import zlib
from base64 import b64encode
from typing import Any

import numpy as np
from numpy.typing import NDArray

from marey_schemas.documents.clips import MotionDocument

ANGLE_STEP_RAD = math.pi / 16383
"""Quantisation step of rotation vectors, whose components are at most pi. The error of a rotation is at most
sqrt(3) / 2 steps, because the angle between two rotations is at most the length of the difference of their vectors."""
LENGTH_STEP_M = 5e-5
"""Usual quantisation step of lengths; lengths beyond 100 km, such as geographical ones, need a greater step."""
_GREATEST_STEPS = 2**31 - 1
_ANGLE_BYTES = 2
_LENGTH_BYTES = 4


def pack_motion(motion: MotionDocument) -> dict[str, Any]:
    """Return frame rate, joints and packed arrays of a motion, as members of a JSON object."""
    frames = len(motion.poses)
    rotations = motion.poses[:, 3:].reshape(frames, -1, 4)
    moved = motion.translations
    lengths = (
        motion.poses[:, :3] if moved is None else np.concatenate((motion.poses[:, :3], moved.reshape(frames, -1)), 1)
    )
    step_m = max(LENGTH_STEP_M, float(np.abs(lengths).max(initial=0.0)) / _GREATEST_STEPS)
    return {
        "frame_rate_hz": motion.frame_rate_hz,
        "frames": frames,
        "joints": list(motion.joints),
        "translated_joints": list(motion.translated_joints),
        "angle_step_rad": ANGLE_STEP_RAD,
        "length_step_m": step_m,
        "rotations": _packed(rotation_vectors(rotations).reshape(frames, -1) / ANGLE_STEP_RAD, _ANGLE_BYTES),
        "lengths": _packed(lengths.astype(np.float64) / step_m, _LENGTH_BYTES),
    }


def rotation_vectors(quaternions: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return rotation vectors, (..., 3) in radians and at most pi long, of unit quaternions (..., 4) w, x, y, z."""
    q = quaternions.astype(np.float64)
    q = q * np.where(q[..., :1] < 0, -1.0, 1.0)
    sine = np.linalg.norm(q[..., 1:], axis=-1, keepdims=True)
    angle = 2 * np.arctan2(sine, q[..., :1])
    return q[..., 1:] * np.divide(angle, sine, out=np.full_like(angle, 2.0), where=sine > 0)


def _packed(values: NDArray[np.float64], width: int) -> str:
    """Pack `values`, (frames, channels) in quantisation steps, into base64 text.

    The numbers are rounded, replaced by differences between frames, split into byte planes, and deflated.

    Integers wrap around, so that differences need no more bytes than the numbers themselves.
    """
    integers = np.rint(values).astype(f"<i{width}").T
    steps = np.diff(integers, axis=1, prepend=integers.dtype.type(0))
    folded = (steps << 1) ^ (steps >> (8 * width - 1))  # small numbers of both signs become small unsigned ones
    planes = np.ascontiguousarray(folded).view(np.uint8).reshape(-1, width).T
    return b64encode(zlib.compress(planes.tobytes(), 9)).decode("ascii")
