"""One layer of annotation over a clip: segments, keyframes and their checks.

Frames are counted from 0; a segment [start, end) is half open, so its last frame is `end - 1`, and the `end` of a
segment equals the `start` of an adjacent next segment. Segments of a layer do not overlap.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

from marey_motion.errors import AnnotationError
from marey_schemas.names import MAX_LABEL_LENGTH


class Segment(NamedTuple):
    """A range of frames [start, end) with a label."""

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
    """Segments and keyframes of a clip, which are checked, and sorted by time, when the layer is made.

    Segments must not overlap. Two keyframes may share a frame if their labels differ.

    Raises
    ------
    AnnotationError    if the clip has no frames, or if a segment or keyframe is invalid (the error names it)
    """

    frame_count: int
    segments: tuple[Segment, ...] = ()
    keyframes: tuple[Keyframe, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "segments", tuple(sorted(self.segments, key=lambda one: (one.start, one.end))))
        object.__setattr__(self, "keyframes", tuple(sorted(self.keyframes, key=lambda one: (one.frame, one.label))))
        if self.frame_count < 1:
            raise AnnotationError("a clip without frames cannot be annotated", code="no-frames")
        require_segments(self.segments, self.frame_count)
        _require_keyframes(self.keyframes, self.frame_count)

    def index_at(self, frame: int) -> int:
        """Find the segment that contains a frame.

        Parameters
        ----------
        frame : int    the frame

        Returns
        -------
        int    index of the segment

        Raises
        ------
        AnnotationError    if no segment contains the frame
        """
        index = bisect_right(self.segments, frame, key=_start) - 1
        if index < 0 or frame >= self.segments[index].end:
            raise AnnotationError(
                "no segment contains this frame; choose a frame inside a segment",
                code="no-segment",
                where=f"frame {frame}",
            )
        return index

    def overlapping(self, start: int, end: int) -> tuple[int, int]:
        """Find the segments that overlap [start, end).

        Parameters
        ----------
        start, end : int    frames

        Returns
        -------
        first, stop : int    range of indices; if no segment overlaps, `first` = `stop` is the index for a new segment
        """
        first = bisect_right(self.segments, start, key=_end)
        return first, max(first, bisect_left(self.segments, end, key=_start))

    def with_segments(self, first: int, stop: int, *segments: Segment) -> Layer:
        """Replace a range of segments with other segments. Only the new segments and their neighbours are checked.

        Parameters
        ----------
        first, stop : int    range of indices
        *segments : Segment    the new segments, in the order of time

        Returns
        -------
        Layer    the new layer

        Raises
        ------
        AnnotationError    if a new segment is invalid or overlaps a neighbour
        """
        require_segments(
            (*self.segments[max(0, first - 1) : first], *segments, *self.segments[stop : stop + 1]), self.frame_count
        )
        return self._changed((*self.segments[:first], *segments, *self.segments[stop:]), self.keyframes)

    def place_of(self, keyframe: Keyframe) -> int:
        """Find the index of a keyframe in the order of time, or the index where it would be inserted.

        Parameters
        ----------
        keyframe : Keyframe    the keyframe

        Returns
        -------
        int    the index
        """
        return bisect_left(self.keyframes, _moment(keyframe), key=_moment)

    def with_keyframes(self, first: int, stop: int, *keyframes: Keyframe) -> Layer:
        """Replace a range of keyframes with other keyframes. Only the new keyframes and their neighbours are checked.

        Parameters
        ----------
        first, stop : int    range of indices
        *keyframes : Keyframe    the new keyframes, in the order of time

        Returns
        -------
        Layer    the new layer

        Raises
        ------
        AnnotationError    if a new keyframe is invalid or exists already
        """
        _require_keyframes(
            (*self.keyframes[max(0, first - 1) : first], *keyframes, *self.keyframes[stop : stop + 1]), self.frame_count
        )
        return self._changed(self.segments, (*self.keyframes[:first], *keyframes, *self.keyframes[stop:]))

    def _changed(self, segments: tuple[Segment, ...], keyframes: tuple[Keyframe, ...]) -> Layer:
        """Return a copy with other segments and keyframes, which are known to be valid."""
        made = object.__new__(Layer)
        for name, value in (("frame_count", self.frame_count), ("segments", segments), ("keyframes", keyframes)):
            object.__setattr__(made, name, value)
        return made


def _start(segment: Segment) -> int:
    return segment.start


def _end(segment: Segment) -> int:
    return segment.end


def _moment(keyframe: Keyframe) -> tuple[int, str]:
    return keyframe.frame, keyframe.label


def require_segments(segments: Sequence[Segment], frame_count: int) -> None:
    """Check that segments have valid labels, are inside the clip and not empty, and do not overlap their neighbours.

    Parameters
    ----------
    segments : sequence of Segment    segments, in the order of time
    frame_count : int    frames of the clip

    Raises
    ------
    AnnotationError    if a segment is invalid; the error names the first such segment
    """
    for segment in segments:
        _require_label(segment.label, str(segment))
        if segment.end <= segment.start:
            raise layer_error(segment, "empty-segment", "the end of a segment must be after its start")
        if segment.start < 0 or segment.end > frame_count:
            raise layer_error(segment, "outside-clip", f"the segment must be within the clip's frames 0:{frame_count}")
    for before, after in pairwise(segments):
        if after.start < before.end:
            raise layer_error(
                after,
                "segments-overlap",
                f"the segment overlaps {before}, but segments of one layer must not overlap",
            )


def _require_keyframes(keyframes: Sequence[Keyframe], frame_count: int) -> None:
    """Raise `AnnotationError` if a keyframe has an invalid label, is outside the clip or is repeated."""
    for keyframe in keyframes:
        _require_label(keyframe.label, str(keyframe))
        if not 0 <= keyframe.frame < frame_count:
            raise layer_error(
                keyframe, "outside-clip", f"the keyframe must be within the clip's frames 0:{frame_count}"
            )
    for earlier, later in pairwise(keyframes):
        if earlier == later:
            raise layer_error(
                later, "keyframe-exists", "the layer already has this keyframe; choose another label or another frame"
            )


def _require_label(label: str, place: str) -> None:
    if not 0 < len(label) <= MAX_LABEL_LENGTH:
        raise AnnotationError(f"a label must have 1 to {MAX_LABEL_LENGTH} characters", code="bad-label", where=place)


def layer_error(what: Segment | Keyframe, code: str, reason: str) -> AnnotationError:
    """Make the error about one segment or keyframe.

    Parameters
    ----------
    what : Segment or Keyframe    the invalid segment or keyframe
    code : str    machine-readable code of the error
    reason : str    description of the defect

    Returns
    -------
    AnnotationError    the error, to be raised
    """
    return AnnotationError(reason, code=code, where=str(what))
