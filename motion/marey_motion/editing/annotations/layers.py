"""One layer of annotation over a clip, and the commands that change it.

Frames are counted from 0; a segment [start, end) is half open, so its last frame is `end - 1` and segments that follow
each other share a number: where one ends, the next starts. Segments of a layer do not overlap. Each command answers
with a new layer or raises `AnnotationError`; segments are named by any frame in them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal, NamedTuple

from marey_motion.errors import AnnotationError

MAX_LABEL_LENGTH = 255


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
    """Segments in the order of time and without overlap, and keyframes in the order of time, of a clip of F frames.

    Two keyframes may share a frame under different labels. What is given in another order is brought into order.

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
            raise AnnotationError(f"a clip of {self.frame_count} frames has nothing to annotate", code="no-frames")
        for segment in self.segments:
            _require_label(segment.label, str(segment))
            if segment.end <= segment.start:
                raise _wrong(segment, "empty-segment", "its end must lie after its start")
            if segment.start < 0 or segment.end > self.frame_count:
                raise _wrong(segment, "outside-clip", f"the clip has the frames 0:{self.frame_count}")
        for before, after in pairwise(self.segments):
            if after.start < before.end:
                raise _wrong(after, "segments-overlap", f"{before} has some of its frames")
        for keyframe in self.keyframes:
            _require_label(keyframe.label, str(keyframe))
            if not 0 <= keyframe.frame < self.frame_count:
                raise _wrong(keyframe, "outside-clip", f"the clip has the frames 0:{self.frame_count}")
        for earlier, later in pairwise(self.keyframes):
            if earlier == later:
                raise _wrong(later, "keyframe-exists", "it stands there already")

    def segment_at(self, frame: int) -> Segment:
        """The segment that holds a frame. Raises `AnnotationError` where none does."""
        return self.segments[self._index_at(frame)]

    def _index_at(self, frame: int) -> int:
        for index, segment in enumerate(self.segments):
            if segment.start <= frame < segment.end:
                return index
        raise AnnotationError("no segment holds this frame", code="no-segment", where=f"frame {frame}")

    def _with(self, index: int, *segments: Segment) -> Layer:
        """The layer with others in place of one segment."""
        return replace(self, segments=(*self.segments[:index], *segments, *self.segments[index + 1 :]))


# Segments


def create_segment(layer: Layer, label: str, start: int, end: int, *, overwrite: bool = False) -> Layer:
    """Put [start, end) under a label. With `overwrite` the segments that are there give way, else they forbid it."""
    made = Segment(label, start, end)
    if not overwrite:
        for segment in layer.segments:
            if segment.start < end and start < segment.end:
                raise _wrong(made, "segments-overlap", f"{segment} has some of its frames; overwrite, or move it first")
        return replace(layer, segments=(*layer.segments, made))
    Layer(layer.frame_count, (made,))  # what is no segment must not cut others
    left_over: list[Segment] = []
    for segment in layer.segments:
        before = segment._replace(end=min(segment.end, start))
        after = segment._replace(start=max(segment.start, end))
        left_over += [part for part in (before, after) if part.start < part.end]
    return replace(layer, segments=(*left_over, made))


def remove_segment(layer: Layer, at: int) -> Layer:
    """Leave the frames of the segment that holds frame `at` without a label."""
    return layer._with(layer._index_at(at))


def split_segment(layer: Layer, at: int, label: str | None = None) -> Layer:
    """Cut the segment that holds frame `at` in two, of which the second starts there, under `label` if one is given."""
    index = layer._index_at(at)
    segment = layer.segments[index]
    if at == segment.start:
        raise _wrong(segment, "empty-segment", f"it starts at frame {at}; split it at a later frame")
    rest = Segment(segment.label if label is None else label, at, segment.end)
    return layer._with(index, segment._replace(end=at), rest)


def merge_segment(layer: Layer, at: int, neighbour: Literal["next", "previous", "nearest"] = "next") -> Layer:
    """Make one of the segment that holds frame `at` and its neighbour, under its own label and with the gap between.

    The nearest neighbour is the one with the smaller gap, the next one where both are as near.
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
        raise _wrong(segment, "no-neighbour", f"there is no {neighbour} segment to merge with")
    merged = Segment(segment.label, min(segment.start, other.start), max(segment.end, other.end))
    return replace(layer, segments=(*(one for one in layer.segments if one not in (segment, other)), merged))


def move_boundary(layer: Layer, at: int, edge: Literal["start", "end"], to: int) -> Layer:
    """Let the segment that holds frame `at` start, or end, at another frame.

    A neighbour that touches this edge follows it, and one that stands in the way gives way, but neither disappears.
    """
    index = layer._index_at(at)
    segment = layer.segments[index]
    moved = segment._replace(start=to) if edge == "start" else segment._replace(end=to)
    if moved.end <= moved.start:
        raise _wrong(segment, "empty-segment", f"with its {edge} at {to} nothing is left of it")
    segments = list(layer.segments)
    segments[index] = moved
    beside = index - 1 if edge == "start" else index + 1
    if 0 <= beside < len(segments):
        other = segments[beside]
        if edge == "start" and (other.end == segment.start or other.end > to):
            segments[beside] = other._replace(end=to)
        elif edge == "end" and (other.start == segment.end or other.start < to):
            segments[beside] = other._replace(start=to)
        if segments[beside].end <= segments[beside].start:
            raise _wrong(other, "neighbour-in-the-way", f"moving the {edge} of {segment} to {to} leaves nothing of it")
    return replace(layer, segments=tuple(segments))


def relabel_segment(layer: Layer, at: int, label: str) -> Layer:
    """Give the segment that holds frame `at` another label."""
    index = layer._index_at(at)
    return layer._with(index, layer.segments[index]._replace(label=label))


# Keyframes


def add_keyframe(layer: Layer, label: str, frame: int) -> Layer:
    """Mark a frame."""
    return replace(layer, keyframes=(*layer.keyframes, Keyframe(label, frame)))


def move_keyframe(layer: Layer, label: str, frame: int, to: int) -> Layer:
    """Mark another frame instead."""
    return add_keyframe(remove_keyframe(layer, label, frame), label, to)


def remove_keyframe(layer: Layer, label: str, frame: int) -> Layer:
    """Take a mark away."""
    gone = Keyframe(label, frame)
    if gone not in layer.keyframes:
        raise AnnotationError("there is none", code="no-keyframe", where=str(gone))
    return replace(layer, keyframes=tuple(one for one in layer.keyframes if one != gone))


def clear(layer: Layer) -> Layer:
    """Take every segment and keyframe away."""
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
    """What the layer says of one of its segments, in a clip of the frames [start, end) that hold it."""
    if not 0 <= start <= segment.start < segment.end <= end <= layer.frame_count:
        raise _wrong(segment, "outside-clip", f"the frames {start}:{end} of {layer.frame_count} do not hold it")
    return Layer(
        end - start,
        (Segment(segment.label, segment.start - start, segment.end - start),),
        tuple(
            Keyframe(one.label, one.frame - start)
            for one in layer.keyframes
            if segment.start <= one.frame < segment.end
        ),
    )


def _require_label(label: str, place: str) -> None:
    if not 0 < len(label) <= MAX_LABEL_LENGTH:
        raise AnnotationError(f"a label has 1 to {MAX_LABEL_LENGTH} characters", code="bad-label", where=place)


def _wrong(what: Segment | Keyframe, code: str, reason: str) -> AnnotationError:
    return AnnotationError(reason, code=code, where=str(what))
