"""The functions of the job kinds `annotate` and `cut`, with a project in memory instead of a server."""

from math import radians
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.support.project_in_memory import ProjectInMemory, add_clip

from marey_motion.gait import generate_gait
from marey_schemas.documents.annotations import Annotation
from marey_schemas.kinds import Kind
from marey_schemas.lru import LruCache
from marey_schemas.queue.job_params import AnnotateParams, CutParams
from marey_schemas.queue.worker_protocol import PinnedInput
from marey_worker.context import JobRefused
from marey_worker.job_io import skeleton_cache
from marey_worker.kinds import annotate, cut

STEPS = AnnotateParams.model_validate({"proposal": {"method": "steps"}})


@pytest.fixture
def project(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> ProjectInMemory:
    """A project with a walk forwards and a walk backwards, and without cached skeletons of earlier tests."""
    monkeypatch.setattr(skeleton_cache, "_skeletons", LruCache(max_entries=4))
    made = ProjectInMemory(tmp_path)
    add_clip(made, "walk", generate_gait(1.4, 0.0, 5.0))
    add_clip(made, "backward", generate_gait(1.2, 0.0, 3.0, travel_angle_rad=radians(180)))
    return made


def annotated(project: ProjectInMemory, **said: Any) -> ProjectInMemory:
    """Add an annotation of the walk to the input of `cut`, and return the project."""
    document = Annotation.model_validate({"clip": {"item": "clip_walk", "revision": 1}, "layer": "mine", **said})
    number = len(project.inputs.get("annotations", ()))
    project.parts[f"annotation_{number}", 1, "annotation"] = document.model_dump(mode="json", by_alias=True)
    pin = PinnedInput(
        item=f"annotation_{number}", revision=1, kind=Kind.ANNOTATION, name=f"a{number}", collection="said"
    )
    project.inputs["annotations"] = (*project.inputs.get("annotations", ()), pin)
    return project


def test_what_is_found_becomes_a_layer_beside_the_clip_at_the_revision_that_was_read(project: ProjectInMemory) -> None:
    result = annotate.run(project, STEPS)
    (output,) = project.staged
    assert (result["annotations"], result["empty"], result["refused"]) == (1, ["walks/backward"], [])
    assert (output.kind, output.collection, output.item_name) == (Kind.ANNOTATION, "walks", "walk steps")
    document = Annotation.model_validate(output.parts["annotation"])
    assert (document.made_by, document.layer) == ("algorithm", "steps")
    assert document.clip.model_dump() == {"item": "clip_walk", "revision": 1}
    assert sum(result["segments"].values()) == len(document.segments) >= 6


def test_joints_of_pauses_are_named_as_in_the_skeleton_or_as_standard_joints(project: ProjectInMemory) -> None:
    staged = []
    for name in ("RightHand", "right_wrist"):
        params = {"proposal": {"method": "velocity_minima", "joints": [name]}, "layer": "pauses"}
        annotate.run(project, AnnotateParams.model_validate(params))
        staged.append(project.staged[0].parts)
        project.staged.clear()
    assert staged[0]["annotation"] == staged[1]["annotation"]
    unknown = {"proposal": {"method": "velocity_minima", "joints": ["tail"]}}
    with pytest.raises(JobRefused, match=r"none of 2 clips can be annotated; .* tail") as refused:
        annotate.run(project, AnnotateParams.model_validate(unknown))
    assert (refused.value.code, project.staged) == ("nothing-done", [])


def test_a_piece_is_the_frames_of_its_segment_with_its_margins_and_keyframes(project: ProjectInMemory) -> None:
    said = {
        "segments": [{"label": "a", "start": 60, "end": 100}, {"label": "b", "start": 100, "end": 130}],
        "keyframes": [{"label": "middle", "frame": 80}, {"label": "late", "frame": 110}],
    }
    annotated(project, **said)
    params = CutParams(labels=("a",), margin_before_s=0.5, margin_after_s=0.25, by_label=True)
    assert cut.run(project, params) == {"clips": 1, "labels": {"a": 1}, "refused": []}
    clip, annotation = project.staged
    source = project.parts["clip_walk", 1, "motion"]["poses"]
    np.testing.assert_array_equal(clip.parts["motion"]["poses"], source[30:115])
    assert (clip.item_name, clip.collection) == ("walk_a_01", "walks/a")
    assert clip.parts["info"]["source"]["details"] == {
        "clip": {"item": "clip_walk", "revision": 1},
        "annotation": {"item": "annotation_0", "revision": 1},
        "label": "a",
        "frames": [30, 115],
    }
    document = annotation.parts["annotation"]
    assert document["clip"] == {"output": clip.name}
    assert document["segments"] == [{"label": "a", "start": 30, "end": 70}]
    assert document["keyframes"] == [{"label": "middle", "frame": 50}]


def test_margins_end_where_the_clip_ends_and_short_or_long_segments_are_left_out(project: ProjectInMemory) -> None:
    annotated(
        project,
        segments=[
            {"label": "a", "start": 0, "end": 10},
            {"label": "a", "start": 10, "end": 70},
            {"label": "a", "start": 100, "end": 300},
        ],
    )
    cut.run(project, CutParams(shortest_s=0.5, longest_s=2.0, margin_before_s=10.0))
    (clip,) = [one for one in project.staged if one.kind is Kind.CLIP]
    assert clip.item_name == "walk_a_02"
    assert len(clip.parts["motion"]["poses"]) == 70


def test_a_label_that_no_annotation_has_is_refused_with_those_there_are(project: ProjectInMemory) -> None:
    annotated(project, segments=[{"label": "a", "start": 0, "end": 10}])
    with pytest.raises(JobRefused, match="the labels of the segments are a") as refused:
        cut.run(project, CutParams(labels=("b",)))
    assert refused.value.code == "nothing-to-cut"


def test_annotations_without_segments_or_of_another_layer_have_nothing_to_cut(project: ProjectInMemory) -> None:
    annotated(project, segments=[], layer="mine")
    with pytest.raises(JobRefused, match="the annotations have no segments"):
        cut.run(project, CutParams())
    with pytest.raises(JobRefused, match="no annotation of the layer 'yours' can be used"):
        cut.run(project, CutParams(layer="yours"))


def test_layers_that_would_make_pieces_of_one_name_are_refused(project: ProjectInMemory) -> None:
    for layer in ("mine", "yours"):
        annotated(project, segments=[{"label": "a", "start": 0, "end": 10}], layer=layer)
    with pytest.raises(JobRefused, match="2 pieces would have the path walks/walk_a_01") as refused:
        cut.run(project, CutParams())
    assert (refused.value.code, project.staged) == ("same-name", [])
    assert cut.run(project, CutParams(layer="yours"))["clips"] == 1


def test_an_annotation_that_goes_beyond_its_clip_keeps_no_other_from_being_cut(project: ProjectInMemory) -> None:
    annotated(project, segments=[{"label": "a", "start": 0, "end": 9999}])
    with pytest.raises(JobRefused, match="none of 1 annotation can be cut; said/a0: ") as refused:
        cut.run(project, CutParams())
    assert (refused.value.code, project.staged) == ("nothing-done", [])
    annotated(project, segments=[{"label": "b", "start": 0, "end": 10}])
    result = cut.run(project, CutParams())
    assert (result["clips"], [one["name"] for one in result["refused"]]) == (1, ["said/a0"])
    assert "'a' 0:9999" in result["refused"][0]["detail"]


@pytest.mark.parametrize("name", ["{clip}", "{clip} {label}", "{clip} {label} {number} {x}", "{clip}/{label} {number}"])
def test_a_pattern_that_names_pieces_alike_or_something_unknown_is_refused(name: str) -> None:
    with pytest.raises(ValueError, match=r"name"):
        CutParams(name=name)


def test_names_count_with_as_many_digits_as_asked_for() -> None:
    assert CutParams(name="{label}-{number:4} of {clip}").piece_name("c", "a/b", 12) == "a-b-0012 of c"
