"""Commands that change a layer of annotation: each returns a new layer or raises `AnnotationError`.

A segment is identified by any frame in it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Literal

from marey_motion.editing.annotations.layers import Keyframe, Layer, Segment, layer_error, require_segments
from marey_motion.errors import AnnotationError

# Segments


def create_segment(layer: Layer, label: str, start: int, end: int, *, overwrite: bool) -> Layer:
    """Add a segment with the frames [start, end).

    Parameters
    ----------
    layer : Layer    the layer
    label : str    label of the segment
    start, end : int    frames of the segment
    overwrite : bool    whether to shorten or remove segments that overlap; if False, an overlap is an error

    Returns
    -------
    Layer    the new layer

    Raises
    ------
    AnnotationError    if the segment is invalid or overlaps another
    """
    made = Segment(label, start, end)
    first, stop = layer.overlapping(start, end)
    covered = layer.segments[first:stop]
    if covered and not overwrite:
        raise layer_error(
            made,
            "segments-overlap",
            f"the new segment overlaps {covered[0]}; set overwrite, or move the other segment first",
        )
    require_segments((made,), layer.frame_count)  # before an invalid segment shortens others
    before = [one._replace(end=start) for one in covered if one.start < start]
    after = [one._replace(start=end) for one in covered if one.end > end]
    return layer.with_segments(first, stop, *before, made, *after)


def remove_segment(layer: Layer, at: int) -> Layer:
    """Remove the segment that contains a frame.

    Parameters
    ----------
    layer : Layer    the layer
    at : int    a frame of the segment

    Returns
    -------
    Layer    the new layer

    Raises
    ------
    AnnotationError    if no segment contains the frame
    """
    index = layer.index_at(at)
    return layer.with_segments(index, index + 1)


def split_segment(layer: Layer, at: int, label: str | None) -> Layer:
    """Cut a segment in two. The frame `at` becomes the first frame of the second part.

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
    AnnotationError    if no segment contains the frame, or if it is the first frame of its segment
    """
    index = layer.index_at(at)
    segment = layer.segments[index]
    if at == segment.start:
        raise layer_error(segment, "empty-segment", f"the segment starts at frame {at}; split it at a later frame")
    rest = Segment(segment.label if label is None else label, at, segment.end)
    return layer.with_segments(index, index + 1, segment._replace(end=at), rest)


def merge_segment(layer: Layer, at: int, neighbour: Literal["next", "previous", "nearest"]) -> Layer:
    """Merge a segment with a neighbour: the result keeps the segment's label and includes the gap between the two.

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
    index = layer.index_at(at)
    segment = layer.segments[index]
    previous = layer.segments[index - 1] if index else None
    following = layer.segments[index + 1] if index + 1 < len(layer.segments) else None
    if neighbour == "nearest" and previous and following:
        neighbour = "previous" if segment.start - previous.end < following.start - segment.end else "next"
    elif neighbour == "nearest":
        neighbour = "previous" if previous else "next"
    other = previous if neighbour == "previous" else following
    if other is None:
        raise layer_error(segment, "no-neighbour", f"the segment has no {neighbour} neighbour to merge with")
    merged = Segment(segment.label, min(segment.start, other.start), max(segment.end, other.end))
    first = index if neighbour == "next" else index - 1
    return layer.with_segments(first, first + 2, merged)


def move_boundary(layer: Layer, at: int, edge: Literal["start", "end"], to: int) -> Layer:
    """Move the start or the end of the segment that contains a frame.

    An adjacent segment stays adjacent, and an overlapped segment is shortened. No segment may become empty.

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
    AnnotationError    if no segment contains the frame, or if a segment would become empty or extend outside the clip
    """
    index = layer.index_at(at)
    segment = layer.segments[index]
    moved = segment._replace(start=to) if edge == "start" else segment._replace(end=to)
    if moved.end <= moved.start:
        raise layer_error(
            segment,
            "empty-segment",
            f"with its {edge} at frame {to}, the segment would have no frames; choose another frame or remove the "
            "segment",
        )
    beside = index - 1 if edge == "start" else index + 1
    if not 0 <= beside < len(layer.segments):
        return layer.with_segments(index, index + 1, moved)
    other = changed = layer.segments[beside]
    if edge == "start" and (other.end == segment.start or other.end > to):
        changed = other._replace(end=to)
    elif edge == "end" and (other.start == segment.end or other.start < to):
        changed = other._replace(start=to)
    if changed.end <= changed.start:
        raise layer_error(
            other,
            "neighbour-in-the-way",
            f"moving the {edge} of {segment} to frame {to} would leave its neighbour {other} without frames; choose a "
            "frame nearer to the present one, or remove the neighbour first",
        )
    first = min(index, beside)
    return layer.with_segments(first, first + 2, *((changed, moved) if edge == "start" else (moved, changed)))


def relabel_segment(layer: Layer, at: int, label: str) -> Layer:
    """Change the label of the segment that contains a frame.

    Parameters
    ----------
    layer : Layer    the layer
    at : int    a frame of the segment
    label : str    new label of the segment

    Returns
    -------
    Layer    the new layer

    Raises
    ------
    AnnotationError    if no segment contains the frame
    """
    index = layer.index_at(at)
    return layer.with_segments(index, index + 1, layer.segments[index]._replace(label=label))


# Keyframes


def add_keyframe(layer: Layer, label: str, frame: int) -> Layer:
    """Add a keyframe.

    Parameters
    ----------
    layer : Layer    the layer
    label : str    label of the keyframe
    frame : int    frame of the keyframe

    Returns
    -------
    Layer    the new layer

    Raises
    ------
    AnnotationError    if the keyframe is invalid or exists already
    """
    made = Keyframe(label, frame)
    place = layer.place_of(made)
    return layer.with_keyframes(place, place, made)


def move_keyframe(layer: Layer, label: str, frame: int, to: int) -> Layer:
    """Move a keyframe to another frame.

    Parameters
    ----------
    layer : Layer    the layer
    label : str    label of the keyframe
    frame : int    frame of the keyframe
    to : int    new frame of the keyframe

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
    label : str    label of the keyframe
    frame : int    frame of the keyframe

    Returns
    -------
    Layer    the new layer

    Raises
    ------
    AnnotationError    if the keyframe does not exist
    """
    gone = Keyframe(label, frame)
    place = layer.place_of(gone)
    if gone not in layer.keyframes[place : place + 1]:
        raise AnnotationError(
            "the layer has no keyframe with this label and frame; choose an existing keyframe",
            code="no-keyframe",
            where=str(gone),
        )
    return layer.with_keyframes(place, place + 1)


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
"""Functions by the names of the commands; each function takes a layer and returns the changed layer."""


def piece_of(layer: Layer, segment: Segment, start: int, end: int) -> Layer:
    """Make the layer for a clip that is cut to the frames [start, end): one segment, and the keyframes in this segment.

    Parameters
    ----------
    layer : Layer    the layer of the whole clip
    segment : Segment    the segment to keep, inside [start, end); keyframes outside the segment are dropped
    start, end : int    frames of the clip that are kept

    Returns
    -------
    Layer    the new layer, with frames counted from `start`

    Raises
    ------
    AnnotationError    if the segment is not inside [start, end)
    """
    if not 0 <= start <= segment.start < segment.end <= end <= layer.frame_count:
        raise layer_error(
            segment,
            "outside-clip",
            f"the segment is not within the frames {start}:{end} that are kept of the clip's "
            f"{layer.frame_count} frames; keep more frames, or choose another segment",
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
