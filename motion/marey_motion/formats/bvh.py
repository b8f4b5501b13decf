"""Reader of BVH (Biovision hierarchy); the writer is in `bvh_writer`.

Rotations are intrinsic, in degrees, in the order of a joint's CHANNELS; a joint may have up to three rotation
channels, before or after its position channels. A position channel replaces the joint's OFFSET on its axis.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from marey_motion.errors import FormatError
from marey_motion.formats.bvh_hierarchy import BvhHeader, read_header
from marey_motion.formats.bvh_writer import write_bvh
from marey_motion.formats.euler import NO_COLUMN, rotations_from_euler
from marey_motion.formats.frame_times import frame_rate_of
from marey_motion.formats.joint_names import unique_names
from marey_motion.formats.numeric_text import BadNumber, scan_numbers
from marey_motion.formats.text_lines import TextLines, number_problem
from marey_motion.formats.unpacking import require_unpackable
from marey_motion.importing.checks import CheckWarning
from marey_motion.importing.source import SourceMotion
from marey_schemas.wording import counted

__all__ = ["read_bvh", "write_bvh"]

FORMAT = "bvh"
# Offsets and positions of the same joint agree to this part of the largest offset where exporters rounded both.
_PRINTED_DIGITS = 1e-6
_LARGEST_ANGLE_DEG = 2.0**53
"""Above this angle, 64-bit numbers are more than a degree apart."""


@dataclass(frozen=True)
class ChannelColumns:
    """Column of each channel in the table of numbers.

    `turns` and `axes` (J, 3) are the column and the axis of each joint's rotations; `positions` (J, 3) are the columns
    of x, y and z. `NO_COLUMN` marks a channel that the joint lacks. `labels` are names of the columns, for messages.
    """

    turns: NDArray[np.int64]
    axes: NDArray[np.int64]
    positions: NDArray[np.int64]
    labels: tuple[tuple[int, str], ...]


def read_bvh(data: bytes, file: str, *, frame_rate_hz: float | None = None) -> SourceMotion:
    """Read a BVH file in its own unit and axes.

    Parameters
    ----------
    data : bytes    content of the file
    file : str    name of the file, for messages
    frame_rate_hz : float, optional    replaces the rate computed from the file's Frame Time

    Returns
    -------
    SourceMotion    F frames of J joints; a source without motion if the file contains no frames

    Raises
    ------
    FormatError    if the file is invalid; the error names the line, and the joint if there is one
    """
    lines = TextLines(data, file)
    header = read_header(lines)
    channels = tuple(names or () for names in header.channels)
    warnings: list[CheckWarning] = []
    values = _read_frames(header, channel_columns(channels), lines, warnings)
    offsets = np.array(header.offsets, np.float64)
    source = SourceMotion(
        format=FORMAT,
        joint_names=unique_names(header.names, header.parents),
        display_names=tuple(header.names),
        parents=np.array(header.parents, np.int32),
        offsets=offsets,
        rest_rotations=np.tile([1.0, 0.0, 0.0, 0.0], (len(offsets), 1)),
        end_sites=tuple((joint, np.array(offset)) for joint, offset in header.end_sites),
        channels=channels,
        warnings=warnings,
        declared_frame_time_s=header.frame_time_s,
    )
    if len(values):
        require_unpackable(len(values), len(offsets), values.size, file)
        _require_directions(source, values, channel_columns(channels), file)
        _fill_motion(source, values, channel_columns(channels))
        source.frame_rate_hz = frame_rate_hz or frame_rate_of(header.frame_time_s, file, warnings)
    return source


@lru_cache(maxsize=64)
def channel_columns(channels: tuple[tuple[str, ...], ...]) -> ChannelColumns:
    """Assign the channels of all joints to the columns of a line of numbers.

    Parameters
    ----------
    channels : tuple of tuples of str    names of each joint's channels

    Returns
    -------
    ChannelColumns    columns of turns and positions
    """
    shape = (len(channels), 3)
    turns, axes, positions = np.full(shape, NO_COLUMN), np.zeros(shape, np.int64), np.full(shape, NO_COLUMN)
    labels: list[tuple[int, str]] = []
    for joint, names in enumerate(channels):
        turn = 0
        for name in names:
            axis = "XYZ".index(name[0])
            if name.endswith("rotation"):
                turns[joint, turn], axes[joint, turn] = len(labels), axis
                turn += 1
            else:
                positions[joint, axis] = len(labels)
            labels.append((joint, name))
    return ChannelColumns(turns, axes, positions, tuple(labels))


def _read_frames(
    header: BvhHeader, columns: ChannelColumns, lines: TextLines, warnings: list[CheckWarning]
) -> NDArray[np.float64]:
    """Read the values (F, C) of all channels in all frames; `warnings` receives a warning about an unusual layout."""
    width = len(columns.labels)
    text = np.frombuffer(lines.data, np.uint8, offset=min(header.data_start, len(lines.data)))
    try:
        table = scan_numbers(text, width, header.data_line)
    except BadNumber as bad:
        lines.number = bad.line
        joint, channel = columns.labels[bad.index % width] if width else (0, "value")
        raise lines.error(
            f"{channel}: {number_problem(bad.token)}", code="bad-number", joint=header.names[joint]
        ) from None
    frames, rest = divmod(table.values.size, width) if width else (0, table.values.size)
    wrapped = table.ragged_line > 0
    if rest or (wrapped and frames != header.declared_frames):
        lines.number = table.ragged_line
        cut = table.ragged_line == table.last_line and table.ragged_count < width
        raise lines.error(
            f"the line has {counted(table.ragged_count, 'value')}, but the file declares {width} channels"
            + ("; the file is cut off in its last line, so copy or export it again" if cut else ""),
            code="file-truncated" if cut else "frame-width",
        )
    if frames == 0 and header.declared_frames:
        lines.number = header.data_line
        declared = counted(header.declared_frames, "frame")
        raise lines.error(
            f"the header declares {declared}, but the file contains no frames; copy or export it again",
            code="file-truncated",
        )
    _warn_of_layout(header, frames, wrapped, warnings)
    return table.values.reshape(frames, width) if frames else np.empty((0, width))


def _warn_of_layout(header: BvhHeader, frames: int, wrapped: bool, warnings: list[CheckWarning]) -> None:
    if frames != header.declared_frames:
        warnings.append(
            CheckWarning(
                "frame-count-mismatch",
                f"the header declares {counted(header.declared_frames, 'frame')}, but the file contains {frames:,}, "
                "which were read",
                values={"declared": header.declared_frames, "found": frames},
            )
        )
    if wrapped:
        message = "frames are divided into several lines; the lines were joined by counting values"
        warnings.append(CheckWarning("frames-wrapped", message))
    if frames == 0:
        warnings.append(CheckWarning("no-frames", "the file contains no frames; only its skeleton was read"))


def _require_directions(source: SourceMotion, values: NDArray[np.float64], columns: ChannelColumns, file: str) -> None:
    """Raise `FormatError` for an angle above `_LARGEST_ANGLE_DEG`, because it is rounded by more than a degree."""
    if max(values.max(initial=0.0), -values.min(initial=0.0)) <= _LARGEST_ANGLE_DEG:
        return
    for frame, column in np.argwhere(np.abs(values) > _LARGEST_ANGLE_DEG):
        for joint in np.flatnonzero((columns.turns == column).any(axis=1)):
            raise FormatError(
                f"frame {frame}: an angle of {values[frame, column]:.3g} degrees has no direction, because "
                "numbers of this size are rounded by more than a degree; repair or cut this frame",
                code="value-range",
                file=file,
                joint=source.joint_names[joint],
            )


def _fill_motion(source: SourceMotion, values: NDArray[np.float64], columns: ChannelColumns) -> None:
    rotations = np.empty((len(values), len(source.parents), 4), np.float32)
    rotations_from_euler(values, columns.turns, columns.axes, rotations)
    source.rotations = rotations
    source.root_positions = _positions_of([0], values, columns, source.offsets)[:, 0]
    moved = (1 + np.flatnonzero((columns.positions[1:] != NO_COLUMN).any(axis=1))).tolist()
    if moved:
        source.translated_joints = tuple(moved)
        source.translations = _positions_of(moved, values, columns, source.offsets)
        _take_bones_from_positions(source, source.translations)
        _resolve_displacements(source, source.translations)
        _drop_redundant_translations(source, source.translations)


def _positions_of(
    joints: list[int], values: NDArray[np.float64], columns: ChannelColumns, offsets: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the local positions (F, k, 3) of k joints, from the values (F, C) of the channels.

    On axes without a position channel, the position is the joint's OFFSET, from `offsets` (J, 3).
    """
    wanted = columns.positions[joints]
    positions = values[:, wanted]
    absent = wanted == NO_COLUMN
    positions[:, absent] = offsets[joints][absent]
    return positions


