"""Readers and writers of motion files, one module per format of `marey_schemas.formats`, and the conversion of units.

A module has `read_<name>` if its format can be imported, and `write_<name>` if motion can be exported to it.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from importlib import import_module
from typing import Any

from marey_motion.clip import Clip
from marey_motion.errors import FormatError, UnknownFormat
from marey_motion.formats.bvh import write_bvh
from marey_motion.formats.conversion import convert
from marey_motion.formats.detection import detect_format
from marey_motion.formats.npz import write_npz
from marey_motion.formats.predecessor import write_predecessor, write_predecessor_skeleton
from marey_motion.importing.source import ImportedMotion, SourceDocument, SourceInfo, SourceMotion
from marey_motion.skeleton import Skeleton
from marey_schemas.formats import MOTION_FORMATS, FileFormat
from marey_schemas.options.imports import ImportOptions

__all__ = [
    "ImportOptions",
    "ImportedMotion",
    "SourceInfo",
    "detect_format",
    "read_motion",
    "read_source",
    "write_bvh",
    "write_motion",
    "write_npz",
    "write_predecessor",
    "write_predecessor_skeleton",
]


def read_motion(
    data: bytes | memoryview,
    name: str,
    *,
    companion: bytes | memoryview | None = None,
    companion_name: str = "the companion",
    options: ImportOptions | None = None,
) -> ImportedMotion:
    """Read a motion or skeleton file of any known format, and convert it to metres and Y up.

    Parameters
    ----------
    data : bytes    the content of the file
    name : str    name of the file, which helps to detect the format and appears in messages
    companion : bytes, optional    content of the file with the skeleton, for formats that need one: the ASF of an AMC,
        or the skeleton document of a clip in the format of `formats.predecessor`
    companion_name : str    name of the companion file, for messages
    options : ImportOptions, optional    facts about the file, such as its unit; they have precedence over the content

    Returns
    -------
    ImportedMotion    clip and skeleton in metres, Y up, with the record of the import

    Raises
    ------
    UnknownFormat    if no reader knows the file
    AmbiguousUnits    if the unit of length or the upward axis cannot be determined and must be given in `options`
    ContradictedOption    if the motion contradicts the unit, the upward axis or the frame rate in `options`
    FormatError    if the file is invalid (the error names file, line and joint), if its format is known but has no
        reader, or if it contains neither a motion nor a skeleton

    Examples
    --------
    >>> from marey_motion import generate_gait, read_motion, write_motion
    >>> walk = write_motion(generate_gait(speed_m_s=1.2, turn_rate_rad_s=0.0, duration_s=2.0), "bvh")
    >>> read = read_motion(walk, "walk.bvh")
    >>> read.clip.frame_count, read.source.unit_scale_m, read.warnings
    (120, 0.01, ())
    """
    options = options or ImportOptions()
    source = read_source(data, name, companion=companion, companion_name=companion_name, options=options)
    if isinstance(source, SourceDocument):
        message = f"the document is about a {source.subject}, not about a motion; import it into a project"
        raise FormatError(message, code="not-a-motion", file=name)
    return convert(source, name, options)


def read_source(
    data: bytes | memoryview,
    name: str,
    *,
    companion: bytes | memoryview | None,
    companion_name: str,
    options: ImportOptions,
    skeleton: Skeleton | None = None,
) -> SourceMotion | SourceDocument:
    """Detect the format of a file and read it in its own unit and axes.

    Parameters
    ----------
    data : bytes    the content of the file
    name : str    name of the file
    companion : bytes or None    content of the companion file, such as the ASF of an AMC
    companion_name : str    name of the companion file
    options : ImportOptions    facts about the file, such as its unit; they have precedence over the content
    skeleton : Skeleton, optional    skeleton to use instead of the companion, if the file has a format that does not
        contain a skeleton

    Returns
    -------
    SourceMotion or SourceDocument    the motion in its own unit and axes, or a document about a model, tree or graph

    Raises
    ------
    UnknownFormat    if no reader knows the file
    FormatError    if the file is invalid (the error names file, line and joint), or if its format is known but has no
        reader
    """
    content = bytes(data)
    row = detect_format(content, name)
    if row.unread:
        message = f"there is no reader for {row.name.upper()} files; {row.unread}"
        raise FormatError(message, code="reader-absent", file=name)
    given: dict[str, Any] = {}
    if "motion" in row.reads:
        given["frame_rate_hz"] = options.frame_rate_hz
    if row.companion is not None and companion is not None:
        given |= {"companion": bytes(companion), "companion_name": companion_name}
    if row.companion == row.name and skeleton is not None:
        given["skeleton"] = skeleton
    source: SourceMotion | SourceDocument = reader_of(row)(content, name, **given)
    return source


def write_motion(clip: Clip, file_format: str, **options: Any) -> bytes:
    """Write a clip in a format that holds motion.

    Parameters
    ----------
    clip : Clip    the motion
    file_format : str    one of `marey_schemas.formats.MOTION_FORMATS`
    options    keyword arguments of the format's function `write_<name>`

    Returns
    -------
    bytes    the content of the file

    Raises
    ------
    UnknownFormat    if the format is not in `MOTION_FORMATS`
    FormatError    if the format cannot hold the clip

    Examples
    --------
    >>> from marey_motion import generate_gait, write_motion
    >>> write_motion(generate_gait(speed_m_s=1.2, turn_rate_rad_s=0.0, duration_s=2.0), "bvh").splitlines()[:2]
    [b'HIERARCHY', b'ROOT Hips']
    """
    if file_format not in MOTION_FORMATS:
        raise UnknownFormat(
            f"files of the format {file_format!r} cannot be written; choose one of {', '.join(MOTION_FORMATS)}"
        )
    written: bytes = _function("write", file_format)(clip, **options)
    return written


def reader_of(row: FileFormat) -> Callable[..., SourceMotion | SourceDocument]:
    """Find the function that reads files of a format; the format must be one that can be imported.

    Parameters
    ----------
    row : FileFormat    row of the table of formats

    Returns
    -------
    callable    the format's `read_<name>`
    """
    return _function("read", row.name)


@cache
def _function(verb: str, name: str) -> Callable[..., Any]:
    function: Callable[..., Any] = getattr(import_module(f"{__name__}.{name}"), f"{verb}_{name}")
    return function
