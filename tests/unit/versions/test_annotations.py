"""Merges of annotations: the laws of merging sets of labels, checked against all pairs, and whole documents."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from time import perf_counter
from typing import Any, TypeVar

import pytest
from hypothesis import Phase, find, given, settings
from hypothesis import strategies as st
from tests.support.tiers import examples

from marey_versions.annotations import (
    OTHER_MOTION,
    AnnotationClash,
    AnnotationVersion,
    LabelClash,
    LabelledFrame,
    LabelledRange,
    merge_annotations,
    merge_keyframes,
    merge_segments,
)

One = TypeVar("One", LabelledRange, LabelledFrame)
Segments = tuple[LabelledRange, ...]
Keyframes = tuple[LabelledFrame, ...]


def overlap(one: LabelledRange, other: LabelledRange) -> bool:
    return one.start < other.end and other.start < one.end


def alike(one: LabelledFrame, other: LabelledFrame) -> bool:
    return one.frame == other.frame or one.label == other.label


def are_valid(segments: Sequence[LabelledRange]) -> bool:
    return all(one.end <= other.start for one, other in pairwise(segments))


@st.composite
def layers(draw: st.DrawFn) -> Segments:
    cuts = sorted(draw(st.sets(st.integers(0, 12), max_size=8)))
    labels = st.sampled_from("xy")
    return tuple(LabelledRange(*one, draw(labels)) for one in pairwise(cuts) if draw(st.booleans()))


@st.composite
def edited(draw: st.DrawFn, before: Segments) -> Segments:
    """Draw the segments that remain after a person has removed, relabelled, shortened and added some segments."""
    after: list[LabelledRange] = []
    for one in before:
        what = draw(st.sampled_from(["keep", "keep", "keep", "remove", "relabel", "shorten"]))
        if what == "relabel":
            after.append(one._replace(label=draw(st.sampled_from("xyz"))))
        elif what == "shorten" and one.end - one.start > 1:
            after.append(one._replace(end=one.end - 1))
        elif what != "remove":
            after.append(one)
    for one in draw(layers()):
        if draw(st.booleans()) and not any(overlap(one, other) for other in after):
            after.append(one)
    return tuple(sorted(after))


@st.composite
def edited_layers(draw: st.DrawFn) -> tuple[Segments, Segments, Segments]:
    base = draw(layers())
    return base, draw(edited(base)), draw(edited(base))


keyframe_lists = st.sets(st.builds(LabelledFrame, st.integers(0, 4), st.sampled_from("xy"))).map(
    lambda chosen: tuple(sorted(chosen))
)
edited_keyframes = st.tuples(keyframe_lists, keyframe_lists, keyframe_lists)


def expected(
    sides: tuple[tuple[One, ...], ...], replaces: Callable[[One, One], bool], excludes: Callable[[One, One], bool]
) -> tuple[One, ...] | LabelClash[One]:
    """Return the correct result of the merge, found by comparing all pairs."""
    base, ours, theirs = map(set, sides)
    mine, their = ours - base, theirs - base
    removed: set[One] = set()
    excluded: tuple[set[One], set[One]] = (set(), set())
    for one in base - ours - theirs:
        replaced = [{other for other in added if replaces(one, other)} for added in (mine, their)]
        if replaced[0] != replaced[1]:
            removed.add(one)
            excluded[0].update(replaced[0])
            excluded[1].update(replaced[1])
    for one in mine:
        for other in their:
            if one != other and excludes(one, other):
                excluded[0].add(one)
                excluded[1].add(other)
    if removed or excluded[0]:
        return LabelClash(tuple(sorted(removed)), tuple(sorted(excluded[0])), tuple(sorted(excluded[1])))
    return tuple(sorted((base & ours & theirs) | mine | their))


@settings(max_examples=examples(60, soak=200), deadline=None)
@given(edited_layers())
def test_segments_are_merged_as_a_comparison_of_all_pairs_says(sides: tuple[Segments, Segments, Segments]) -> None:
    assert merge_segments(*sides) == expected(sides, overlap, overlap)


@settings(max_examples=examples(60, soak=200), deadline=None)
@given(edited_keyframes)
def test_keyframes_are_merged_as_a_comparison_of_all_pairs_says(sides: tuple[Keyframes, Keyframes, Keyframes]) -> None:
    assert merge_keyframes(*sides) == expected(sides, alike, lambda _one, _other: False)


CASES = [(merge_segments, edited_layers()), (merge_keyframes, edited_keyframes)]


@pytest.mark.parametrize(("merge", "cases"), CASES)
def test_the_laws_of_merging_hold(merge: Callable[..., Any], cases: st.SearchStrategy[Any]) -> None:
    @settings(max_examples=examples(60, soak=200), deadline=None)
    @given(cases)
    def check(sides: Any) -> None:
        base, ours, theirs = sides
        assert merge(base, base, theirs) == theirs
        assert merge(base, ours, base) == ours
        assert merge(base, ours, ours) == ours
        merged, mirrored = merge(base, ours, theirs), merge(base, theirs, ours)
        assert merge(base[::-1], ours[::-1], theirs[::-1]) == merged
        if isinstance(merged, LabelClash):
            assert mirrored == LabelClash(merged.base, merged.theirs, merged.ours)
        else:
            assert mirrored == merged
            check_that_nothing_disappears(*map(set, (base, ours, theirs, merged)))

    check()


def check_that_nothing_disappears(base: set[Any], ours: set[Any], theirs: set[Any], merged: set[Any]) -> None:
    assert ours & theirs <= merged
    assert (ours - base) | (theirs - base) <= merged
    assert not ((base - ours) | (base - theirs)) & merged
    assert merged <= ours | theirs


@settings(max_examples=examples(60, soak=200), deadline=None)
@given(edited_layers())
def test_merged_segments_never_overlap(sides: tuple[Segments, Segments, Segments]) -> None:
    merged = merge_segments(*sides)
    assert isinstance(merged, LabelClash) or are_valid(merged)


@pytest.mark.parametrize(("merge", "cases"), CASES)
def test_the_examples_reach_both_outcomes(merge: Callable[..., Any], cases: st.SearchStrategy[Any]) -> None:
    def both_changed(sides: Any) -> bool:
        base, ours, theirs = sides
        return bool(base) and base != ours != theirs != base

    for outcome in (LabelClash, tuple):
        reached = lambda sides, outcome=outcome: both_changed(sides) and isinstance(merge(*sides), outcome)  # noqa: E731
        find(cases, reached, settings=settings(max_examples=10_000, phases=(Phase.generate,)))


def test_ten_thousand_segments_and_keyframes_are_merged_in_a_moment() -> None:
    """Comparing all pairs would take minutes, both with conflicts and without."""
    base = [LabelledRange(10 * place, 10 * place + 5, "a") for place in range(10_000)]
    ours, theirs = ([one._replace(label=label) for one in base] for label in "bc")
    frames = [LabelledFrame(10 * place, "a") for place in range(10_000)]
    moved = [[one._replace(frame=one.frame + by) for one in frames] for by in (1, 2)]
    started = perf_counter()
    clash = merge_segments(base, ours, theirs)
    assert isinstance(clash, LabelClash)
    assert len(clash.base) == len(clash.ours) == len(clash.theirs) == 10_000
    assert merge_segments(base, ours[:5000] + base[5000:], base[:5000] + theirs[5000:]) == (
        *ours[:5000],
        *theirs[5000:],
    )
    assert isinstance(merge_keyframes(frames, *moved), LabelClash)
    assert perf_counter() - started < 5


# -- documents --------------------------------------------------------------------------------------------------------


def version(
    *segments: tuple[str, int, int],
    keyframes: Sequence[tuple[str, int]] = (),
    clip: str = "clip 1",
    motion: str | None = "motion 1",
    **members: Any,
) -> AnnotationVersion:
    document = {
        "schema": "marey/annotation@1",
        "clip": {"content": clip},
        "segments": [{"label": label, "start": start, "end": end} for label, start, end in segments],
        **({"keyframes": [{"label": label, "frame": frame} for label, frame in keyframes]} if keyframes else {}),
        **members,
    }
    return AnnotationVersion(document, motion)


def test_labels_of_different_ranges_and_other_members_are_combined() -> None:
    base = version(("step", 0, 30), ("step", 60, 90))
    ours = version(("left", 0, 30), ("step", 60, 90), layer="steps")
    theirs = version(("step", 0, 30), ("pause", 30, 60), ("step", 60, 90), keyframes=[("contact", 12)])
    merged = merge_annotations(base, ours, theirs)
    expected = version(("left", 0, 30), ("pause", 30, 60), ("step", 60, 90), keyframes=[("contact", 12)], layer="steps")
    assert merged == expected.document
    assert merge_annotations(base, theirs, ours) == merged


def test_labels_of_the_same_frames_are_in_conflict() -> None:
    base = version(("step", 0, 30), ("step", 60, 90))
    ours, theirs = version(("step", 0, 30), ("left", 60, 90)), version(("step", 0, 30), ("right", 60, 95))
    clash = merge_annotations(base, ours, theirs)
    assert isinstance(clash, AnnotationClash)
    assert "the first in 'left' at 60:90" in clash.reason
    assert clash.segments == LabelClash(
        (LabelledRange(60, 90, "step"),), (LabelledRange(60, 90, "left"),), (LabelledRange(60, 95, "right"),)
    )


@pytest.mark.parametrize(
    ("ours", "theirs", "reason"),
    [
        (version(layer="a"), version(layer="b"), "'layer'"),
        (version(clip="clip 2"), version(clip="clip 3"), "revision of the clip"),
        (version(keyframes=[("contact", 11)]), version(keyframes=[("contact", 12)]), "'contact' at frame 10"),
    ],
)
def test_the_reason_of_a_conflict_is_named(ours: AnnotationVersion, theirs: AnnotationVersion, reason: str) -> None:
    clash = merge_annotations(version(keyframes=[("contact", 10)], layer="old"), ours, theirs)
    assert isinstance(clash, AnnotationClash)
    assert reason in clash.reason
    assert clash.segments is None


def test_an_annotation_follows_a_clip_whose_motion_is_unchanged() -> None:
    base, theirs = version(("a", 0, 9)), version(("a", 0, 9), ("b", 9, 20))
    renamed = version(("a", 0, 9), clip="clip 2")
    assert merge_annotations(base, renamed, theirs) == version(("a", 0, 9), ("b", 9, 20), clip="clip 2").document
    assert merge_annotations(base, renamed._replace(motion="motion 2"), theirs) == OTHER_MOTION
    moved = [one._replace(motion="motion 2") for one in (renamed, theirs)]
    assert merge_annotations(base, *moved) == OTHER_MOTION  # what the base labels is other motion
    assert merge_annotations(base, renamed._replace(motion=None), theirs._replace(motion=None)) == OTHER_MOTION
