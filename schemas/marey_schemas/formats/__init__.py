"""Table of file formats, from which all choices, file endings, media types and answer types are derived.

A new format is one row and one module: `marey_motion.formats.<name>` has `read_<name>` if the row can be read, and
`write_<name>` if it can be written as motion.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

ORIGINAL = "original"
"""Name of the export format that selects the imported file itself, in any format."""
OCTETS = "application/octet-stream"
ZIP_EPOCH = (1980, 1, 1, 0, 0, 0)
"""The earliest time that a ZIP archive can store. All files get this time, so that equal content gives equal bytes."""

MOST_UNPACKED_BYTES = 1 << 29
"""Greatest unpacked size in bytes of a compressed file; readers stop unpacking there."""

Content = Literal["motion", "skeleton", "model", "tree", "graph", "annotation", "alignment", "record", "item"]

AnnotationForm = Literal["labels", "list", "frames"]
"""Layouts of annotation files of Marey's predecessor.

`labels`: the segments of each label; `list`: one list of all segments, without labels; `frames`: the frames of each
label.
"""
DEFAULT_FORM: AnnotationForm = "labels"
EndIndex = Literal["inclusive", "exclusive"]
"""Meaning of the last index of a segment in the format of Marey's predecessor: inside the segment, or just after it."""
DEFAULT_END_INDEX: EndIndex = "inclusive"

UNITS_M = {
    "mm": 0.001,
    "cm": 0.01,
    "inch": 0.0254,
    "cmu": 0.0254 / 0.45,
    "dm": 0.1,
    "ft": 0.3048,
    "m": 1.0,
}
"""Metres per unit of length, for the units of motion files. The CMU database uses 1/0.45 inch."""


@dataclass(frozen=True, slots=True)
class FileFormat:
    """A file format: what can be read and written in it, and how its files are recognised.

    Parameters
    ----------
    name : name of the format in options, and of its module in `marey_motion.formats`
    endings : endings of file names in lower case; written files get the first one, and a search of a folder for files
        to import uses all of them
    media_type : media type of written files
    reads, writes : kinds of content that can be read from files of the format, and that can be written to them
    units : units of length in which files can be written; if there are several, the caller chooses one
    begins : pattern that the beginning of a file matches only if the file has the format; None if only its
        name identifies a file of the format
    other_endings : endings that also identify the format of a named file, but are ignored in a search of a folder
    euler : whether rotations are Euler angles; an export keeps the rotation orders of the imported file
    archives : endings of files that are ZIP archives; the reader unpacks them
    companion : format of a second file that the reader also needs or accepts
    needs_companion : reason why the second file is needed; empty if it is optional
    unread : reason why there is no reader, for formats that users may expect
    """

    name: str
    endings: tuple[str, ...]
    media_type: str
    reads: tuple[Content, ...] = ()
    writes: tuple[Content, ...] = ()
    units: tuple[str, ...] = ()
    begins: re.Pattern[bytes] | None = None
    other_endings: tuple[str, ...] = ()
    euler: bool = False
    archives: tuple[str, ...] = ()
    companion: str | None = None
    needs_companion: str = ""
    unread: str = ""

    def names(self, file: str) -> bool:
        """Return whether a file name has one of the endings of the format, in any case."""
        return file.lower().endswith(self.endings + self.other_endings)


def _text(beginning: bytes) -> re.Pattern[bytes]:
    return re.compile(rb"\A(?:\xef\xbb\xbf)?\s*" + beginning, re.IGNORECASE)


def _line_of(*keywords: bytes) -> re.Pattern[bytes]:
    """Return a pattern that matches a line which begins with one of the keywords."""
    return re.compile(rb"(?:\A(?:\xef\xbb\xbf)?|[\r\n])\s*:(?:" + b"|".join(keywords) + rb")(?:\s|\Z)", re.IGNORECASE)


