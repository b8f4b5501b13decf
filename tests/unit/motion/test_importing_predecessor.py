"""Import of the predecessor's skeletons, skeleton models and notes: what fits, and what is refused with what to do."""

from __future__ import annotations

import datetime
from typing import Any

import numpy as np
import pytest
from tests.support import predecessor_documents as old

from marey_motion.importing.files import import_file
from marey_motion.importing.items import FileToImport, ImportedFile
from marey_motion.importing.plan import plan_imports
from marey_schemas.kinds import Kind
from marey_schemas.options.imports import ImportOptions

DIGESTS = [f"sha256:{number}{'0' * 63}" for number in range(3)]


def import_all(documents: dict[str, dict[str, Any]], **options: Any) -> dict[str, ImportedFile]:
    """Import documents as a server does, each with its companion and its notes."""
    files = {name: old.encode(document, name) for name, document in documents.items()}
    return {
        one.name: import_file(
            FileToImport(
                one, files[one.name], DIGESTS[0], ImportOptions(**options),
                companion=None if one.companion is None else files[one.companion], companion_digest=DIGESTS[1],
                notes=None if one.notes is None else files[one.notes], notes_digest=DIGESTS[2],
            )
        )
        for one in plan_imports(list(files))
        if one.role in ("motion", "skeleton")
    }  # fmt: skip


def refusal(documents: dict[str, dict[str, Any]], file: str, **options: Any) -> tuple[str, str]:
    refused = import_all(documents, **options)[file].refusal
    assert refused is not None
    return refused.code, refused.detail


CLIP = {"skeleton.json": old.database_skeleton(), "walk.bson": old.clip(old.poses_of(40))}


def segments(sections: dict[str, Any], **options: Any) -> dict[str, list[tuple[str, int, int]]]:
    found = import_all({**CLIP, "walk_sections.json": sections}, **options)["walk.bson"]
    assert found.refusal is None, found.refusal
    return {
        item.item_name: [(one["label"], one["start"], one["end"]) for one in item.parts["annotation"]["segments"]]
        for item in found.items
        if item.kind is Kind.ANNOTATION
    }


def test_sections_are_inclusive_unless_they_would_overlap_or_the_user_knows_better() -> None:
    apart = {"sections": {"a": [{"start_idx": 0, "end_idx": 9}], "b": [{"start_idx": 10, "end_idx": -1}]}}
    touching = {"sections": {"a": [{"start_idx": 0, "end_idx": 10}], "b": [{"start_idx": 10, "end_idx": 40}]}}
    expected = {"walk imported": [("a", 0, 10), ("b", 10, 40)]}
    assert segments(apart) == segments(touching) == expected
    assert segments(apart, end_index="exclusive") == {"walk imported": [("a", 0, 9), ("b", 10, 40)]}
    detail = refusal({**CLIP, "walk_sections.json": touching}, "walk.bson", end_index="inclusive")[1]
    assert detail.startswith("walk_sections.json: ")


def test_labels_that_overlap_become_one_annotation_each() -> None:
    both = {"semantic_annotation": {"left": [0, 1, 2], "right": [2, 3]}}
    assert segments(both) == {"walk left": [("left", 0, 3)], "walk right": [("right", 2, 4)]}
    many = {"semantic_annotation": {f"label {number}": [0, 1] for number in range(65)}}
    detail = refusal({**CLIP, "walk_sections.json": many}, "walk.bson")[1]
    assert "the file has 65 labels, more than the limit of 64; correct this section, or split the file" in detail


def test_an_aligned_clip_is_told_by_the_time_function_in_its_notes() -> None:
    notes = {"sections": [{"start_idx": 0, "end_idx": 20}, {"start_idx": 20, "end_idx": -1}]}
    found = import_all({**CLIP, "walk_sections.json": {**notes, "time_function": old.TIME_FUNCTION}})["walk.bson"]
    (aligned,) = [item for item in found.items if item.kind is not Kind.SKELETON]
    assert aligned.kind is Kind.PROCESSED
    info = aligned.parts["info"]
    assert (info["source_frames"], info["keyframes"]) == (47, {"contact0": 20})
    assert np.abs(info["time_function"] - old.TIME_FUNCTION).max() < 1.0
    short = {**notes, "time_function": old.TIME_FUNCTION[:30]}
    code, detail = refusal({**CLIP, "walk_sections.json": short}, "walk.bson")
    assert (code, "30 canonical frames, but the clip 40" in detail) == ("time-function-invalid", True)