def _take_bones_from_positions(source: SourceMotion, translations: NDArray[np.float64]) -> None:
    """Compute offsets from the position channels if all OFFSETs below the root are zero."""
    if source.offsets[1:].any():
        return
    bones = np.median(translations, axis=0)
    if not bones.any():
        return
    source.offsets[list(source.translated_joints)] = bones
    source.warnings.append(
        CheckWarning(
            "offsets-from-positions",
            "every OFFSET below the root is zero; the offsets were taken from the position channels of "
            f"{counted(len(bones), 'joint')}",
            joints=tuple(source.joint_names[joint] for joint in source.translated_joints),
        )
    )


def _resolve_displacements(source: SourceMotion, translations: NDArray[np.float64]) -> None:
    """Convert displacements in the position channels below the root to positions, by adding the offsets in place.

    Some exporters write the displacement of a joint from its OFFSET instead of its position. The values of a file are
    displacements if, for most joints, they stay within a tenth of the bone's length from zero. As positions, such
    values would give bones nearly no length. Other values are left unchanged.
    """
    offsets = source.offsets[list(source.translated_joints)]
    lengths = np.linalg.norm(offsets, axis=1)
    for frames in (translations[:1], translations):  # of most files, one frame shows that they hold positions
        reach = np.linalg.norm(frames, axis=2).max(axis=0)
        folded = (lengths > 0) & (reach < 0.1 * lengths)
        if 2 * np.count_nonzero(folded) <= np.count_nonzero(lengths):
            return
    translations += offsets
    source.warnings.append(
        CheckWarning(
            "position-channels-relative",
            f"position channels of {counted(len(lengths), 'joint')} stay near zero; "
            "they are read as displacements from OFFSET, not as positions that replace it",
            joints=tuple(source.joint_names[joint] for joint in source.translated_joints),
        )
    )


def _drop_redundant_translations(source: SourceMotion, translations: NDArray[np.float64]) -> None:
    """Keep only the translations of joints whose positions differ from OFFSET by more than a rounding error."""
    offsets = source.offsets[list(source.translated_joints)]
    size = np.abs(source.offsets).max()
    farthest = np.maximum(translations.max(axis=0) - offsets, offsets - translations.min(axis=0))
    moving = (farthest > _PRINTED_DIGITS * size).any(axis=1)
    source.translated_joints = tuple(np.array(source.translated_joints)[moving].tolist())
    source.translations = np.ascontiguousarray(translations[:, moving]) if moving.any() else None