FORMATS = (
    FileFormat(
        name="bvh",
        endings=(".bvh",),
        media_type="text/plain",
        reads=("motion", "skeleton"),
        writes=("motion",),
        units=("m", "cm"),
        begins=_text(b"hierarchy"),
        euler=True,
    ),
    FileFormat(
        name="amc",
        endings=(".amc",),
        media_type="text/plain",
        reads=("motion",),
        begins=_line_of(b"fully-specified", b"degrees", b"radians"),
        companion="asf",
        needs_companion="an AMC holds angles alone and needs its skeleton",
    ),
    FileFormat(
        name="asf",
        endings=(".asf",),
        media_type="text/plain",
        reads=("skeleton",),
        begins=_line_of(b"version", b"units", b"bonedata"),
    ),
    FileFormat(
        name="npz",
        endings=(".npz",),
        media_type="application/x-npz",
        reads=("motion", "skeleton"),
        writes=("motion",),
        units=("m",),
        archives=(".npz",),
    ),
    FileFormat(
        name="c3d",
        endings=(".c3d",),
        media_type=OCTETS,
        begins=re.compile(rb"\A[\x02-\x7f]\x50.{510}", re.DOTALL),
        unread="they hold markers, not a skeleton's motion",
    ),
    FileFormat(
        name="predecessor",
        endings=(".bson.bz2", ".bson", ".json", ".skeleton", ".mg.zip"),
        media_type="application/x-bzip2",
        reads=("motion", "skeleton", "model", "tree", "graph", "record"),
        writes=("motion", "model", "tree", "graph", "annotation", "alignment"),
        units=("cm",),
        begins=_text(rb"(?:bzh|\{)"),
        other_endings=(".bz2",),
        archives=(".mg.zip",),
        companion="predecessor",
    ),
    FileFormat(name="json", endings=(".json",), media_type="application/json", writes=("item",)),
)
"""All formats, in the order in which the beginning of a file is compared with their patterns.

The pattern of `predecessor` accepts every JSON object, so formats with a narrower pattern come before it.
"""

_BY_NAME = {one.name: one for one in FORMATS}


def format_named(name: str) -> FileFormat:
    """Return the format with the given name. Raises `KeyError` if there is none."""
    return _BY_NAME[name]


IMPORTED = tuple(one for one in FORMATS if one.reads or one.unread)
"""Formats that imports recognise."""
IMPORTED_ENDINGS = tuple(sorted(ending for one in IMPORTED for ending in one.endings))
"""File name endings by which the upload of a folder selects files."""
MOTION_FORMATS = tuple(one.name for one in FORMATS if "motion" in one.writes)
"""Formats that a clip can be written in."""
WHOLE_FORMATS = tuple(
    one.name for one in FORMATS if "motion" in one.writes and "motion" in one.reads and one.companion is None
)
"""Formats whose files contain the skeleton of the motion, so that each file can be imported on its own."""
SAMPLE_FORMATS = (*MOTION_FORMATS, "json")
EXPORT_FORMATS = (ORIGINAL, *SAMPLE_FORMATS)
"""Formats that an export can have, including `original` for the imported file."""
WRITTEN_UNITS = tuple(dict.fromkeys(unit for one in FORMATS if len(one.units) > 1 for unit in one.units))
"""Units of length that callers can choose for formats without a fixed unit."""
DEFAULT_FORMAT = "bvh"
"""Default format of written motion files."""
DEFAULT_UNIT = "cm"
"""Default unit of length of written files."""
MOTION_MEDIA_TYPES = tuple(dict.fromkeys(format_named(name).media_type for name in MOTION_FORMATS))
EXPORT_MEDIA_TYPES = tuple(dict.fromkeys((OCTETS, *(one.media_type for one in FORMATS if one.writes))))

if TYPE_CHECKING:  # the type checker knows no literals computed from a table; requests are checked against them
    MotionFormat = str
    ExportFormat = str
    LengthUnit = str
    WrittenUnit = str
else:
    MotionFormat = Literal[MOTION_FORMATS]
    ExportFormat = Literal[EXPORT_FORMATS]
    LengthUnit = Literal[tuple(UNITS_M)]
    WrittenUnit = Literal[WRITTEN_UNITS]
