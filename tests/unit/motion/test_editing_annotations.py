"""Annotation layers, and the commands that change them."""

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from marey_motion.editing.annotations import commands as annotations
from marey_motion.editing.annotations.commands import COMMANDS, piece_of
from marey_motion.editing.annotations.layers import Keyframe, Layer, Segment
from marey_motion.errors import AnnotationError

FRAMES = 30

WALK = Layer(
    FRAMES,
    (Segment("left", 5, 10), Segment("right", 10, 18), Segment("stand", 22, 30)),
    (Keyframe("lift", 7), Keyframe("lift", 13), Keyframe("strike", 13)),
)


def labelled(layer: Layer) -> list[str | None]:
    """Return the label of every frame, None for frames without a label."""
    labels: list[str | None] = [None] * layer.frame_count
    for segment in layer.segments:
        labels[segment.start : segment.end] = [segment.label] * (segment.end - segment.start)
    return labels


def test_splitting_a_segment_keeps_every_frame_of_it_the_last_one_too() -> None:
    split = annotations.split_segment(WALK, 14, None)
    assert labelled(split) == labelled(WALK)
    assert split.segments[1:3] == (Segment("right", 10, 14), Segment("right", 14, 18))
    at_the_last = annotations.split_segment(WALK, 17, "end")
    assert at_the_last.segments[1:3] == (Segment("right", 10, 17), Segment("end", 17, 18))


def test_a_segment_is_not_split_before_its_first_frame() -> None:
    with pytest.raises(AnnotationError, match=r"segment 'right' 10:18: the segment starts at frame 10") as refused:
        annotations.split_segment(WALK, 10, None)
    assert refused.value.code == "empty-segment"


def test_a_new_segment_over_others_is_refused_by_the_name_of_the_first_in_the_way() -> None:
    with pytest.raises(AnnotationError, match=r"'turn' 16:24: the new segment overlaps segment 'right' 10:18"):
        annotations.create_segment(WALK, "turn", 16, 24, overwrite=False)


def test_a_new_segment_that_overwrites_cuts_what_is_there() -> None:
    made = annotations.create_segment(WALK, "turn", 12, 14, overwrite=True)
    assert made.segments[1:4] == (Segment("right", 10, 12), Segment("turn", 12, 14), Segment("right", 14, 18))
    all_over = annotations.create_segment(WALK, "all", 0, FRAMES, overwrite=True)
    assert all_over.segments == (Segment("all", 0, FRAMES),)


@pytest.mark.parametrize(("start", "end", "code"), [(4, 4, "empty-segment"), (28, 31, "outside-clip")])
@pytest.mark.parametrize("overwrite", [False, True])
def test_what_is_no_segment_of_the_clip_is_refused(start: int, end: int, code: str, overwrite: bool) -> None:
    with pytest.raises(AnnotationError) as refused:
        annotations.create_segment(Layer(FRAMES), "x", start, end, overwrite=overwrite)
    assert refused.value.code == code


def test_merging_takes_the_gap_along_and_the_label_of_the_one_that_was_named() -> None:
    assert annotations.merge_segment(WALK, 12, "next").segments[-1] == Segment("right", 10, 30)
    assert annotations.merge_segment(WALK, 12, "previous").segments[0] == Segment("right", 5, 18)
    assert annotations.merge_segment(WALK, 12, "nearest").segments[0] == Segment("right", 5, 18)
    assert annotations.merge_segment(WALK, 29, "nearest").segments[-1] == Segment("stand", 10, 30)
    with pytest.raises(AnnotationError, match="'left' 5:10: the segment has no previous neighbour") as refused:
        annotations.merge_segment(WALK, 5, "previous")
    assert refused.value.code == "no-neighbour"


def test_a_neighbour_that_touches_a_moved_boundary_follows_it_both_ways() -> None:
    assert annotations.move_boundary(WALK, 6, "end", 12).segments[:2] == (
        Segment("left", 5, 12),
        Segment("right", 12, 18),
    )
    assert annotations.move_boundary(WALK, 6, "end", 8).segments[:2] == (Segment("left", 5, 8), Segment("right", 8, 18))
    assert annotations.move_boundary(WALK, 15, "start", 7).segments[:2] == (
        Segment("left", 5, 7),
        Segment("right", 7, 18),
    )


