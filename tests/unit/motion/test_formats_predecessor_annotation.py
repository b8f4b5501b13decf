"""Reading and writing annotations in the format of Marey's predecessor."""

import json
from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from marey_motion.editing.annotations.layers import Keyframe, Layer, Segment
from marey_motion.errors import FormatError
from marey_motion.formats.predecessor.annotation import read_predecessor_annotation, write_predecessor_annotation
from marey_schemas.formats import AnnotationForm, EndIndex

FRAMES = 40


def read(document: dict[str, Any], **options: Any) -> Layer:
    return read_predecessor_annotation(json.dumps(document).encode(), "a.json", FRAMES, **options)


@st.composite
def layers(draw: Callable[..., Any]) -> Layer:
    bounds = sorted(draw(st.sets(st.integers(0, FRAMES), max_size=10)))
    pairs = zip(bounds[::2], bounds[1::2], strict=False)
    segments = tuple(Segment(draw(st.sampled_from(["a", "b", "é"])), *pair) for pair in pairs)
    marks = draw(st.sets(st.tuples(st.sampled_from(["x", "y"]), st.integers(0, FRAMES - 1)), max_size=5))
    return Layer(FRAMES, segments, tuple(Keyframe(*mark) for mark in marks))


@given(layers(), st.sampled_from(["labels", "frames"]), st.sampled_from(["inclusive", "exclusive"]))
def test_what_is_written_is_read_again(layer: Layer, form: AnnotationForm, end_index: EndIndex) -> None:
    written = write_predecessor_annotation(layer, form=form, end_index=end_index)
    again = read_predecessor_annotation(written, "a.json", FRAMES, end_index=end_index)
    assert again == layer
    assert write_predecessor_annotation(again, form=form, end_index=end_index) == written


@given(layers(), st.sampled_from(["inclusive", "exclusive"]))
def test_a_list_keeps_everything_but_the_labels(layer: Layer, end_index: EndIndex) -> None:
    written = write_predecessor_annotation(layer, form="list", end_index=end_index)
    again = read_predecessor_annotation(written, "a.json", FRAMES, end_index=end_index)
    assert [one[1:] for one in again.segments] == [one[1:] for one in layer.segments]
    assert write_predecessor_annotation(again, form="list", end_index=end_index) == written


def test_the_last_frame_of_a_section_is_its_own_unless_told_otherwise() -> None:
    document = {"sections": {"walk": [{"start_idx": 3, "end_idx": 9}], "stand": [{"start_idx": 10, "end_idx": 12}]}}
    assert read(document).segments == (Segment("walk", 3, 10), Segment("stand", 10, 13))
    assert read(document, end_index="exclusive").segments == (Segment("walk", 3, 9), Segment("stand", 10, 12))


def test_sections_of_a_list_are_numbered() -> None:
    found = read({"sections": [{"start_idx": 0, "end_idx": 9}, {"start_idx": 10, "end_idx": 19}]})
    assert found.segments == (Segment("section 1", 0, 10), Segment("section 2", 10, 20))


def test_frames_of_a_label_become_its_unbroken_runs() -> None:
    found = read({"semantic_annotation": {"reach": [7, 5, 6, 6, 20], "none": []}})
    assert found.segments == (Segment("reach", 5, 8), Segment("reach", 20, 21))


def test_sections_that_stand_as_text_are_read_all_the_same() -> None:
    sections = {"walk": [{"start_idx": 3, "end_idx": 9}]}
    assert read({"sections": json.dumps(sections)}) == read({"sections": sections})


def test_sections_that_share_their_ends_are_refused_with_a_hint() -> None:
    document = {"sections": [{"start_idx": 0, "end_idx": 10}, {"start_idx": 10, "end_idx": 20}]}
    with pytest.raises(FormatError, match=r"'section 2' 10:21: the segment overlaps .*exclusive"):
        read(document)
    assert len(read(document, end_index="exclusive").segments) == 2


def test_sections_that_share_more_than_their_ends_are_refused_without_the_hint() -> None:
    document = {"sections": [{"start_idx": 0, "end_idx": 10}, {"start_idx": 9, "end_idx": 20}]}
    with pytest.raises(FormatError, match="the segment overlaps") as refused:
        read(document)
    assert "exclusive" not in str(refused.value)


def test_labels_that_overlap_can_be_read_one_by_one() -> None:
    document = {"semantic_annotation": {"left": [1, 2, 3], "both": [3, 4]}}
    with pytest.raises(FormatError, match="the segment overlaps") as refused:
        read(document)
    assert refused.value.code == "segments-overlap"
    assert read(document, labels=["both"]).segments == (Segment("both", 3, 5),)


@pytest.mark.parametrize(
    ("document", "told"),
    [
        ({}, "must have either the field 'sections'"),
        ({"sections": 3}, "must have either the field 'sections'"),
        ({"sections": [{"start_idx": 1}]}, "'end_idx' must be int"),
        ({"sections": {"a": {"start_idx": 1}}}, "'a' must be list"),
        ({"sections": "{"}, "'sections' cannot be read"),
        ({"sections": [{"start_idx": 1, "end_idx": 99}]}, "within the clip's frames 0:40"),
        ({"sections": [{"start_idx": 5, "end_idx": 3}]}, "the end of a segment must be after its start"),
        ({"semantic_annotation": {"a": [1.5]}}, "must be a whole number"),
        ({"semantic_annotation": {"a": ["x"]}}, "'a'"),
        ({"semantic_annotation": {"a": [True]}}, "list of frame numbers"),
        ({"semantic_annotation": {"a": [-3]}}, "within the clip's frames 0:40"),
        ({"semantic_annotation": {"a": [10**400]}}, "'a'"),
        ({"sections": [], "keyframes": [3]}, "'keyframes' must be dict"),
    ],
)
def test_damaged_annotations_are_refused_by_the_field(document: dict[str, Any], told: str) -> None:
    with pytest.raises(FormatError, match=told) as refused:
        read(document)
    assert refused.value.file == "a.json"
