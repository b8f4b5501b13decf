"""Three-way merges of annotations.

A merge combines the segments and keyframes that each side has added or removed since the base.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Generic, NamedTuple, TypeVar

Document = Mapping[str, Any]
Labelled = TypeVar("Labelled", "LabelledRange", "LabelledFrame")


class LabelledRange(NamedTuple):
    """Segment of an annotation: a label of the frames from `start` up to, but not including, `end`."""

    start: int
    end: int
    label: str


class LabelledFrame(NamedTuple):
    """Keyframe of an annotation."""

    frame: int
    label: str


@dataclass(frozen=True)
class LabelClash(Generic[Labelled]):
    """Segments or keyframes that exclude each other, in the order of their frames."""

    base: tuple[Labelled, ...]
    """Segments or keyframes of the base that both sides have removed; empty if only additions exclude each other."""
    ours: tuple[Labelled, ...]
    theirs: tuple[Labelled, ...]


class AnnotationVersion(NamedTuple):
    """Annotation on one side of a merge, or in the base of both sides."""

    document: Document
    """The document, in which the clip is referred to by the digest of its content."""
    motion: str | None
    """Content digest of the clip's motion; None if it is unknown."""


class AnnotationClash(NamedTuple):
    """Reason why the changes of both sides to an annotation cannot be combined, as a sentence."""

    reason: str
    segments: LabelClash[LabelledRange] | None = None
    """The segments that exclude each other; None if the reason does not concern segments."""


ADDED_TWICE = AnnotationClash("Both sides have added the annotation, so there is no version to compare them with.")
OTHER_MOTION = AnnotationClash("The versions label clips with different motion, so their frames do not correspond.")


def merge_annotations(
    base: AnnotationVersion, ours: AnnotationVersion, theirs: AnnotationVersion
) -> dict[str, Any] | AnnotationClash:
    """Combine what two sides have changed in the document of an annotation.

    Segments and keyframes are merged one by one, all other members of the document as a whole.

    Returns
    -------
    dict or AnnotationClash
        the merged document, in which the clip is referred to by the digest of its content; or the reason why both
        changes cannot be kept
    """
    versions = (base, ours, theirs)
    documents = [one.document for one in versions]
    same_clip = all(one.get("clip") == documents[0].get("clip") for one in documents)
    if not same_clip and (base.motion is None or len({one.motion for one in versions}) > 1):
        return OTHER_MOTION
    merged: dict[str, Any] = {}
    for name in sorted({name for one in documents for name in one}):
        value = _merge_member(name, *(one.get(name) for one in documents))
        if isinstance(value, AnnotationClash):
            return value
        if value is not None:
            merged[name] = value
    return merged


def _merge_member(name: str, base: Any, ours: Any, theirs: Any) -> Any:
    """Return the merged value of a member of the document, or the reason why both changes cannot be kept.

    A missing member has the value None.
    """
    if ours == theirs or theirs == base:
        return ours
    if ours == base:
        return theirs
    if name == "segments":
        return _merge_segment_lists(base, ours, theirs)
    if name == "keyframes":
        return _merge_keyframe_lists(base, ours, theirs)
    if name == "clip":
        return AnnotationClash("Each side has moved the annotation to another revision of the clip.")
    return AnnotationClash(f"Both sides have changed the member {name!r} of the annotation.")


def _merge_segment_lists(base: Any, ours: Any, theirs: Any) -> list[dict[str, Any]] | AnnotationClash:
    sides = (
        [LabelledRange(one["start"], one["end"], one["label"]) for one in side or ()] for side in (base, ours, theirs)
    )
    merged = merge_segments(*sides)
    if not isinstance(merged, LabelClash):
        return [one._asdict() for one in merged]
    first = min((*merged.base, *merged.ours, *merged.theirs))
    return AnnotationClash(
        f"Both sides have labelled the same frames in different ways, the first in {first.label!r} at "
        f"{first.start}:{first.end}.",
        merged,
    )


def _merge_keyframe_lists(base: Any, ours: Any, theirs: Any) -> list[dict[str, Any]] | AnnotationClash:
    sides = ([LabelledFrame(one["frame"], one["label"]) for one in side or ()] for side in (base, ours, theirs))
    merged = merge_keyframes(*sides)
    if not isinstance(merged, LabelClash):
        return [one._asdict() for one in merged]
    first = merged.base[0]
    return AnnotationClash(
        f"Both sides have changed the same keyframes in different ways, the first {first.label!r} at frame "
        f"{first.frame}."
    )