def test_a_neighbour_across_a_gap_gives_way_only_where_it_must() -> None:
    assert annotations.move_boundary(WALK, 15, "end", 20).segments[1:] == (
        Segment("right", 10, 20),
        Segment("stand", 22, 30),
    )
    assert annotations.move_boundary(WALK, 15, "end", 25).segments[1:] == (
        Segment("right", 10, 25),
        Segment("stand", 25, 30),
    )
    with pytest.raises(AnnotationError, match=r"'stand' 22:30: moving the end of segment 'right' 10:18 to frame 30"):
        annotations.move_boundary(WALK, 15, "end", 30)


def test_a_boundary_does_not_pass_the_other_end_of_its_segment() -> None:
    with pytest.raises(AnnotationError, match="with its start at frame 18, the segment would have no frames"):
        annotations.move_boundary(WALK, 15, "start", 18)


def test_segments_are_relabelled_and_removed_by_any_of_their_frames() -> None:
    assert annotations.relabel_segment(WALK, 9, "swing").segments[0] == Segment("swing", 5, 10)
    assert annotations.remove_segment(WALK, 29).segments == WALK.segments[:2]
    with pytest.raises(AnnotationError, match="frame 20: no segment contains this frame") as refused:
        annotations.remove_segment(WALK, 20)
    assert refused.value.code == "no-segment"


def test_keyframes_are_added_moved_and_removed() -> None:
    layer = annotations.add_keyframe(WALK, "passing", 3)
    assert layer.keyframes[0] == Keyframe("passing", 3)
    layer = annotations.move_keyframe(layer, "passing", 3, 15)
    assert layer.keyframes[-1] == Keyframe("passing", 15)
    assert annotations.remove_keyframe(layer, "passing", 15) == WALK


@pytest.mark.parametrize(
    ("command", "arguments", "code"),
    [
        ("add_keyframe", {"label": "lift", "frame": 7}, "keyframe-exists"),
        ("add_keyframe", {"label": "lift", "frame": FRAMES}, "outside-clip"),
        ("add_keyframe", {"label": "", "frame": 3}, "bad-label"),
        ("move_keyframe", {"label": "lift", "frame": 7, "to": 13}, "keyframe-exists"),
        ("remove_keyframe", {"label": "strike", "frame": 7}, "no-keyframe"),
    ],
)
def test_keyframes_that_make_no_sense_are_refused(command: str, arguments: dict[str, Any], code: str) -> None:
    with pytest.raises(AnnotationError) as refused:
        COMMANDS[command](WALK, **arguments)
    assert refused.value.code == code


def test_what_was_cleared_is_empty() -> None:
    assert annotations.clear(WALK) == Layer(FRAMES)


def test_a_layer_cannot_hold_overlapping_segments() -> None:
    with pytest.raises(AnnotationError, match=r"'b' 4:6: the segment overlaps segment 'a' 0:5") as refused:
        Layer(FRAMES, (Segment("b", 4, 6), Segment("a", 0, 5)))
    assert refused.value.code == "segments-overlap"


def test_a_piece_knows_its_own_segment_and_the_keyframes_within_it() -> None:
    piece = piece_of(WALK, WALK.segments[1], 6, 20)
    assert piece == Layer(14, (Segment("right", 4, 12),), (Keyframe("lift", 7), Keyframe("strike", 7)))
    with pytest.raises(
        AnnotationError, match="the segment is not within the frames 11:20 that are kept of the clip's 30 frames"
    ):
        piece_of(WALK, WALK.segments[1], 11, 20)


# Any commands in any order

