"""Rotations added to single joints."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np

from marey_motion import kinematics, quaternions
from marey_motion.editing.borders import range_weights
from marey_motion.editing.take import Take


def rotate_joint(
    take: Take,
    *,
    joint: str,
    angle_rad: float,
    axis: Sequence[float],
    space: Literal["joint", "parent", "world"] = "joint",
    frames: tuple[int, int | None] | None = None,
    border_s: float = 0.2,
) -> Take:
    """Turn a joint by an angle about an axis in its own, its parent's or the world's axes, growing over the borders.

    Raises `UnknownJoint`, and `EditError` where the frames are not there.
    """
    index = take.joint(joint)
    span, shares = range_weights(take, frames, border_s)
    turns = quaternions.from_axis_angle(axis, angle_rad * shares)
    rotations = take.motion.rotations.copy()
    if space == "joint":
        rotations[span, index] = quaternions.multiply(rotations[span, index], turns)
        return take.moved(take.motion._replace(rotations=rotations))
    parent = int(take.skeleton.parents[index])
    if space == "world" and parent >= 0:
        frame = kinematics.as_global_rotations(take.skeleton, rotations[span])[:, parent]
        turns = quaternions.multiply(quaternions.conjugate(frame), quaternions.multiply(turns, frame))
    rotations[span, index] = quaternions.multiply(turns, rotations[span, index])
    return take.moved(take.motion._replace(rotations=np.ascontiguousarray(rotations)))
