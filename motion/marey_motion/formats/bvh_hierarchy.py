"""The HIERARCHY of a BVH file and the header of its MOTION section.

The reader is strict about the meaning of the data, but accepts the layouts of all exporters. Indentation is free, a
brace may be on the line of the joint or on a separate line, and keywords may be in upper or lower case. End sites may
have names, and joints may have any of the six channels in any order.
"""

from __future__ import annotations

import hashlib
import re
from dataclasses import dataclass, field, replace

from marey_motion.errors import FormatLimit
from marey_motion.formats.joint_names import MAX_JOINT_NAME_LENGTH
from marey_motion.formats.numeric_text import excerpt
from marey_motion.formats.text_lines import MOST_CACHED_BYTES, TextLines, decode_name, read_number
from marey_schemas.documents.skeletons import MAX_JOINTS
from marey_schemas.lru import LruCache

CHANNELS = tuple(f"{axis}{kind}" for kind in ("position", "rotation") for axis in "XYZ")
_CHANNEL_BY_KEY = {name.lower().encode(): name for name in CHANNELS}
_FRAMES = re.compile(rb"frames\s*(?::\s*)?(\S+)", re.IGNORECASE)
_NO_VALUE = re.compile(rb"(frames|frame\s*time)\s*:", re.IGNORECASE)
_FRAME_TIME = re.compile(rb"frame\s*time\s*(?::\s*)?(\S+)", re.IGNORECASE)
_BRACES = re.compile(rb"([{}])")
_END_SITE = -1
_MOTION_LINE = re.compile(rb"[\r\n][ \t]*motion[ \t]*(?:\r\n|\n|\r)", re.IGNORECASE)


@dataclass
class BvhHeader:
    """Everything in a BVH file before its numbers.

    `offsets` and `channels` are in the order of the joints in the file; the numbers begin at the byte `data_start` and
    the line `data_line`; `frame_time_s` is None if the file does not contain it.
    """

    names: list[str] = field(default_factory=list)
    parents: list[int] = field(default_factory=list)
    offsets: list[list[float] | None] = field(default_factory=list)
    channels: list[tuple[str, ...] | None] = field(default_factory=list)
    end_sites: list[tuple[int, list[float]]] = field(default_factory=list)
    declared_frames: int = 0
    frame_time_s: float | None = None
    data_start: int = 0
    data_line: int = 1


@dataclass(frozen=True)
class _CachedHierarchy:
    """Parsed HIERARCHY in the cache. Files with equal text share one hierarchy, so its lists must not be changed.

    `position` is the offset of the first byte after the text of the hierarchy; `number` is the number of its last line.
    """

    header: BvhHeader
    position: int
    number: int


_KNOWN: LruCache[bytes, _CachedHierarchy] = LruCache(max_entries=64)
"""Cache of the hierarchies read last, by the digest of their text."""


def read_header(lines: TextLines) -> BvhHeader:
    """Read a BVH file up to its first line of numbers.

    Parameters
    ----------
    lines : TextLines    lines of the file

    Returns
    -------
    BvhHeader    joints, channels and frame time; its lists are shared with the cache and must not be changed

    Raises
    ------
    FormatError    if the file is invalid; the error names the line
    """
    header = _read_hierarchy(lines)
    _read_motion_header(lines, header)
    return header


def _read_hierarchy(lines: TextLines) -> BvhHeader:
    """Read the hierarchy, up to the line MOTION; files with equal hierarchies share one parsed hierarchy."""
    motion = _MOTION_LINE.search(lines.data, 0, MOST_CACHED_BYTES)
    key = None if motion is None else hashlib.sha256(lines.data[: motion.end()]).digest()
    kept = None if key is None else _KNOWN.get(key)
    if kept is not None:
        lines.position, lines.number = kept.position, kept.number
        return replace(kept.header)
    first = next(iter(lines), b"")
    if first.upper() != b"HIERARCHY":
        shown = f"the file begins with {excerpt(first)!r}" if first else "the file is empty"
        raise lines.error(f"a BVH file begins with HIERARCHY; {shown}", code="not-bvh")
    header = _HierarchyReader(lines).read()
    if key is not None and motion is not None and lines.position == motion.end():
        _KNOWN.put(key, _CachedHierarchy(replace(header), lines.position, lines.number))
    return header