frames = st.integers(-2, FRAMES + 2)
labels = st.sampled_from(["a", "b", "c"])
commands = st.one_of(
    st.tuples(
        st.just("create_segment"),
        st.fixed_dictionaries({"label": labels, "start": frames, "end": frames, "overwrite": st.booleans()}),
    ),
    st.tuples(st.just("remove_segment"), st.fixed_dictionaries({"at": frames})),
    st.tuples(st.just("split_segment"), st.fixed_dictionaries({"at": frames, "label": st.none() | labels})),
    st.tuples(
        st.just("merge_segment"),
        st.fixed_dictionaries({"at": frames, "neighbour": st.sampled_from(["next", "previous", "nearest"])}),
    ),
    st.tuples(
        st.just("move_boundary"),
        st.fixed_dictionaries({"at": frames, "edge": st.sampled_from(["start", "end"]), "to": frames}),
    ),
    st.tuples(st.just("relabel_segment"), st.fixed_dictionaries({"at": frames, "label": labels})),
    st.tuples(st.just("add_keyframe"), st.fixed_dictionaries({"label": labels, "frame": frames})),
    st.tuples(st.just("move_keyframe"), st.fixed_dictionaries({"label": labels, "frame": frames, "to": frames})),
    st.tuples(st.just("remove_keyframe"), st.fixed_dictionaries({"label": labels, "frame": frames})),
    st.tuples(st.just("clear"), st.just({})),
)


def segment_at(layer: Layer, frame: int) -> Segment:
    """Return the segment that contains a frame."""
    return next(one for one in layer.segments if one.start <= frame < one.end)


def expected(before: Layer, command: str, given_: dict[str, Any]) -> list[str | None]:
    """Compute frame by frame the expected label of every frame after an accepted command."""
    labels_ = labelled(before)
    if command == "create_segment":
        labels_[given_["start"] : given_["end"]] = [given_["label"]] * (given_["end"] - given_["start"])
    elif command == "clear":
        labels_[:] = [None] * before.frame_count
    elif command in ("remove_segment", "relabel_segment", "split_segment"):
        segment = segment_at(before, given_["at"])
        start = given_["at"] if command == "split_segment" else segment.start
        label = None if command == "remove_segment" else given_["label"] or segment.label
        labels_[start : segment.end] = [label] * (segment.end - start)
    elif command == "move_boundary":
        segment = segment_at(before, given_["at"])
        if given_["edge"] == "end":
            follower = [one.label for one in before.segments if one.start == segment.end]
            left_behind = range(given_["to"], segment.end)
            taken = range(segment.start, given_["to"])
        else:
            follower = [one.label for one in before.segments if one.end == segment.start]
            left_behind = range(segment.start, given_["to"])
            taken = range(given_["to"], segment.end)
        for frame in left_behind:
            labels_[frame] = follower[0] if follower else None
        for frame in taken:
            labels_[frame] = segment.label
    return labels_


@given(st.lists(commands, max_size=30))
def test_any_commands_leave_ordered_segments_without_overlap_within_the_clip(given_commands: list[Any]) -> None:
    layer = Layer(FRAMES)
    for command, arguments in given_commands:
        before = layer
        try:
            layer = COMMANDS[command](layer, **arguments)
        except AnnotationError as error:
            refused = error
        else:
            refused = None
        if refused is not None:
            assert refused.where is not None
            assert layer == before
            continue
        assert all(0 <= one.start < one.end <= FRAMES for one in layer.segments)
        assert all(a.end <= b.start for a, b in zip(layer.segments, layer.segments[1:], strict=False))
        assert list(layer.keyframes) == sorted(set(layer.keyframes), key=lambda one: (one.frame, one.label))
        if "keyframe" in command:
            assert layer.segments == before.segments
        elif command != "merge_segment":
            assert labelled(layer) == expected(before, command, arguments)
            assert layer.keyframes == (() if command == "clear" else before.keyframes)
        else:
            assert len(layer.segments) == len(before.segments) - 1


def test_commands_look_only_at_what_they_change_however_many_segments_there_are() -> None:
    class Watched(Segment):
        """Segment that counts how often its frames are read."""

        looks = 0

        @property
        def start(self) -> int:  # pyrefly: ignore[bad-override]  # a property instead of the field, to count reads
            Watched.looks += 1
            return self[1]

    layer = Layer(5000, tuple(Watched._make(("a", at, at + 1)) for at in range(5000)))
    Watched.looks = 0
    for _ in range(10):
        layer = annotations.relabel_segment(layer, 2500, "b")
    assert Watched.looks < 1000
