"""ASF/AMC (Acclaim): reading an AMC motion with the ASF skeleton it belongs to.

Angles turn about fixed axes in the order the skeleton lists them: `dof rx ry rz` is Rz · Ry · Rx.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import PurePosixPath

import numpy as np
from numpy.typing import NDArray

from marey_motion import quaternions
from marey_motion.formats.amc_frames import scan_frames
from marey_motion.formats.asf import AsfSkeleton, read_asf
from marey_motion.formats.euler import NO_COLUMN, rotations_from_euler
from marey_motion.formats.numeric_text import excerpt
from marey_motion.formats.text_lines import TextLines
from marey_motion.importing.checks import CheckWarning
from marey_motion.importing.source import SourceMotion

FORMAT = "asf-amc"
DEFAULT_RATE_HZ = 120.0
INCH_M = 0.0254


@dataclass(frozen=True)
class Pairing:
    """Which ASF an AMC belongs to; `reason` says why where there is none."""

    motion: str
    skeleton: str | None
    reason: str | None = None


def pair_companions(names: Iterable[str]) -> tuple[Pairing, ...]:
    """Find the ASF of every AMC among the paths of one upload, by name.

    In the same folder: the file of the same stem, else the one whose stem the AMC's begins with up to a separator
    (16_01.amc with 16.asf, 07_01-walk.amc with 07.asf), the longest of several; else the folder's only ASF.
    """
    paths = sorted({PurePosixPath(name.replace("\\", "/")): name for name in names}.items())
    skeletons: dict[PurePosixPath, list[tuple[PurePosixPath, str]]] = {}
    for path, name in paths:
        if path.suffix.lower() == ".asf":
            skeletons.setdefault(path.parent, []).append((path, name))
    pairings = []
    for path, name in paths:
        if path.suffix.lower() == ".amc":
            pairings.append(_pairing(path, name, skeletons.get(path.parent, [])))
    return tuple(pairings)


def _pairing(path: PurePosixPath, name: str, skeletons: list[tuple[PurePosixPath, str]]) -> Pairing:
    stem = path.stem.lower()
    matching = [
        (len(asf.stem), asf_name)
        for asf, asf_name in skeletons
        if stem == asf.stem.lower() or (stem.startswith(asf.stem.lower()) and not stem[len(asf.stem)].isalnum())
    ]
    if matching:
        return Pairing(name, max(matching)[1])
    if len(skeletons) == 1:
        return Pairing(name, skeletons[0][1])
    if skeletons:
        return Pairing(name, None, f"none of the {len(skeletons)} ASF files beside it has its name")
    return Pairing(name, None, "no ASF file beside it; an AMC holds angles alone and needs its skeleton")


def read_asf_amc(
    amc: bytes, asf: bytes, file: str, *, asf_file: str = "the ASF", frame_rate_hz: float | None = None
) -> SourceMotion:
    """Read a motion and its skeleton as they stand, in their own unit and axes.

    Parameters
    ----------
    amc, asf : the two files
    file, asf_file : their names, for messages
    frame_rate_hz : frames per second; AMC files carry none, 120 is assumed with a warning

    Raises
    ------
    FormatError    with the line, and the bone where there is one
    """
    skeleton = read_asf(asf, asf_file)
    source = skeleton_source(skeleton)
    lines = TextLines(amc, file)
    degrees, declared_rate_hz = _read_amc_header(lines, skeleton.degrees)
    values, gaps = scan_frames(lines, skeleton)
    if gaps:
        message = f"the frames' numbers jump {gaps} times; the frames are taken as they follow each other"
        source.warnings.append(CheckWarning("frame-number-gap", message, values={"gaps": gaps}))
    source.frame_rate_hz = frame_rate_hz or declared_rate_hz
    if source.frame_rate_hz is None:
        source.frame_rate_hz = DEFAULT_RATE_HZ
        source.warnings.append(
            CheckWarning(
                "frame-rate-assumed",
                f"an AMC file carries no frame rate; {DEFAULT_RATE_HZ:g} Hz is assumed, as for CMU takes",
                values={"used_hz": DEFAULT_RATE_HZ},
            )
        )
    _fill_motion(source, skeleton, values, degrees)
    return source


def skeleton_source(skeleton: AsfSkeleton) -> SourceMotion:
    """A skeleton without motion."""
    names = tuple(bone.name for bone in skeleton.bones)
    scale: float | None = None
    declared: tuple[str, ...] = ()
    if skeleton.length_unit is not None:
        scale = INCH_M / skeleton.length_unit
        declared = (f"the ASF gives length {skeleton.length_unit:g}: one unit is 1/{skeleton.length_unit:g} inch",)
    return SourceMotion(
        format=FORMAT,
        joint_names=names,
        display_names=names,
        parents=skeleton.parents,
        offsets=skeleton.offsets(),
        rest_rotations=np.tile([1.0, 0.0, 0.0, 0.0], (len(names), 1)),
        end_sites=skeleton.end_sites(),
        unit_scale_m=scale,
        declared=declared,
        channels=tuple(bone.channels for bone in skeleton.bones),
    )


def _read_amc_header(lines: TextLines, degrees: bool) -> tuple[bool, float | None]:
    """Whether angles are degrees, and the frame rate if one is given; leaves `lines` before the first frame.

    Where the AMC does not say, its angles are in the unit of its skeleton's, `degrees` or not.
    """
    rate_hz = None
    while True:
        position, number = lines.position, lines.number
        line = next(iter(lines), None)
        if line is None:
            raise lines.error("the file holds no frames", code="file-truncated")
        words = line.lower().split()
        if words[0] == b":degrees" or words[0] == b":radians":
            degrees = words[0] == b":degrees"
        elif words[0] == b":samples-per-second":
            rate_hz = lines.numbers(words[1:], 1, ":SAMPLES-PER-SECOND")[0]
            if rate_hz <= 0:
                raise lines.error("a frame rate must be positive")
        elif words[0].isdigit():
            lines.position, lines.number = position, number
            return degrees, rate_hz
        elif not words[0].startswith((b"#", b":")):
            raise lines.error(f"an AMC file begins with :FULLY-SPECIFIED, not {excerpt(line)!r}", code="not-amc")


def _fill_motion(source: SourceMotion, skeleton: AsfSkeleton, values: NDArray[np.float64], degrees: bool) -> None:
    turns = np.full((len(skeleton.bones), 3), NO_COLUMN)
    axes = np.zeros((len(skeleton.bones), 3), np.int64)
    root_positions = np.tile(skeleton.root_position, (len(values), 1))
    column = 0
    for joint, bone in enumerate(skeleton.bones):
        rotating = [i for i, channel in enumerate(bone.channels) if channel[0] == "r"]
        # Turns about fixed axes are turns about moving axes in the opposite order.
        for turn, i in enumerate(reversed(rotating)):
            turns[joint, turn], axes[joint, turn] = column + i, "xyz".index(bone.channels[i][1])
        for i, channel in enumerate(bone.channels):
            if channel[0] == "t":
                root_positions[:, "xyz".index(channel[1])] += values[:, column + i]
        column += len(bone.channels)
    angles = values if degrees else np.degrees(values)
    rotations = np.empty((len(values), len(skeleton.bones), 4), np.float64)
    rotations_from_euler(angles, turns, axes, rotations)
    frames = np.array([bone.frame for bone in skeleton.bones])
    turned = quaternions.multiply(quaternions.multiply(frames, rotations), quaternions.conjugate(frames))
    source.rotations = turned.astype(np.float32)
    source.root_positions = root_positions
