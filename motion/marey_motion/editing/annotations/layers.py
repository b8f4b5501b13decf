"""One layer of annotation over a clip, and the commands that change it.

Frames are counted from 0; a segment [start, end) is half open, so its last frame is `end - 1` and adjacent segments
share a number: where one ends, the next starts. Segments of a layer do not overlap. Each command returns a new layer or
raises `AnnotationError`; segments are named by any frame in them. A command checks only its changes and their
neighbours: the rest of a layer is valid already.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal, NamedTuple

from marey_motion.errors import AnnotationError
from marey_schemas.names import MAX_LABEL_LENGTH


class Segment(NamedTuple):
    """The frames [start, end) under a label."""

    label: str
    start: int
    end: int

    def __str__(self) -> str:
        return f"segment {self.label!r} {self.start}:{self.end}"


class Keyframe(NamedTuple):
    """A frame with a label."""

    label: str
    frame: int

    def __str__(self) -> str:
        return f"keyframe {self.label!r} at frame {self.frame}"


@dataclass(frozen=True)
class Layer:
    """Segments, which do not overlap, and keyframes of a clip, both sorted by time.

    Two keyframes may share a frame if their labels differ. Segments and keyframes may be given in any order.

    Raises
    ------
    AnnotationError    naming the segment or keyframe that is wrong
    """

    frame_count: int
    segments: tuple[Segment, ...] = ()
    keyframes: tuple[Keyframe, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "segments", tuple(sorted(self.segments, key=lambda one: (one.start, one.end))))
        object.__setattr__(self, "keyframes", tuple(sorted(self.keyframes, key=lambda one: (one.frame, one.label))))
        if self.frame_count < 1:
            raise AnnotationError("a clip without frames cannot be annotated", code="no-frames")
        _require_segments(self.segments, self.frame_count)
        _require_keyframes(self.keyframes, self.frame_count)

    def _index_at(self, frame: int) -> int:
        index = bisect_right(self.segments, frame, key=_start) - 1
        if index < 0 or frame >= self.segments[index].end:
            raise AnnotationError("no segment contains this frame", code="no-segment", where=f"frame {frame}")
        return index

    def _among(self, start: int, end: int) -> tuple[int, int]:
        """Find the indices of the segments that overlap [start, end); an empty range is where to insert a new one."""
        first = bisect_right(self.segments, start, key=_end)
        return first, max(first, bisect_left(self.segments, end, key=_start))

    def _with(self, first: int, stop: int, *segments: Segment) -> Layer:
        """Replace a range of segments by others, which must be in order."""
        _require_segments(
            (*self.segments[max(0, first - 1) : first], *segments, *self.segments[stop : stop + 1]), self.frame_count
        )
        return self._changed((*self.segments[:first], *segments, *self.segments[stop:]), self.keyframes)

    def _place_of(self, keyframe: Keyframe) -> int:
        """Find the index at which a keyframe is, or would be inserted, in the order of time."""
        return bisect_left(self.keyframes, _moment(keyframe), key=_moment)

    def _with_keyframes(self, first: int, stop: int, *keyframes: Keyframe) -> Layer:
        """Replace a range of keyframes by others, which must be in order."""
        _require_keyframes(
            (*self.keyframes[max(0, first - 1) : first], *keyframes, *self.keyframes[stop : stop + 1]), self.frame_count
        )
        return self._changed(self.segments, (*self.keyframes[:first], *keyframes, *self.keyframes[stop:]))

    def _changed(self, segments: tuple[Segment, ...], keyframes: tuple[Keyframe, ...]) -> Layer:
        """Replace fields by values that are known to be valid."""
        made = object.__new__(Layer)
        for name, value in (("frame_count", self.frame_count), ("segments", segments), ("keyframes", keyframes)):
            object.__setattr__(made, name, value)
        return made


# Segments


def create_segment(layer: Layer, label: str, start: int, end: int, *, overwrite: bool) -> Layer:
    """Add the segment [start, end).

    Parameters
    ----------
    layer : Layer    the layer
    label : str    its label
    start, end : int    its frames
    overwrite : bool    whether to shorten or remove segments that overlap; if False, an overlap is an error

    Returns
    -------
    Layer    the new layer

    Raises
    ------
    AnnotationError    if the segment is invalid or overlaps another
    """
    made = Segment(label, start, end)
    first, stop = layer._among(start, end)
    covered = layer.segments[first:stop]
    if covered and not overwrite:
        raise _wrong(
            made,
            "segments-overlap",
            f"the new segment overlaps {covered[0]}; set overwrite, or move the other segment first",
        )
    _require_segments((made,), layer.frame_count)  # what is no segment must not cut others
    before = [one._replace(end=start) for one in covered if one.start < start]
    after = [one._replace(start=end) for one in covered if one.end > end]
    return layer._with(first, stop, *before, made, *after)


def remove_segment(layer: Layer, at: int) -> Layer:
    """Remove the segment that holds a frame.

    Parameters
    ----------
    layer : Layer    the layer
    at : int    a frame of the segment

    Returns
    -------
    Layer    the new layer

    Raises
    ------
    AnnotationError    if no segment holds the frame
    """
    index = layer._index_at(at)
    return layer._with(index, index + 1)


def split_segment(layer: Layer, at: int, label: str | None) -> Layer:
    """Cut a segment in two at a frame, which becomes the first frame of the second part.

    Parameters
    ----------
    layer : Layer    the layer
    at : int    first frame of the second part
    label : str or None    label of the second part; None keeps the segment's label

    Returns
    -------
    Layer    the new layer

    Raises
    ------
    AnnotationError    if no segment can be split there
    """
    index = layer._index_at(at)
    segment = layer.segments[index]
    if at == segment.start:
        raise _wrong(segment, "empty-segment", f"the segment starts at frame {at}; split it at a later frame")
    rest = Segment(segment.label if label is None else label, at, segment.end)
    return layer._with(index, index + 1, segment._replace(end=at), rest)


def merge_segment(layer: Layer, at: int, neighbour: Literal["next", "previous", "nearest"]) -> Layer:
    """Merge a segment with a neighbour: the result keeps the segment's label and includes the gap between them.

    The nearest neighbour is the one with the smaller gap; if both gaps are equal, the next one.

    Parameters
    ----------
    layer : Layer    the layer
    at : int    a frame of the segment
    neighbour : str    "next", "previous" or "nearest"

    Returns
    -------
    Layer    the new layer

    Raises
    ------
    AnnotationError    if there is no such segment or neighbour
    """
    index = layer._index_at(at)
    segment = layer.segments[index]
    previous = layer.segments[index - 1] if index else None
    following = layer.segments[index + 1] if index + 1 < len(layer.segments) else None
    if neighbour == "nearest" and previous and following:
        neighbour = "previous" if segment.start - previous.end < following.start - segment.end else "next"
    elif neighbour == "nearest":
        neighbour = "previous" if previous else "next"
    other = previous if neighbour == "previous" else following
    if other is None:
        raise _wrong(segment, "no-neighbour", f"the segment has no {neighbour} neighbour to merge with")
    merged = Segment(segment.label, min(segment.start, other.start), max(segment.end, other.end))
    first = index if neighbour == "next" else index - 1
    return layer._with(first, first + 2, merged)


def move_boundary(layer: Layer, at: int, edge: Literal["start", "end"], to: int) -> Layer:
    """Move the start or the end of the segment that holds a frame.

    An adjacent segment stays adjacent, and an overlapped one is shortened. Neither may become empty.

    Parameters
    ----------
    layer : Layer    the layer
    at : int    a frame of the segment
    edge : str    "start" or "end"
    to : int    new frame of the edge

    Returns
    -------
    Layer    the new layer

    Raises
    ------
    AnnotationError    if a segment would become empty
    """
    index = layer._index_at(at)
    segment = layer.segments[index]
    moved = segment._replace(start=to) if edge == "start" else segment._replace(end=to)
    if moved.end <= moved.start:
        raise _wrong(segment, "empty-segment", f"with its {edge} at frame {to}, the segment would have no frames")
    beside = index - 1 if edge == "start" else index + 1
    if not 0 <= beside < len(layer.segments):
        return layer._with(index, index + 1, moved)
    other = changed = layer.segments[beside]
    if edge == "start" and (other.end == segment.start or other.end > to):
        changed = other._replace(end=to)
    elif edge == "end" and (other.start == segment.end or other.start < to):
        changed = other._replace(start=to)
    if changed.end <= changed.start:
        raise _wrong(
            other,
            "neighbour-in-the-way",
            f"moving the {edge} of {segment} to {to} would leave its neighbour {other} without frames",
        )
    first = min(index, beside)
    return layer._with(first, first + 2, *((changed, moved) if edge == "start" else (moved, changed)))


def relabel_segment(layer: Layer, at: int, label: str) -> Layer:
    """Change the label of the segment that holds a frame.

    Parameters
    ----------
    layer : Layer    the layer
    at : int    a frame of the segment
    label : str    its new label

    Returns
    -------
    Layer    the new layer

    Raises
    ------
    AnnotationError    if no segment holds the frame
    """
    index = layer._index_at(at)
    return layer._with(index, index + 1, layer.segments[index]._replace(label=label))


# Keyframes


def add_keyframe(layer: Layer, label: str, frame: int) -> Layer:
    """Add a keyframe.

    Parameters
    ----------
    layer : Layer    the layer
    label : str    its label
    frame : int    its frame

    Returns
    -------
    Layer    the new layer

    Raises
    ------
    AnnotationError    if the keyframe is invalid or exists already
    """
    made = Keyframe(label, frame)
    place = layer._place_of(made)
    return layer._with_keyframes(place, place, made)


def move_keyframe(layer: Layer, label: str, frame: int, to: int) -> Layer:
    """Move a keyframe to another frame.

    Parameters
    ----------
    layer : Layer    the layer
    label : str    its label
    frame : int    its frame
    to : int    its new frame

    Returns
    -------
    Layer    the new layer

    Raises
    ------
    AnnotationError    if the keyframe does not exist, or its new frame is invalid
    """
    return add_keyframe(remove_keyframe(layer, label, frame), label, to)


def remove_keyframe(layer: Layer, label: str, frame: int) -> Layer:
    """Remove a keyframe.

    Parameters
    ----------
    layer : Layer    the layer
    label : str    its label
    frame : int    its frame

    Returns
    -------
    Layer    the new layer

    Raises
    ------
    AnnotationError    if it does not exist
    """
    gone = Keyframe(label, frame)
    place = layer._place_of(gone)
    if gone not in layer.keyframes[place : place + 1]:
        raise AnnotationError(
            "the layer has no keyframe with this label and frame", code="no-keyframe", where=str(gone)
        )
    return layer._with_keyframes(place, place + 1)


def clear(layer: Layer) -> Layer:
    """Remove all segments and keyframes.

    Parameters
    ----------
    layer : Layer    the layer

    Returns
    -------
    Layer    an empty layer
    """
    return Layer(layer.frame_count)


COMMANDS: Mapping[str, Callable[..., Layer]] = {
    command.__name__: command
    for command in (
        create_segment,
        remove_segment,
        split_segment,
        merge_segment,
        move_boundary,
        relabel_segment,
        add_keyframe,
        move_keyframe,
        remove_keyframe,
        clear,
    )
}
"""Every command by its name; each takes a layer and answers with the changed one."""


def piece_of(layer: Layer, segment: Segment, start: int, end: int) -> Layer:
    """Make the layer for the part [start, end) of a clip, with one segment and the keyframes inside it.

    Parameters
    ----------
    layer : Layer    the layer
    segment : Segment    one of its segments
    start, end : int    frames of the part, which contains the segment

    Returns
    -------
    Layer    the layer, with frames counted from `start`
    """
    if not 0 <= start <= segment.start < segment.end <= end <= layer.frame_count:
        raise _wrong(
            segment,
            "outside-clip",
            f"the segment is not within the frames {start}:{end} that are kept of the clip's "
            f"{layer.frame_count} frames",
        )
    return Layer(
        end - start,
        (Segment(segment.label, segment.start - start, segment.end - start),),
        tuple(
            Keyframe(one.label, one.frame - start)
            for one in layer.keyframes
            if segment.start <= one.frame < segment.end
        ),
    )


def _start(segment: Segment) -> int:
    return segment.start


def _end(segment: Segment) -> int:
    return segment.end


def _moment(keyframe: Keyframe) -> tuple[int, str]:
    return keyframe.frame, keyframe.label


def _require_segments(segments: Sequence[Segment], frame_count: int) -> None:
    """Raise `AnnotationError` if a segment is empty or outside the clip, or if neighbours overlap."""
    for segment in segments:
        _require_label(segment.label, str(segment))
        if segment.end <= segment.start:
            raise _wrong(segment, "empty-segment", "the end of a segment must be after its start")
        if segment.start < 0 or segment.end > frame_count:
            raise _wrong(segment, "outside-clip", f"the segment must be within the clip's frames 0:{frame_count}")
    for before, after in pairwise(segments):
        if after.start < before.end:
            raise _wrong(after, "segments-overlap", f"the segment overlaps {before}")


def _require_keyframes(keyframes: Sequence[Keyframe], frame_count: int) -> None:
    """Raise `AnnotationError` if a keyframe is outside the clip or repeated."""
    for keyframe in keyframes:
        _require_label(keyframe.label, str(keyframe))
        if not 0 <= keyframe.frame < frame_count:
            raise _wrong(keyframe, "outside-clip", f"the keyframe must be within the clip's frames 0:{frame_count}")
    for earlier, later in pairwise(keyframes):
        if earlier == later:
            raise _wrong(later, "keyframe-exists", "the layer already has this keyframe")


def _require_label(label: str, place: str) -> None:
    if not 0 < len(label) <= MAX_LABEL_LENGTH:
        raise AnnotationError(f"a label must have 1 to {MAX_LABEL_LENGTH} characters", code="bad-label", where=place)


def _wrong(what: Segment | Keyframe, code: str, reason: str) -> AnnotationError:
    return AnnotationError(reason, code=code, where=str(what))
