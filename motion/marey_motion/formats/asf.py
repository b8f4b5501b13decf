"""Reader of ASF (Acclaim skeleton files).

In an ASF, a bone has a direction and a length in world axes at rest, and an `axis`: the frame in which its angles are
measured. With C the rotation of that frame and M the rotation by the angles, the bone turns by C · M · C⁻¹ relative to
its parent. The joints made from the bones have world-aligned frames at rest (identity rest rotations, as in BVH). Each
joint is at the start of its bone, so the offset of a joint is the bone vector of the parent; the end of a bone without
children becomes an end site.

The `position` and `orientation` of the section :root place the whole skeleton in the world, and an AMC moves it
relative to this place. So the orientation is the rest rotation of the root.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from marey_motion import quaternions
from marey_motion.errors import FormatLimit
from marey_motion.formats.joint_names import MAX_JOINT_NAME_LENGTH
from marey_motion.formats.numeric_text import excerpt
from marey_motion.formats.text_lines import MOST_CACHED_BYTES, TextLines, decode_name
from marey_motion.importing.source import SourceMotion
from marey_schemas.documents.skeletons import MAX_JOINTS
from marey_schemas.formats import UNITS_M
from marey_schemas.lru import LruCache

FORMAT = "asf-amc"
ROOT = "root"
_AXES = "xyz"
_IN_DEGREES = {b"deg": True, b"degree": True, b"degrees": True, b"rad": False, b"radian": False, b"radians": False}
_CHANNELS = {kind + axis for kind in "rt" for axis in _AXES}
# The format takes commas and parentheses for white space; names may contain them all the same.
_SPACED = bytes.maketrans(b",()", b"   ")


@dataclass
class Bone:
    """A bone in the units and conventions of the file.

    `vector` is the direction times the length, in the file's unit and world axes. `axis` contains three angles, and
    the order of the coordinate axes about which they rotate; `frame` is the quaternion of these rotations. `channels`
    are the degrees of freedom in order ("rx", "tz"). `line` is the number of the bone's line in the file.
    `written_name` is the bone's name as the bytes in the file; AMC files contain the same bytes.
    """

    name: str
    line: int
    written_name: bytes = b""
    direction: list[float] | None = None
    length: float | None = None
    axis: tuple[list[float], str] | None = None
    frame: NDArray[np.float64] = field(default_factory=lambda: np.array([1.0, 0.0, 0.0, 0.0]))
    channels: tuple[str, ...] = ()

    @property
    def vector(self) -> NDArray[np.float64]:
        direction = np.array(self.direction or [0.0, 0.0, 0.0])
        norm = np.linalg.norm(direction)
        return direction / norm * (self.length or 0.0) if norm > 0 else direction


@dataclass
class AsfSkeleton:
    """The content of an ASF file: bones in depth-first order, the root first.

    `parents` are indices; `length_unit` is the file's `units length` (CMU: 0.45), None if the file has none; `degrees`
    is false if the file's angles are in radians; `root_position` and the quaternion `root_orientation` are those of the
    root in the rest pose.
    """

    bones: list[Bone]
    parents: NDArray[np.int32]
    length_unit: float | None
    degrees: bool
    root_position: NDArray[np.float64]
    root_orientation: NDArray[np.float64]

    def offsets(self) -> NDArray[np.float64]:
        """Compute the offset of each joint from its parent; the offset of the root is its position in the rest pose.

        Returns
        -------
        (J, 3) float64    in the file's unit
        """
        vectors = np.array([bone.vector for bone in self.bones])
        offsets = vectors[self.parents]
        offsets[0] = self.root_position
        return offsets

    def end_sites(self) -> tuple[tuple[int, NDArray[np.float64]], ...]:
        """List the tips of the bones without children.

        Returns
        -------
        tuple of (int, (3,) float64)    joint and offset in the file's unit
        """
        inner = set(self.parents.tolist())
        return tuple((j, bone.vector) for j, bone in enumerate(self.bones) if j not in inner)


def read_asf(data: bytes, file: str) -> SourceMotion:
    """Read a skeleton in its own unit and axes.

    Parameters
    ----------
    data : bytes    content of the file
    file : str    name of the file, for messages

    Returns
    -------
    SourceMotion    a source without motion

    Raises
    ------
    FormatError    if the file is invalid; the error names the line, and the bone if there is one
    """
    return skeleton_source(parse_asf(data, file))


def skeleton_source(skeleton: AsfSkeleton) -> SourceMotion:
    """Make a `SourceMotion` without motion from a parsed skeleton.

    Parameters
    ----------
    skeleton : AsfSkeleton    the parsed file

    Returns
    -------
    SourceMotion    a source without motion
    """
    names = tuple(bone.name for bone in skeleton.bones)
    rest_rotations = np.tile([1.0, 0.0, 0.0, 0.0], (len(names), 1))
    rest_rotations[0] = skeleton.root_orientation
    scale: float | None = None
    declared: tuple[str, ...] = ()
    if skeleton.length_unit is not None:
        scale = UNITS_M["inch"] / skeleton.length_unit
        declared = (f"the ASF gives length {skeleton.length_unit:g}: one unit is 1/{skeleton.length_unit:g} inch",)
    return SourceMotion(
        format=FORMAT,
        joint_names=names,
        display_names=names,
        parents=skeleton.parents,
        offsets=skeleton.offsets(),
        rest_rotations=rest_rotations,
        end_sites=skeleton.end_sites(),
        unit_scale_m=scale,
        declared=declared,
        channels=tuple(bone.channels for bone in skeleton.bones),
    )


_KNOWN: LruCache[bytes, AsfSkeleton] = LruCache(max_entries=32)
"""Cache of the skeletons parsed last, by the digest of the ASF file, since many AMC files share one ASF.

