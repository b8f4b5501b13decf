"""Writer of BVH.

The root and every joint with translations have six channels, positions before rotations; all other joints have three
rotation channels. This is the most common layout. Positions replace offsets, as most readers expect.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from marey_motion.clip import Clip
from marey_motion.errors import FormatError
from marey_motion.formats.euler import euler_from_rotations
from marey_motion.formats.frame_times import frame_time_to_write
from marey_motion.importing.source import SourceInfo
from marey_motion.importing.units import unit_in_metres
from marey_motion.kernels import compiled
from marey_motion.kinematics import global_positions
from marey_motion.skeleton import Skeleton
from marey_schemas.formats import DEFAULT_UNIT

DEFAULT_ORDER = "zxy"
_DECIMALS = 6
_LARGEST = 1e12


def write_bvh(
    clip: Clip,
    *,
    unit: str | float = DEFAULT_UNIT,
    rotation_order: str = DEFAULT_ORDER,
    source: SourceInfo | None = None,
    fold_positions: bool = False,
) -> bytes:
    """Write a clip as BVH, Y up.

    Parameters
    ----------
    clip : Clip    F frames
    unit : str or float    unit of length by name ("cm", "m", "inch", …) or in metres
    rotation_order : str    order of the rotations, outermost first; used for joints that have no order in `source`
    source : SourceInfo, optional    record of the file from which the clip was imported; joints of this file keep their
        rotation orders
    fold_positions : bool    give positions to the root alone (see `with_folded_positions`), for programs that ignore
        positions of other joints

    Returns
    -------
    bytes    content of the file

    Raises
    ------
    FormatError    if a length in that unit has more than twelve digits before the decimal point, if the frame rate is
        less than 1 Hz or more than 100 kHz, or if `rotation_order` does not contain x, y and z once each
    MotionError    if the name of the unit is not known, or its length is not positive
    """
    if fold_positions:
        clip = with_folded_positions(clip)
    order = _depth_first(clip.skeleton)
    axes = np.array([_axes_of(clip.skeleton, joint, rotation_order, source) for joint in order])
    scale = 1.0 / unit_in_metres(unit)
    lines = _hierarchy(clip, order, axes, scale)
    lines += ["MOTION", f"Frames: {clip.frame_count}", f"Frame Time: {frame_time_to_write(clip.frame_rate_hz)!r}", ""]
    return "\n".join(lines).encode() + format_table(_channel_values(clip, order, axes, scale))


def with_folded_positions(clip: Clip) -> Clip:
    """Make a clip in which only the root is translated.

    Some exporters write the path of the body to the hips, below a root that does not move. If a translated joint has
    more than half of all joints at or below it, the root takes over the motion of this joint. The joint and the joints
    below it stay exactly in place, but the root and all other joints move. If several joints meet the condition, the
    one nearest to the root is chosen. Every other translated joint gets its median translation as a constant offset. If
    its translation varied, it and the joints below it are displaced by the difference.

    Parameters
    ----------
    clip : Clip    F frames, any translated joints

    Returns
    -------
    Clip    F frames without translations; its skeleton contains the constant offsets
    """
    if clip.translations is None:
        return clip
    skeleton = clip.skeleton
    offsets = skeleton.offsets.copy()
    carrier = _carrier(skeleton, clip.translated_joints)
    for slot, joint in enumerate(clip.translated_joints):
        if joint != carrier:
            offsets[joint] = np.median(clip.translations[:, slot].astype(np.float64), axis=0)
    still = Clip(replace(skeleton, offsets=offsets), clip.frame_rate_hz, clip.poses)
    if carrier is None:
        return still
    poses = clip.poses.copy()
    poses[:, :3] += global_positions(clip)[:, carrier] - global_positions(still)[:, carrier]
    return replace(still, poses=poses)


def _carrier(skeleton: Skeleton, translated: tuple[int, ...]) -> int | None:
    """Return the translated joint nearest to the root with more than half of the joints at or below it, or None."""
    below: NDArray[np.int64] = np.ones(skeleton.joint_count, np.int64)
    for joint in range(skeleton.joint_count - 1, 0, -1):
        below[skeleton.parents[joint]] += below[joint]
    return next((joint for joint in translated if 2 * below[joint] > skeleton.joint_count), None)


def _axes_of(skeleton: Skeleton, joint: int, rotation_order: str, source: SourceInfo | None) -> list[int]:
    if source is not None and len(source.channels) == skeleton.joint_count:
        turns = [name[0].lower() for name in source.channels[joint] if name.endswith("rotation")]
        if len(turns) == 3:
            rotation_order = "".join(turns)
    if sorted(rotation_order.lower()) != ["x", "y", "z"]:
        raise FormatError(
            f"the rotation order {rotation_order!r} must contain x, y and z once each, such as 'zxy'",
            code="rotation-order",
        )
    return ["xyz".index(axis) for axis in rotation_order.lower()]


def _depth_first(skeleton: Skeleton) -> list[int]:
    """List the indices of the joints in depth-first order; the children of a joint keep their order."""
    order, waiting = [], [0]
    while waiting:
        joint = waiting.pop()
        order.append(joint)
        waiting.extend(reversed(skeleton.children[joint]))
    return order


def _hierarchy(clip: Clip, order: list[int], axes: NDArray[np.int64], scale: float) -> list[str]:
    skeleton = clip.skeleton
    tips: dict[int, list[NDArray[np.float64]]] = {}
    for site in skeleton.end_sites:
        tips.setdefault(site.joint, []).append(site.offset)
    lines, depths = ["HIERARCHY"], {-1: -1}
    open_joints: list[int] = []
    for joint, turns in zip(order, axes, strict=True):
        parent = int(skeleton.parents[joint])
        while open_joints and open_joints[-1] != parent:
            lines.append("\t" * depths[open_joints.pop()] + "}")
        depth = depths[joint] = depths[parent] + 1
        open_joints.append(joint)
        tab = "\t" * depth
        names = [f"{axis}position" for axis in "XYZ"] if joint == 0 or joint in clip.translated_joints else []
        names += [f"{'XYZ'[axis]}rotation" for axis in turns]
        lines += [
            f"{tab}{'JOINT' if depth else 'ROOT'} {_written_name(skeleton.display_names[joint])}",
            f"{tab}{{",
            f"{tab}\tOFFSET {_written_offset(skeleton.offsets[joint], scale)}",
            f"{tab}\tCHANNELS {len(names)} {' '.join(names)}",
        ]
        for tip in tips.get(joint, ()):
            lines += [f"{tab}\tEnd Site", f"{tab}\t{{", f"{tab}\t\tOFFSET {_written_offset(tip, scale)}", f"{tab}\t}}"]
    lines += ["\t" * depths[joint] + "}" for joint in reversed(open_joints)]
    return lines


def _written_name(name: str) -> str:
    """Return a joint name with underscores in place of the characters that BVH does not allow."""
    return "".join("_" if character in "{}\n\r" else character for character in name)


def _written_offset(offset: NDArray[np.float64], scale: float) -> str:
    return " ".join(f"{value * scale + 0.0:.10g}" for value in offset)


def _channel_values(clip: Clip, order: list[int], axes: NDArray[np.int64], scale: float) -> NDArray[np.float64]:
    """Compute the numbers (F, C) of the file: the values of all channels, with the joints in the order `order`.

    `axes` are the axes of the rotations of each joint; lengths are multiplied by `scale`.
    """
    angles_deg = np.empty((clip.frame_count, len(order), 3))
    euler_from_rotations(np.ascontiguousarray(clip.rotations[:, order]), axes, angles_deg)
    columns: list[NDArray[np.float64]] = []
    for index, joint in enumerate(order):
        if joint == 0:
            columns.append(clip.root_translations.astype(np.float64) * scale)
        elif clip.translations is not None and joint in clip.translated_joints:
            slot = clip.translated_joints.index(joint)
            columns.append(clip.translations[:, slot].astype(np.float64) * scale)
        columns.append(angles_deg[:, index])
    return np.concatenate(columns, axis=1)


def format_table(values: NDArray[np.float64]) -> bytes:
    """Format lines of numbers with six decimals, separated by spaces.

    Parameters
    ----------
    values : (F, C) float64    the numbers

    Returns
    -------
    bytes    F lines

    Raises
    ------
    FormatError    if a number has more than twelve digits before the decimal point
    """
    largest = float(np.abs(values).max(initial=0.0))
    if not largest < _LARGEST:
        raise FormatError(
            f"the value {largest:.3g} is too large to be written to a BVH file; choose a larger unit of length",
            code="value-range",
        )
    widest = len(str(int(largest))) + _DECIMALS + 3
    text = np.empty(values.size * widest, np.uint8)
    return text[: _format(values, text)].tobytes()


@compiled
def _format(values, text):
    """Fill `text` (bytes,) with `values` (F, C) as F lines of decimal numbers; return the number of bytes written."""
    digits = np.empty(24, np.uint8)
    at = 0
    for frame in range(values.shape[0]):
        for column in range(values.shape[1]):
            rest = np.int64(np.rint(abs(values[frame, column]) * 1e6))
            if values[frame, column] < 0 and rest > 0:
                text[at] = 45
                at += 1
            count = 0
            while rest > 0 or count <= _DECIMALS:
                digits[count] = 48 + rest % 10
                rest //= 10
                count += 1
            for k in range(count - 1, -1, -1):
                text[at] = digits[k]
                at += 1
                if k == _DECIMALS:
                    text[at] = 46
                    at += 1
            text[at] = 10 if column == values.shape[1] - 1 else 32
            at += 1
    return at