# -- sets of labels ---------------------------------------------------------------------------------------------------


def merge_segments(
    base: Iterable[LabelledRange], ours: Iterable[LabelledRange], theirs: Iterable[LabelledRange]
) -> tuple[LabelledRange, ...] | LabelClash[LabelledRange]:
    """Combine the segments that two sides have added and removed.

    The result has the segments that both sides have kept, and those that one side has added. Two changes exclude each
    other in two cases. The sides have added different segments that overlap; or both sides have removed a segment, and
    have not added the same segments in its place. An added segment that overlaps the removed segment counts as added in
    its place.

    Parameters
    ----------
    base, ours, theirs : segments in any order; segments of the same side do not overlap

    Returns
    -------
    tuple or LabelClash
        the merged segments in the order of their frames, which do not overlap; or the segments that exclude each other
    """
    sets = _Sets(set(base), set(ours), set(theirs))
    only_ours, only_theirs = sets.added
    added = [sorted(only_ours), sorted(only_theirs)]
    places = [([one.start for one in side], [one.end for one in side]) for side in added]

    def overlapping(one: LabelledRange, side: int) -> Sequence[LabelledRange]:
        """Return the segments that a side has added and that overlap `one`; they are adjacent in the sorted list."""
        starts, ends = places[side]
        return added[side][bisect_right(ends, one.start) : bisect_left(starts, one.end)]

    removed: set[LabelledRange] = set()
    excluded: tuple[set[LabelledRange], set[LabelledRange]] = (set(), set())
    for one in sets.removed_twice:
        replaced = overlapping(one, 0), overlapping(one, 1)
        if replaced[0] != replaced[1]:
            removed.add(one)
            excluded[0].update(replaced[0])
            excluded[1].update(replaced[1])
    for one in only_ours - only_theirs:
        if others := overlapping(one, 1):
            excluded[0].add(one)
            excluded[1].update(others)
    return sets.clash(removed, *excluded) if removed or excluded[0] else sets.merged


def merge_keyframes(
    base: Iterable[LabelledFrame], ours: Iterable[LabelledFrame], theirs: Iterable[LabelledFrame]
) -> tuple[LabelledFrame, ...] | LabelClash[LabelledFrame]:
    """Combine the keyframes that two sides have added and removed.

    The result has the keyframes that both sides have kept, and those that one side has added. Changes exclude each
    other if both sides have removed the same keyframe of the base, and have not added the same keyframes in its place:
    for example if one side has moved it, and the other has deleted it. A keyframe with the frame or the label of the
    removed keyframe counts as added in its place.

    Returns
    -------
    tuple or LabelClash
        the merged keyframes in the order of their frames, or the keyframes that exclude each other
    """
    sets = _Sets(set(base), set(ours), set(theirs))
    frames, labels = sets.differing(lambda one: one.frame), sets.differing(lambda one: one.label)
    removed = {one for one in sets.removed_twice if one.frame in frames or one.label in labels}
    if not removed:
        return sets.merged
    frames, labels = {one.frame for one in removed}, {one.label for one in removed}
    ours, theirs = ({one for one in side if one.frame in frames or one.label in labels} for side in sets.added)
    return sets.clash(removed, ours, theirs)


class _Sets(NamedTuple, Generic[Labelled]):
    """Segments or keyframes of the base and of both sides."""

    base: set[Labelled]
    ours: set[Labelled]
    theirs: set[Labelled]

    @property
    def added(self) -> tuple[set[Labelled], set[Labelled]]:
        """Segments or keyframes that our side has added, and those that their side has added."""
        return self.ours - self.base, self.theirs - self.base

    @property
    def removed_twice(self) -> set[Labelled]:
        """Segments or keyframes of the base that both sides have removed."""
        return self.base - self.ours - self.theirs

    @property
    def merged(self) -> tuple[Labelled, ...]:
        """Segments or keyframes that both sides have kept or one side has added, in the order of their frames."""
        return tuple(sorted((self.base & self.ours & self.theirs).union(*self.added)))

    def differing(self, group_of: Callable[[Labelled], Hashable]) -> set[Hashable]:
        """Return the groups (such as frames) in which the two sides have added different segments or keyframes."""
        return {group_of(one) for one in self.added[0] ^ self.added[1]}

    @staticmethod
    def clash(base: set[Labelled], ours: set[Labelled], theirs: set[Labelled]) -> LabelClash[Labelled]:
        """Return a clash of segments or keyframes: those of the base, of our side and of their side."""
        return LabelClash(*(tuple(sorted(side)) for side in (base, ours, theirs)))