class _HierarchyReader:
    """Reader of joints, token by token. Open joints are in a list, not on the call stack, so any depth is possible."""

    def __init__(self, lines: TextLines) -> None:
        self.lines = lines
        self.header = BvhHeader()
        self.open: list[int] = []
        self.brace_due = False

    def read(self) -> BvhHeader:
        for line in self.lines:
            if line.upper() == b"MOTION" and self.header.names and not self.open and not self.brace_due:
                return self._checked()
            for piece in filter(None, map(bytes.strip, _BRACES.split(line))):
                self._read_piece(piece)
        raise self.lines.error("the file ends inside its HIERARCHY; copy or export it again", code="file-truncated")

    def _read_piece(self, piece: bytes) -> None:
        if piece == b"{":
            if not self.brace_due:
                raise self.lines.error(
                    "this { does not follow the line of a joint or end site; remove it", joint=self._joint_name()
                )
            self.brace_due = False
        elif self.brace_due:
            raise self.lines.error(
                f"the line of a joint or End Site must be followed by {{, not {excerpt(piece)!r}; add the brace",
                joint=self._joint_name(),
            )
        elif piece == b"}":
            if not self.open:
                raise self.lines.error("this } closes no joint; remove it")
            self.open.pop()
        else:
            keyword, *rest = piece.split(maxsplit=1)
            self._read_statement(piece, keyword.upper(), rest[0] if rest else b"")

    def _read_statement(self, piece: bytes, keyword: bytes, rest: bytes) -> None:
        if keyword in (b"ROOT", b"JOINT"):
            self._begin_joint(keyword, rest)
        elif keyword in (b"END", b"ENDSITE"):
            self._begin_end_site()
        elif keyword == b"OFFSET":
            self._read_offset(rest.split())
        elif keyword == b"CHANNELS":
            self._read_channels(rest.split())
        elif keyword.startswith(b"FRAME") and self.header.names and not self.open:
            raise self.lines.error("the line MOTION is missing before this line; add it", code="motion-missing")
        else:
            ended = self.header.names and not self.open
            expected = "MOTION" if ended else "ROOT, JOINT, End Site, OFFSET, CHANNELS or a brace"
            raise self.lines.error(f"expected {expected}, not {excerpt(piece)!r}", joint=self._joint_name())

    def _begin_joint(self, keyword: bytes, rest: bytes) -> None:
        header = self.header
        if keyword == b"ROOT" and header.names:
            raise self.lines.error(
                "the file has a second ROOT, but only one skeleton per file is supported; split it into one file per "
                "ROOT",
                code="several-roots",
            )
        if not self.open and keyword == b"JOINT":
            raise self.lines.error("this JOINT has no parent; the first joint must be a ROOT")
        if self.open and self.open[-1] == _END_SITE:
            raise self.lines.error(
                "an End Site must not contain a JOINT; move the JOINT out of it", joint=self._joint_name()
            )
        if len(header.names) == MAX_JOINTS:
            raise FormatLimit(
                f"the file has more than {MAX_JOINTS} joints, which is the limit; remove joints from the skeleton",
                file=self.lines.file,
                line=self.lines.number,
            )
        name = decode_name(rest) or f"joint{len(header.names)}"
        if len(name) > MAX_JOINT_NAME_LENGTH:
            raise self.lines.error(
                f"the joint name has {len(name)} characters, more than the limit of {MAX_JOINT_NAME_LENGTH}; shorten "
                "the name"
            )
        self.brace_due = True
        header.parents.append(self.open[-1] if self.open else -1)
        self.open.append(len(header.names))
        header.names.append(name)
        header.offsets.append(None)
        header.channels.append(None)

    def _begin_end_site(self) -> None:
        if not self.open or self.open[-1] == _END_SITE:
            raise self.lines.error("an End Site must be inside a joint", joint=self._joint_name())
        self.brace_due = True
        self.header.end_sites.append((self.open[-1], [0.0, 0.0, 0.0]))
        self.open.append(_END_SITE)

    def _read_offset(self, words: list[bytes]) -> None:
        if not self.open:
            raise self.lines.error("an OFFSET must be inside a joint")
        offset = self.lines.numbers(words, 3, "OFFSET", self._joint_name())
        if self.open[-1] == _END_SITE:
            self.header.end_sites[-1] = (self.header.end_sites[-1][0], offset)
        else:
            self.header.offsets[self.open[-1]] = offset

    def _read_channels(self, words: list[bytes]) -> None:
        joint = self._joint_name()
        if not self.open or self.open[-1] == _END_SITE:
            raise self.lines.error("CHANNELS must be inside a joint", joint=joint)
        if not words or not words[0].isdigit():
            raise self.lines.error("CHANNELS must be followed by the number of channels", joint=joint)
        names = [_CHANNEL_BY_KEY.get(word.lower(), "") for word in words[1:]]
        if "" in names:
            unknown = excerpt(words[1 + names.index("")])
            raise self.lines.error(f"channel {unknown!r} is not one of {', '.join(CHANNELS)}", joint=joint)
        if len(words[0]) > 3 or int(words[0]) != len(names):
            raise self.lines.error(
                f"CHANNELS declares {excerpt(words[0])} channels, but lists {len(names)}; correct the number or the "
                "list",
                joint=joint,
            )
        if len(set(names)) != len(names):
            raise self.lines.error("CHANNELS lists a channel twice; remove one", joint=joint)
        self.header.channels[self.open[-1]] = tuple(names)

    def _joint_name(self) -> str | None:
        joint = next((joint for joint in reversed(self.open) if joint != _END_SITE), None)
        return None if joint is None else self.header.names[joint]

    def _checked(self) -> BvhHeader:
        for name, offset in zip(self.header.names, self.header.offsets, strict=True):
            if offset is None:
                raise self.lines.error("the joint has no OFFSET; add a line with its three numbers", joint=name)
        return self.header


def _read_motion_header(lines: TextLines, header: BvhHeader) -> None:
    frames: bytes | None = None
    frame_time: float | None = None
    while frames is None or frame_time is None:
        position, number = lines.position, lines.number
        line = next(iter(lines), None)
        if line is None:
            raise lines.error(
                "the file ends before 'Frames:' and 'Frame Time:'; copy or export it again", code="file-truncated"
            )
        if match := _NO_VALUE.fullmatch(line):
            raise lines.error(f"{excerpt(match[1])}: the number is missing after the colon", code="bad-number")
        if match := _FRAME_TIME.fullmatch(line):
            frame_time = lines.number_in(match[1], "Frame Time")
        elif match := _FRAMES.fullmatch(line):
            frames = match[1]
            if not frames.isdigit() or len(frames) > 18:
                raise lines.error(f"Frames must be a whole number, not {excerpt(frames)!r}")
        elif frames is not None and read_number(line.split()[0]) is not None:
            lines.position, lines.number = position, number  # the numbers begin without a Frame Time
            break
        else:
            raise lines.error(f"'Frames:' and 'Frame Time:' must follow MOTION, not {excerpt(line)!r}")
    assert frames is not None
    header.declared_frames = int(frames)
    header.frame_time_s = frame_time
    header.data_start = lines.position
    header.data_line = lines.number + 1
