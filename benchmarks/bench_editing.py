"""Edits of 10,000 frames: the time of each command, for some commands compared with a function of scipy."""

from __future__ import annotations

from collections.abc import Callable
from math import degrees
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import savgol_filter
from scipy.spatial.transform import Rotation, Slerp

from benchmarks.timing import Row, time_in_turn
from marey_motion.clip import Clip
from marey_motion.editing.registry import edit_clip
from marey_motion.gait import generate_gait
from marey_schemas.editing.commands import (
    CloseLoop,
    Concatenate,
    Face,
    FindContacts,
    FixDrift,
    FlipAxes,
    Mirror,
    MoveToGround,
    MoveToOrigin,
    Paste,
    Resample,
    Retime,
    Rotate,
    RotateJoint,
    Scale,
    Smooth,
    Split,
    Translate,
    Trim,
)
from marey_schemas.editing.edits import AnyCommand

FRAMES, RATE_HZ = 10_000, 60.0
MOST_MS = 500
"""Longest response to a moved slider that feels immediate, for nearly three minutes of motion."""

ARM = ("LeftArm", "LeftForeArm", "LeftHand")
COMMANDS: tuple[AnyCommand, ...] = (
    Trim(start=100),
    Split(at=[2500, 5000, 7500]),
    Concatenate(source="run"),
    Resample(frame_rate_hz=45.0),
    Retime(speed=0.9),
    CloseLoop(),
    Translate(shift_m=(1.0, 0.0, 0.0)),
    Rotate(angle_deg=degrees(0.5)),
    Face(),
    MoveToOrigin(),
    Scale(factor=1.1),
    FlipAxes(up="+z", forward="-y"),
    FixDrift(shift_m=(0.3, 0.0, 0.1), turn_deg=degrees(0.2)),
    MoveToGround(),
    FindContacts(),
    Mirror(),
    Smooth(),
    Smooth(method="gaussian"),
    RotateJoint(joint="LeftArm", axis=(0.0, 1.0, 0.0), angle_deg=degrees(0.3), space="world"),
    Paste(source="run", joints=ARM),
)


def run() -> list[Row]:
    """Measure every command as users call it: from clip to clip, in single precision, checked before and after."""
    walk = generate_gait(1.3, 0.1, FRAMES / RATE_HZ, RATE_HZ)
    run_clip = generate_gait(3.0, -0.2, 20.0, RATE_HZ)
    rows = [_alone(walk, run_clip, command) for command in COMMANDS]
    return [*rows, *(_beside(walk, *peer) for peer in _peers(walk))]


def _edit(walk: Clip, *commands: AnyCommand, **sources: Clip) -> Clip:
    return edit_clip(walk, commands, sources=sources)[0].clip


def _alone(walk: Clip, run_clip: Clip, command: AnyCommand) -> Row:
    (ours,) = time_in_turn(lambda: _edit(walk, command, run=run_clip), repeats=5)
    told: str = command.command
    if isinstance(command, Smooth) and "method" in command.model_fields_set:
        told = f"{told} ({command.method})"
    return Row(
        f"edit: {told}",
        f"{walk.frame_count:,} frames x {walk.skeleton.joint_count} joints",
        ours.shown(1e3, "ms"),
        goal=f"≤ {MOST_MS} ms",
        met=ours.median_s * 1e3 <= MOST_MS,
    )


def _beside(walk: Clip, name: str, peer: str, command: AnyCommand, theirs: Callable[[], Any]) -> Row:
    ours, other = time_in_turn(lambda: _edit(walk, command), theirs, repeats=5)
    ratio = other.median_s / ours.median_s
    return Row(
        f"edit: {name}",
        f"{walk.frame_count:,} frames x {walk.skeleton.joint_count} joints",
        ours.shown(1e3, "ms"),
        f"{peer} {other.shown(1e3, 'ms')}",
        ratio,
    )


def _peers(walk: Clip) -> list[tuple[str, str, AnyCommand, Callable[[], Any]]]:
    """Return the edits that scipy can also do: name, function of scipy, our command, and a call of the function.

    The calls convert from and to single precision. The filter of scipy smooths each quaternion component separately:
    it ignores sign changes of quaternions, and it does not keep the first and the last frame.
    """

    def slerped() -> list[NDArray[np.float32]]:
        rotations = walk.rotations.astype(np.float64)
        places = np.arange(0.0, walk.frame_count - 1, RATE_HZ / 45.0)
        frames = np.arange(walk.frame_count, dtype=np.float64)
        joints = (Rotation.from_quat(rotations[:, joint], scalar_first=True) for joint in range(rotations.shape[1]))
        return [Slerp(frames, one)(places).as_quat(scalar_first=True).astype(np.float32) for one in joints]

    def filtered() -> NDArray[np.float32]:
        means = np.asarray(savgol_filter(walk.poses.astype(np.float64), 15, 3, axis=0))
        rotations = means[:, 3:].reshape(walk.frame_count, -1, 4)
        rotations /= np.linalg.norm(rotations, axis=-1, keepdims=True)
        return means.astype(np.float32)

    return [
        ("resample, cubic beside slerp", "scipy Slerp", Resample(frame_rate_hz=45.0), slerped),
        ("smooth", "scipy savgol_filter, normalised", Smooth(), filtered),
    ]
