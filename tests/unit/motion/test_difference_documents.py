"""Differences between annotations, skeletons, mappings, models and fields of documents."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from marey_motion.difference import layers
from marey_motion.difference.fields import changed_values, compare_models
from marey_motion.difference.layers import compare_annotations
from marey_motion.difference.skeletons import compare_mappings, compare_skeletons
from marey_motion.errors import AnnotationError
from marey_motion.gait import studio_skeleton
from marey_motion.skeleton import EndSite, Skeleton
from marey_schemas.documents.annotations import Annotation, SegmentDocument
from marey_schemas.documents.references import RevisionRef
from marey_schemas.documents.skeletons import JointAxesDocument, SkeletonMapping

Segments = list[tuple[str, int, int]]
STEPS: Segments = [("left", 0, 20), ("right", 20, 45), ("left", 45, 60), ("stand", 70, 120)]


def layer(segments: Segments, keyframes: list[tuple[str, int]] | None = None) -> Annotation:
    return Annotation(
        clip=RevisionRef(item="clip_x", revision=1),
        segments=tuple({"label": label, "start": start, "end": end} for label, start, end in segments),
        keyframes=tuple({"label": label, "frame": frame} for label, frame in keyframes or ()),
    )


def changes(before: Segments, after: Segments) -> list[tuple[Any, Any]]:
    found = compare_annotations(layer(before), layer(after)).segments
    return [(plain(one.before), plain(one.after)) for one in found]


def plain(segment: SegmentDocument | None) -> tuple[str, int, int] | None:
    return None if segment is None else (segment.label, segment.start, segment.end)


@pytest.mark.parametrize(
    ("after", "expected"),
    [
        (STEPS, []),
        (STEPS[1:], [(STEPS[0], None)]),
        ([*STEPS, ("turn", 130, 140)], [(None, ("turn", 130, 140))]),
        ([*STEPS[:3], ("stand", 66, 110)], [(STEPS[3], ("stand", 66, 110))]),
        ([*STEPS[:3], ("wait", 70, 120)], [(STEPS[3], ("wait", 70, 120))]),
        ([*STEPS[:3], ("wait", 72, 118)], [(STEPS[3], ("wait", 72, 118))]),
        ([*STEPS[:3], ("wait", 100, 200)], [(STEPS[3], None), (None, ("wait", 100, 200))]),
        ([], [(one, None) for one in STEPS]),
    ],
)
def test_segments_are_added_removed_moved_and_relabelled(after: Segments, expected: list[Any]) -> None:
    assert sorted(changes(STEPS, after), key=str) == sorted(expected, key=str)
    exchanged = [(new, old) for old, new in expected]
    assert sorted(changes(after, STEPS), key=str) == sorted(exchanged, key=str)


def test_segments_that_all_moved_by_more_than_their_length_stay_the_same_segments() -> None:
    steps = [(("left", "right")[place % 2], 10 * place, 10 * place + 10) for place in range(12)]
    moved = [(label, start + 25, end + 25) for label, start, end in steps]
    assert changes(steps, moved) == list(zip(steps, moved, strict=True))


@st.composite
def segments(draw: st.DrawFn) -> Segments:
    borders = sorted(draw(st.sets(st.integers(0, 60), max_size=12)))
    return [(draw(st.sampled_from("abc")), *ends) for ends in zip(borders[::2], borders[1::2], strict=False)]


@given(before=segments(), after=segments())
@settings(max_examples=60, deadline=None)
def test_each_changed_segment_is_in_one_change(before: Segments, after: Segments) -> None:
    found = changes(before, after)
    old, new = [one for one, _ in found if one], [one for _, one in found if one]
    assert len(set(old)) == len(old)
    assert len(set(new)) == len(new)
    kept = [one for one in before if one not in old]
    assert kept == [one for one in after if one not in new]
    assert not changes(before, before)


def test_keyframes_are_compared_like_segments() -> None:
    before = layer([], [("contact", 10), ("lift", 30), ("top", 50)])
    after = layer([], [("contact", 14), ("raise", 30), ("top", 50), ("end", 90)])
    found = compare_annotations(before, after)
    sides = [tuple(side and (side.label, side.frame) for side in (one.before, one.after)) for one in found.keyframes]
    assert sides == [
        (("contact", 10), ("contact", 14)),
        (("lift", 30), ("raise", 30)),
        (None, ("end", 90)),
    ]
    assert found.keyframe_count == (3, 4)


def test_annotations_with_too_many_differing_segments_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(layers, "MOST_PAIRS", 3)
    with pytest.raises(AnnotationError, match="too many"):
        compare_annotations(layer(STEPS), layer([("a", 0, 10), ("b", 10, 20)]))


def changed(skeleton: Skeleton, **fields: Any) -> Skeleton:
    given: dict[str, Any] = {
        "joint_names": skeleton.joint_names,
        "parents": skeleton.parents,
        "offsets": skeleton.offsets,
        "rest_rotations": skeleton.rest_rotations,
        "end_sites": skeleton.end_sites,
    }
    return Skeleton(**(given | fields))


BODY = studio_skeleton()


def test_equal_skeletons_have_no_difference() -> None:
    assert compare_skeletons(BODY, studio_skeleton()) is None


def test_joints_are_added_and_removed_with_their_names() -> None:
    names = (*BODY.joint_names, "Tail")
    longer = changed(
        BODY,
        joint_names=names,
        parents=np.append(BODY.parents, 0).astype(np.int32),
        offsets=np.append(BODY.offsets, [[0.0, 0.0, -0.1]], axis=0),
        rest_rotations=np.append(BODY.rest_rotations, [[1.0, 0.0, 0.0, 0.0]], axis=0),
    )
    found = compare_skeletons(BODY, longer)
    assert found is not None
    assert (found.joint_count, found.added, found.removed) == ((26, 27), ("Tail",), ())
    back = compare_skeletons(longer, BODY)
    assert back is not None
    assert (back.added, back.removed) == ((), ("Tail",))


def test_renamed_joints_are_recognised_below_each_other() -> None:
    other = changed(BODY, joint_names=tuple(name.replace("Left", "L_") for name in BODY.joint_names))
    found = compare_skeletons(BODY, other)
    assert found is not None
    assert not found.added
    assert not found.removed
    assert found.renamed == tuple((name, name.replace("Left", "L_")) for name in BODY.joint_names if "Left" in name)
    assert not found.joints


def test_changes_of_the_rest_pose_are_measured() -> None:
    offsets, rotations, parents = BODY.offsets.copy(), BODY.rest_rotations.copy(), BODY.parents.copy()
    offsets[5] += [0.0, 0.02, 0.0]
    rotations[6] = [np.cos(0.1), np.sin(0.1), 0.0, 0.0]
    parents[25] = 0
    sites = (*BODY.end_sites[1:], EndSite(0, np.ones(3)))
    fields = {"offsets": offsets, "rest_rotations": rotations, "parents": parents, "end_sites": sites}
    found = compare_skeletons(BODY, changed(BODY, **fields))
    assert found is not None
    by_name = {one.joint: one for one in found.joints}
    assert set(by_name) == {BODY.joint_names[joint] for joint in (5, 6, 25)}
    assert by_name[BODY.joint_names[5]].offset_cm == pytest.approx(2.0)
    assert by_name[BODY.joint_names[6]].rotation_deg == pytest.approx(np.degrees(0.2))
    assert by_name[BODY.joint_names[25]].parent == (BODY.joint_names[BODY.parents[25]], BODY.joint_names[0])
    assert found.end_sites_changed


def test_mappings_differ_in_joints_and_axes() -> None:
    axes = JointAxesDocument(twist=(0, 1, 0), swing=(1, 0, 0))
    before = SkeletonMapping(joints={"head": "Head", "hips": "Hips"}, axes={"Head": axes, "Hips": axes})
    after = SkeletonMapping(
        joints={"head": "Neck", "left_toe": "Toe"},
        axes={"Head": JointAxesDocument(twist=(0, 0, 1), swing=(1, 0, 0)), "Hips": axes},
    )
    found = compare_mappings(before, after)
    joints = [(one.standard, one.before, one.after) for one in found.joints]
    assert joints == [("head", "Head", "Neck"), ("hips", "Hips", None), ("left_toe", None, "Toe")]
    assert found.axes == ("Head",)


@pytest.mark.parametrize(
    ("before", "after", "expected"),
    [
        ({"a": 1}, {"a": 1}, []),
        ({"a": 1}, {"a": 1.0}, [("/a", "changed", 1, 1.0)]),
        ({"a": {"b": [1, 2]}}, {"a": {"b": [1, 3]}}, [("/a/b/1", "changed", 2, 3)]),
        ({"a": [1, 2, 3]}, {"a": [0, 1, 3]}, [("/a/0", "changed", 1, 0), ("/a/1", "changed", 2, 1)]),
        ({"a": ["x", "y"]}, {"a": ["x", "y", "z"]}, [("/a/2", "added", None, "z")]),
        ({"a": ["x", "y"]}, {}, [("/a/0", "removed", "x", None), ("/a/1", "removed", "y", None)]),
        ({"a": ["x", "x"]}, {"a": ["x"]}, [("/a/0", "removed", "x", None)]),
        ({"a": None, "b": []}, {}, []),
        ({"a/b~": "x"}, {"a/b~": "y"}, [("/a~1b~0", "changed", "x", "y")]),
        ({"a": "x" * 3000}, {}, [("/a", "removed", "x" * 2000 + "…", None)]),
        ({"a": np.zeros((2, 3))}, {"a": np.ones((2, 3))}, [("/a", "changed", *["array of 2 x 3 numbers"] * 2)]),
        ({"a": np.zeros(2)}, {"a": np.zeros(2)}, []),
    ],
)
def test_changed_values_have_their_places(before: Any, after: Any, expected: list[Any]) -> None:
    assert [tuple(one) for one in changed_values(before, after)] == expected


JSON = st.recursive(
    st.integers(0, 3) | st.sampled_from("ab"),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.sampled_from("abc"), inner, max_size=3),
    max_leaves=8,
)


@given(before=JSON, after=JSON)
@settings(max_examples=80, deadline=None)
def test_changed_values_of_exchanged_documents_are_exchanged(before: Any, after: Any) -> None:
    found = list(changed_values(before, after))
    assert not list(changed_values(before, before))
    opposite = {"added": "removed", "removed": "added", "changed": "changed"}
    back = [(one.change, one.before, one.after) for one in changed_values(after, before)]
    mirrored = [(opposite[one.change], one.after, one.before) for one in found]
    assert sorted(back, key=str) == sorted(mirrored, key=str)


def model(likelihoods: dict[str, float | None], revisions: dict[str, int] | None = None) -> dict[str, Any]:
    aligned = [{"item": name, "revision": number, "name": name} for name, number in (revisions or {}).items()]
    examples = [{"name": name, "log_likelihood": value} for name, value in likelihoods.items()]
    return {"provenance": {"aligned": aligned}, "training": {"examples": examples}}


def test_models_differ_in_their_examples_and_likelihoods() -> None:
    found = compare_models(model({"a": -4.0, "b": -2.0}), model({"b": -1.0, "c": -2.0, "d": -3.0}))
    assert (found.examples, found.examples_added, found.examples_removed) == ((2, 3), ("c", "d"), ("a",))
    assert found.mean_log_likelihood == (-3.0, -2.0)


def test_another_revision_of_an_example_is_another_example() -> None:
    found = compare_models(model({}, {"a": 1, "b": 1}), model({}, {"a": 2, "b": 1}))
    assert (found.examples_added, found.examples_removed) == (("a",), ("a",))
    assert found.mean_log_likelihood == (None, None)


def test_models_without_notes_can_be_compared() -> None:
    assert compare_models({}, {"training": None, "provenance": {}}).examples == (0, 0)
