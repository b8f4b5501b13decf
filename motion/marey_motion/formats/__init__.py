"""Motion files in and out: one reader and writer pair per format, one place where units and axes are converted."""

from __future__ import annotations

from marey_motion.errors import FormatError
from marey_motion.formats import detection
from marey_motion.formats.asf_amc import Pairing, pair_companions, read_asf_amc, skeleton_source
from marey_motion.formats.asf import read_asf
from marey_motion.formats.bvh import read_bvh
from marey_motion.formats.conversion import convert
from marey_motion.formats.detection import detect_format
from marey_motion.source import ImportedMotion, ImportOptions, SourceInfo

__all__ = [
    "ImportOptions",
    "ImportedMotion",
    "Pairing",
    "SourceInfo",
    "detect_format",
    "pair_companions",
    "read_motion",
]


def read_motion(
    data: bytes | memoryview,
    name: str,
    *,
    companion: bytes | memoryview | None = None,
    companion_name: str = "the ASF",
    options: ImportOptions | None = None,
) -> ImportedMotion:
    """Read a motion or skeleton file of any known format into Marey's convention.

    Parameters
    ----------
    data : the file
    name : its name: its ending helps to tell the format, and messages carry it
    companion : the ASF of an AMC (`pair_companions` finds it in a batch)
    companion_name : its name, for messages
    options : what the user knows better than the file

    Raises
    ------
    FormatError    with file, line and joint; `AmbiguousUnits` where the user has to choose; `UnknownFormat`
    """
    data = bytes(data)
    options = options or ImportOptions()
    found = detect_format(data, name)
    if found == detection.BVH:
        source = read_bvh(data, name, frame_rate_hz=options.frame_rate_hz)
    elif found == detection.AMC:
        if companion is None:
            raise FormatError(
                "an AMC holds angles alone; import it together with its ASF", code="asf_missing", file=name
            )
        rate_hz = options.frame_rate_hz
        source = read_asf_amc(data, bytes(companion), name, asf_file=companion_name, frame_rate_hz=rate_hz)
    elif found == detection.ASF:
        source = skeleton_source(read_asf(data, name))
    else:
        raise FormatError(f"there is no reader for {found}", code="reader_absent", file=name)
    return convert(source, name, options)
