"""Motion files in and out: a reader and a writer per format, and one place where units and axes are converted."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from marey_motion.clip import Clip
from marey_motion.errors import FormatError, UnknownFormat
from marey_motion.formats import detection
from marey_motion.formats.asf import read_asf
from marey_motion.formats.asf_amc import Pairing, pair_companions, read_asf_amc, skeleton_source
from marey_motion.formats.bvh import read_bvh
from marey_motion.formats.bvh_writer import write_bvh
from marey_motion.formats.conversion import convert
from marey_motion.formats.detection import detect_format
from marey_motion.formats.npz import read_npz, write_npz
from marey_motion.formats.predecessor.clips import (
    read_predecessor,
    write_predecessor_clip,
    write_predecessor_skeleton,
)
from marey_motion.importing.source import ImportedMotion, ImportOptions, SourceInfo, SourceMotion

__all__ = [
    "WRITERS",
    "ImportOptions",
    "ImportedMotion",
    "Pairing",
    "SourceInfo",
    "detect_format",
    "pair_companions",
    "read_motion",
    "write_bvh",
    "write_motion",
    "write_npz",
    "write_predecessor_clip",
    "write_predecessor_skeleton",
]

WRITERS: dict[str, Callable[..., bytes]] = {
    detection.BVH: write_bvh,
    detection.NPZ: write_npz,
    detection.PREDECESSOR: write_predecessor_clip,
}


def read_motion(
    data: bytes | memoryview,
    name: str,
    *,
    companion: bytes | memoryview | None = None,
    companion_name: str = "the companion",
    options: ImportOptions | None = None,
) -> ImportedMotion:
    """Read a motion or skeleton file of any known format into Marey's convention.

    Parameters
    ----------
    data : the file
    name : its name: its ending helps to tell the format, and messages carry it
    companion : the ASF of an AMC (`pair_companions` finds it in a batch), the skeleton of a predecessor's clip
    companion_name : its name, for messages
    options : what the user knows better than the file

    Raises
    ------
    FormatError    with file, line and joint; `AmbiguousUnits` where the user has to choose; `UnknownFormat`
    """
    options = options or ImportOptions()
    second = None if companion is None else bytes(companion)
    return convert(_read_source(bytes(data), name, second, companion_name, options), name, options)


def _read_source(
    data: bytes, name: str, companion: bytes | None, companion_name: str, options: ImportOptions
) -> SourceMotion:
    found, rate_hz = detect_format(data, name), options.frame_rate_hz
    if found == detection.BVH:
        return read_bvh(data, name, frame_rate_hz=rate_hz)
    if found == detection.ASF:
        return skeleton_source(read_asf(data, name))
    if found == detection.AMC:
        if companion is None:
            message = "an AMC holds angles alone; import it together with its ASF"
            raise FormatError(message, code="asf-missing", file=name)
        return read_asf_amc(data, companion, name, asf_file=companion_name, frame_rate_hz=rate_hz)
    if found == detection.NPZ:
        return read_npz(data, name, frame_rate_hz=rate_hz)
    if found == detection.PREDECESSOR:
        return read_predecessor(data, name, skeleton=companion, skeleton_file=companion_name, frame_rate_hz=rate_hz)
    message = f"there is no reader for {found.upper()} files; they hold markers, not a skeleton's motion"
    raise FormatError(message, code="reader-absent", file=name)


def write_motion(clip: Clip, file_format: str, **options: Any) -> bytes:
    """Write a clip in one of `WRITERS`' formats; the options are those of its writer.

    Raises
    ------
    UnknownFormat    for any other format; `FormatError` where the format cannot hold the clip
    """
    writer = WRITERS.get(file_format)
    if writer is None:
        raise UnknownFormat(f"there is no writer for {file_format!r}; choose one of {', '.join(WRITERS)}")
    return writer(clip, **options)
