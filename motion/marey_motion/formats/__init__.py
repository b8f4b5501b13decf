"""Files of motion: readers and writers, one module per row of `marey_schemas.formats`, and one conversion of units.

A module has `read_<name>` where its row reads something, and `write_<name>` where it writes motion.
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
from marey_motion.importing.source import ImportedMotion, ImportOptions, SourceDocument, SourceInfo, SourceMotion
from marey_schemas.formats import MOTION_FORMATS, FileFormat

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
    """Read a motion or skeleton file of any known format into Marey's convention.

    Parameters
    ----------
    data : the file
    name : its name: its ending helps to tell the format, and messages carry it
    companion : the ASF of an AMC, the skeleton document of a predecessor's clip
    companion_name : its name, for messages
    options : facts that the user knows better than the file

    Raises
    ------
    FormatError    with file, line and joint; `AmbiguousUnits` where the user has to choose; `UnknownFormat`
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
) -> SourceMotion | SourceDocument:
    """Detect the format of a file and read it in its own unit and axes, or decode a document about something else.

    Raises
    ------
    FormatError    with file, line and joint; `UnknownFormat`
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
    source: SourceMotion | SourceDocument = reader_of(row)(content, name, **given)
    return source


def write_motion(clip: Clip, file_format: str, **options: Any) -> bytes:
    """Write a clip in a format that holds motion; the options are those of its writer.

    Raises
    ------
    UnknownFormat    for any other format; `FormatError` where the format cannot hold the clip
    """
    if file_format not in MOTION_FORMATS:
        raise UnknownFormat(f"there is no writer for {file_format!r}; choose one of {', '.join(MOTION_FORMATS)}")
    written: bytes = _function("write", file_format)(clip, **options)
    return written


def reader_of(row: FileFormat) -> Callable[..., SourceMotion | SourceDocument]:
    """Find the reader of a format that has one."""
    return _function("read", row.name)


@cache
def _function(verb: str, name: str) -> Callable[..., Any]:
    function: Callable[..., Any] = getattr(import_module(f"{__name__}.{name}"), f"{verb}_{name}")
    return function