@pytest.mark.parametrize(
    ("name", "document", "told"),
    [
        ("lost_sections.json", {"sections": []}, "walk_sections.json needs walk.bvh or walk.bson.bz2"),
        ("lost_skeleton_model.json", {"model": old.skeleton_model()}, "body_skeleton_model.json needs body_skeleton."),
        ("run.json", {"data_transform_id": 3, "hparams": {}}, "Marey imports clips, skeletons"),
    ],
)  # fmt: skip
def test_documents_that_cannot_stand_alone_are_refused_with_what_they_need(
    name: str, document: dict[str, Any], told: str
) -> None:
    assert told in refusal({name: document}, name)[1]


def mapping(model: dict[str, Any], skeleton: str = "body.skeleton") -> dict[str, Any]:
    found = import_all({skeleton: old.file_skeleton(), "body_skeleton_model.json": model})[skeleton]
    assert found.refusal is None, found.refusal
    part: dict[str, Any] = found.items[0].parts["mapping"]
    return part


def test_a_skeleton_model_decides_joints_and_axes_wherever_it_is_stored() -> None:
    model = old.skeleton_model()
    inside = import_all({"body.skeleton": old.file_skeleton(model=model)})["body.skeleton"].items[0].parts["mapping"]
    beside = mapping({"name": "body", "model": model})
    assert beside["joints"] == inside["joints"]
    assert {**beside["axes"]} == {**inside["axes"]}
    assert beside["predecessor"]["rest"] == inside["predecessor"]["rest"]
    assert beside["predecessor"]["rest"]["foot_correction"] == {"x": -22, "y": 3}
    assert (beside["predecessor"]["model"]["blob"], "model" in inside["predecessor"]) == (DIGESTS[1], False)
    assert "spine_1" not in beside["joints"]
    for axes in beside["axes"].values():
        assert np.dot(axes["twist"], axes["swing"]) == pytest.approx(0.0, abs=1e-9)
        assert np.linalg.norm(axes["swing"]) == pytest.approx(1.0)
    assert beside["axes"]["RightArm"]["twist"] == [-1.0, 0.0, 0.0]
    plain = import_all({"body.skeleton": old.file_skeleton()})["body.skeleton"].items[0].parts["mapping"]
    assert (plain["method"], plain["predecessor"].keys()) == ("names", {"skeleton"})
    lone = mapping({**model, "cos_map": {"LeftHand": {"x": [0.0, 3.0, 0.0], "y": None}}})
    assert lone["axes"]["LeftHand"]["swing"] == [0.0, 1.0, 0.0]


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"joints": {"left_knee": "Tail"}}, "joint Tail: field 'joints' of the skeleton model names a joint"),
        ({"joints": {"leftknee": "LeftLeg"}}, "'leftknee' is not a standard joint"),
        ({"cos_map": {"Tail": {"x": None, "y": None}}}, "joint Tail: field 'cos_map' of the skeleton model"),
        ({"cos_map": {"Hips": {"x": [0, 0, 0], "y": None}}}, "the axis 'x' must be three numbers that are not all"),
        ({"cos_map": {"Hips": 3}}, "'axes' must be dict"),
    ],
)
def test_skeleton_models_that_do_not_fit_are_refused_by_the_joint(changes: dict[str, Any], told: str) -> None:
    files = {"body.skeleton": old.file_skeleton(), "body_skeleton_model.json": {**old.skeleton_model(), **changes}}
    detail = refusal(files, "body.skeleton")[1]
    assert detail.startswith("body_skeleton_model.json")
    assert told in detail


def test_a_skeleton_model_with_values_that_are_not_json_is_refused() -> None:
    model = {**old.skeleton_model(), "made": datetime.datetime(2019, 1, 1, tzinfo=datetime.UTC)}
    files = {"body.skeleton": old.file_skeleton(), "body_skeleton_model.bson": model}
    assert "the field 'made' of the skeleton model has a value" in refusal(files, "body.skeleton")[1]
