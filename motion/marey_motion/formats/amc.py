"""AMC (Acclaim motion capture): reading a motion together with its ASF skeleton.

Angles are rotations about fixed axes (extrinsic), in the order of `dof` in the ASF: `dof rx ry rz` is Rz · Ry · Rx.
The root moves in the frame of reference that `position` and `orientation` of the ASF's section :root define.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from marey_motion import quaternions
from marey_motion.errors import FormatError
from marey_motion.formats.amc_frames import scan_frames
from marey_motion.formats.asf import AsfSkeleton, parse_asf, skeleton_source
from marey_motion.formats.euler import NO_COLUMN, rotations_from_euler
from marey_motion.formats.numeric_text import excerpt
from marey_motion.formats.text_lines import TextLines
from marey_motion.formats.unpacking import require_unpackable
from marey_motion.importing.checks import CheckWarning
from marey_motion.importing.source import SourceMotion

DEFAULT_RATE_HZ = 120.0


def read_amc(
    data: bytes,
    file: str,
    *,
    companion: bytes | None = None,
    companion_name: str = "the ASF",
    frame_rate_hz: float | None = None,
) -> SourceMotion:
    """Read a motion and its skeleton in their own unit and axes.

    Parameters
    ----------
    data : bytes    content of the AMC file
    file : str    name of the file, for messages
    companion : bytes, optional    content of the ASF file
    companion_name : str    name of the ASF file, for messages
    frame_rate_hz : float, optional    frames per second, replaces the rate in the file; if both are missing, 120 is
        assumed with a warning

    Returns
    -------
    SourceMotion    F frames of J joints

    Raises
    ------
    FormatError    if `companion` is None or a file is invalid; the error names the line, and the bone if there is one
    """
    if companion is None:
        message = "an AMC file contains angles but no skeleton; import it together with its ASF file"
        raise FormatError(message, code="asf-missing", file=file)
    skeleton = parse_asf(companion, companion_name)
    source = skeleton_source(skeleton)
    lines = TextLines(data, file)
    degrees, declared_rate_hz = _read_amc_header(lines, skeleton.degrees)
    values, gaps = scan_frames(lines, skeleton)
    require_unpackable(len(values), len(skeleton.bones), values.size, file)
    if gaps:
        message = f"frame numbers jump {gaps} times; frames were read in the order of the file"
        source.warnings.append(CheckWarning("frame-number-gap", message, values={"gaps": gaps}))
    source.frame_rate_hz = frame_rate_hz or declared_rate_hz
    if source.frame_rate_hz is None:
        source.frame_rate_hz = DEFAULT_RATE_HZ
        source.warnings.append(
            CheckWarning(
                "frame-rate-assumed",
                f"the file states no frame rate; {DEFAULT_RATE_HZ:g} Hz is assumed, as in the CMU database",
                values={"used_hz": DEFAULT_RATE_HZ},
            )
        )
    _fill_motion(source, skeleton, values, degrees)
    return source


def _read_amc_header(lines: TextLines, degrees: bool) -> tuple[bool, float | None]:
    """Read the header, up to the first frame.

    Returns whether angles are in degrees, and the frame rate or None. `degrees` says whether the ASF uses degrees; an
    AMC that does not state the unit is assumed to use the unit of the ASF.
    """
    rate_hz = None
    while True:
        position, number = lines.position, lines.number
        line = next(iter(lines), None)
        if line is None:
            raise lines.error("the file contains no frames; copy or export it again", code="file-truncated")
        words = line.lower().split()
        if words[0] == b":degrees" or words[0] == b":radians":
            degrees = words[0] == b":degrees"
        elif words[0] == b":samples-per-second":
            rate_hz = lines.numbers(words[1:], 1, ":SAMPLES-PER-SECOND")[0]
            if rate_hz <= 0:
                raise lines.error(f"the frame rate must be positive, not {rate_hz:g}")
        elif words[0].isdigit():
            lines.position, lines.number = position, number
            return degrees, rate_hz
        elif not words[0].startswith((b"#", b":")):
            raise lines.error(
                f"{excerpt(line)!r} cannot be in the header of an AMC file: its lines begin with # or :, and the first "
                "frame with its number; choose an AMC file, or export it again",
                code="not-amc",
            )


def _fill_motion(source: SourceMotion, skeleton: AsfSkeleton, values: NDArray[np.float64], degrees: bool) -> None:
    turns = np.full((len(skeleton.bones), 3), NO_COLUMN)
    axes = np.zeros((len(skeleton.bones), 3), np.int64)
    root_moves = np.zeros((len(values), 3))
    column = 0
    for joint, bone in enumerate(skeleton.bones):
        rotating = [i for i, channel in enumerate(bone.channels) if channel[0] == "r"]
        # Turns about fixed axes are turns about moving axes in the opposite order.
        for turn, i in enumerate(reversed(rotating)):
            turns[joint, turn], axes[joint, turn] = column + i, "xyz".index(bone.channels[i][1])
        for i, channel in enumerate(bone.channels):
            if channel[0] == "t":
                root_moves[:, "xyz".index(channel[1])] += values[:, column + i]
        column += len(bone.channels)
    angles = values if degrees else np.degrees(values)
    rotations = np.empty((len(values), len(skeleton.bones), 4), np.float64)
    rotations_from_euler(angles, turns, axes, rotations)
    for joint, bone in enumerate(skeleton.bones):  # one by one, because products of all joints would fill memory
        turned = quaternions.multiply(bone.frame, rotations[:, joint])
        rotations[:, joint] = quaternions.multiply(turned, quaternions.conjugate(bone.frame))
    rotations[:, 0] = quaternions.multiply(skeleton.root_orientation, rotations[:, 0])
    source.rotations = rotations.astype(np.float32)
    source.root_positions = skeleton.root_position + quaternions.rotate_vectors(skeleton.root_orientation, root_moves)