The cached skeletons must not be changed.
"""


def parse_asf(data: bytes, file: str) -> AsfSkeleton:
    """Parse an ASF file.

    Parameters
    ----------
    data : bytes    content of the file
    file : str    name of the file, for messages

    Returns
    -------
    AsfSkeleton    bones, the root first; calls with the same content may share it, so it must not be changed

    Raises
    ------
    FormatError    if the file is invalid; the error names the line, and the bone if there is one
    """
    if len(data) > MOST_CACHED_BYTES:
        return _AsfReader(TextLines(data, file)).read()
    return _KNOWN.get_or_make(hashlib.sha256(data).digest(), lambda: _AsfReader(TextLines(data, file)).read())


def _separated(words: list[bytes]) -> list[bytes]:
    return b" ".join(words).translate(_SPACED).split()


class _AsfReader:
    """Reader of the sections of an ASF file. A section is a keyword with a leading colon, and the lines after it."""

    def __init__(self, lines: TextLines) -> None:
        self.lines = lines
        self.degrees = True
        self.length_unit: float | None = None
        self.root = Bone(ROOT, line=1, written_name=ROOT.encode(), channels=("tx", "ty", "tz", "rx", "ry", "rz"))
        self.root_position = [0.0, 0.0, 0.0]
        self.root_axis, self.root_orientation = "xyz", [0.0, 0.0, 0.0]
        self.bones: dict[str, Bone] = {}
        self.bone: Bone | None = None
        self.children: dict[str, list[str]] = {}

    def read(self) -> AsfSkeleton:
        sections = {b"units": self._units, b"root": self._root, b"bonedata": self._bone, b"hierarchy": self._hierarchy}
        section = None
        known = False
        for line in self.lines:
            text = line.partition(b"#")[0].strip()
            if not text:
                continue
            if text.startswith(b":"):
                keyword = text[1:].split()[0].lower() if len(text) > 1 else b""
                known = known or keyword in (b"version", b"name", *sections)
                section = sections.get(keyword)
            elif not known:
                raise self.lines.error(f"an ASF file begins with :version, not {excerpt(text)!r}", code="not-asf")
            elif section:
                section(text.split())
        if not self.children:
            raise self.lines.error(
                "the section :hierarchy is missing or empty; copy or export the file again", code="file-truncated"
            )
        return self._assembled()

    def _units(self, words: list[bytes]) -> None:
        if words[0].lower() == b"length":
            self.length_unit = self.lines.numbers(words[1:], 1, "length")[0]
            if self.length_unit <= 0:
                raise self.lines.error(f"the unit of length must be a positive number, not {self.length_unit}")
        elif words[0].lower() == b"angle":
            degrees = _IN_DEGREES.get(b" ".join(words[1:]).lower())
            if degrees is None:
                raise self.lines.error("the unit `angle` must be deg or rad")
            if self.bones and degrees != self.degrees:
                raise self.lines.error("the unit of angles comes after the bones; move :units before :bonedata")
            self.degrees = degrees

    def _root(self, words: list[bytes]) -> None:
        keyword, words = words[0].lower(), _separated(words)
        if keyword == b"order":
            self.root.channels = self._channels(words[1:], ROOT)
        elif keyword == b"axis":
            self.root_axis = self._order(words[1:], ROOT)
        elif keyword == b"position":
            self.root_position = self.lines.numbers(words[1:], 3, "position", ROOT)
        elif keyword == b"orientation":
            self.root_orientation = self.lines.numbers(words[1:], 3, "orientation", ROOT)

    def _bone(self, words: list[bytes]) -> None:
        keyword, bone = words[0].lower(), self.bone
        if keyword == b"begin":
            self.bone = Bone("", self.lines.number)
        elif bone is None:
            raise self.lines.error(f"the word {excerpt(words[0])!r} must come between begin and end")
        elif keyword == b"end":
            self._end_bone(bone)
        elif keyword == b"name":
            bone.written_name = b" ".join(words[1:])
            bone.name = decode_name(bone.written_name)
        else:
            self._bone_numbers(bone, keyword, _separated(words))

    def _bone_numbers(self, bone: Bone, keyword: bytes, words: list[bytes]) -> None:
        if keyword == b"direction":
            bone.direction = self.lines.numbers(words[1:], 3, "direction", bone.name)
        elif keyword == b"length":
            bone.length = self.lines.numbers(words[1:], 1, "length", bone.name)[0]
        elif keyword == b"axis":
            angles = self.lines.numbers(words[1:4], 3, "axis", bone.name)
            bone.axis = angles, self._order(words[4:], bone.name)
        elif keyword == b"dof":
            bone.channels = self._channels(words[1:], bone.name)
            if any(channel[0] != "r" for channel in bone.channels):
                raise self.lines.error(
                    "only the root may have other degrees of freedom than rx, ry, rz", joint=bone.name
                )

    def _end_bone(self, bone: Bone) -> None:
        if not bone.name or len(bone.name) > MAX_JOINT_NAME_LENGTH:
            raise self.lines.error(f"a bone needs a name of at most {MAX_JOINT_NAME_LENGTH} characters")
        if bone.name in self.bones or bone.name == ROOT:
            raise self.lines.error("two bones have this name; rename one of them", joint=bone.name)
        if bone.direction is None:
            raise self.lines.error("the bone has no direction; add a line 'direction x y z'", joint=bone.name)
        if bone.length is None:
            raise self.lines.error("the bone has no length; add a line 'length x'", joint=bone.name)
        if len(self.bones) + 1 == MAX_JOINTS:
            raise FormatLimit(
                f"the file has more than {MAX_JOINTS} bones, which is the limit; remove bones from the skeleton",
                file=self.lines.file,
                line=self.lines.number,
            )
        if bone.axis is not None:  # only the last axis of the bone counts, so that many of them take no time
            bone.frame = self._frame(*bone.axis)
        self.bones[bone.name] = bone
        self.bone = None

    def _hierarchy(self, words: list[bytes]) -> None:
        if len(words) == 1 and words[0].lower() in (b"begin", b"end"):
            return
        parent, *children = map(decode_name, words)
        for name in (parent, *children):
            if name != ROOT and name not in self.bones:
                raise self.lines.error(
                    "the section :hierarchy contains this bone, but the section :bonedata does not define it; define "
                    "it in :bonedata, or remove it from :hierarchy",
                    joint=name,
                )
        self.children.setdefault(parent, []).extend(children)

    def _channels(self, words: list[bytes], joint: str) -> tuple[str, ...]:
        channels = tuple(word.lower().decode("latin-1") for word in words)
        if any(len(c) != 2 or c[0] not in "rt" or c[1] not in _AXES for c in channels) or len(set(channels)) < len(
            words
        ):
            raise self.lines.error(
                f"the channels {excerpt(b' '.join(words))!r} must be different names out of TX TY TZ RX RY RZ",
                joint=joint,
            )
        return channels

    def _order(self, words: list[bytes], joint: str) -> str:
        order = words[0].lower().decode("latin-1") if len(words) == 1 else ""
        if sorted(order) != list(_AXES):
            message = f"an order of axes such as XYZ is needed, not {excerpt(b' '.join(words))!r}"
            raise self.lines.error(message, joint=joint)
        return order

    def _frame(self, angles: list[float], order: str) -> NDArray[np.float64]:
        """Make the quaternion of three turns about fixed axes, applied in the order of the axis names in `order`."""
        radians = np.radians(angles) if self.degrees else np.array(angles)
        frame = np.array([1.0, 0.0, 0.0, 0.0])
        for axis, angle in zip(order, radians, strict=True):
            turn = quaternions.from_axis_angle(np.eye(3)[_AXES.index(axis)], angle)
            frame = np.asarray(quaternions.multiply(turn, frame), dtype=np.float64)
        return frame

    def _assembled(self) -> AsfSkeleton:
        bones: list[Bone] = []
        parents: list[int] = []
        waiting = [(ROOT, -1)]
        placed: set[str] = set()
        while waiting:
            name, parent = waiting.pop()
            if name in placed:
                raise self.lines.error("the section :hierarchy gives this bone two parents; remove one", joint=name)
            placed.add(name)
            waiting.extend((child, len(bones)) for child in reversed(self.children.get(name, ())))
            bones.append(self.root if name == ROOT else self.bones[name])
            parents.append(parent)
        loose = next((name for name in self.bones if name not in placed), None)
        if loose is not None:
            raise self.lines.error(
                "the section :hierarchy does not connect this bone to the root; give this bone, or the topmost "
                "bone above it, a parent that is connected",
                joint=loose,
            )
        return AsfSkeleton(
            bones,
            np.array(parents, np.int32),
            self.length_unit,
            self.degrees,
            np.array(self.root_position),
            self._frame(self.root_orientation, self.root_axis),
        )
