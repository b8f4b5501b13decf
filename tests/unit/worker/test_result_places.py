"""Paths of the results of jobs with many clips, and the results if one clip cannot be used."""

import io
import zipfile
from collections.abc import Callable
from math import radians
from pathlib import Path
from typing import Any

import pytest
from pydantic import BaseModel
from tests.support.project_in_memory import ProjectInMemory, add_clip

from marey_motion.gait import generate_gait
from marey_schemas.documents.annotations import Annotation
from marey_schemas.kinds import Kind
from marey_schemas.lru import LruCache
from marey_schemas.queue.job_params import (
    AlignParams,
    AnnotateParams,
    CutParams,
    EditParams,
    ExportParams,
    RetargetParams,
)
from marey_schemas.queue.worker_protocol import PinnedInput, StagedOutput
from marey_worker.context import JobRefused
from marey_worker.job_io import skeleton_cache
from marey_worker.job_io.staged_results import StagedResults
from marey_worker.kinds import align, annotate, cut, edit, export, retarget

SHORTER = ({"command": "trim", "stop": 40},)
STEPS = AnnotateParams.model_validate({"proposal": {"method": "steps"}})


@pytest.fixture
def project(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> ProjectInMemory:
    """A project with two walks of one skeleton, and without cached skeletons of earlier tests."""
    monkeypatch.setattr(skeleton_cache, "_skeletons", LruCache(max_entries=4))
    monkeypatch.setattr(skeleton_cache, "_plans", LruCache(max_entries=4))
    made = ProjectInMemory(tmp_path)
    for name, turn in (("left", 20), ("right", -20)):
        add_clip(made, name, generate_gait(1.4, radians(turn), 3.0))
    skeleton = {"item": "skeleton_a", "revision": 1, "kind": Kind.SKELETON, "name": "a", "collection": "rigs"}
    made.inputs["skeleton"] = (PinnedInput(**skeleton),)
    return made


def move(project: ProjectInMemory, into: str, **of_all: Any) -> None:
    """Set the folder of the results to `into`, and fields of all input clips to the values in `of_all`."""
    project.into = into
    project.inputs["clips"] = tuple(pin.model_copy(update=of_all) for pin in project.inputs["clips"])


def again(project: ProjectInMemory, position: int, **changes: Any) -> None:
    """Add a copy of the input clip at `position` as another input, with these fields changed."""
    pin = project.inputs["clips"][position]
    twin = pin.model_copy(update=changes)
    project.parts[twin.item, twin.revision, "motion"] = project.parts[pin.item, pin.revision, "motion"]
    project.inputs["clips"] = (*project.inputs["clips"], twin)


def codes(result: dict[str, Any]) -> list[str]:
    return [one["code"] for one in result["refused"]]


KINDS = {
    "edit": lambda project, **params: edit.run(project, EditParams(commands=SHORTER, **params)),
    "retarget": lambda project, **params: retarget.run(project, RetargetParams(**params)),
}


@pytest.mark.parametrize("kind", KINDS)
def test_a_job_whose_results_would_all_replace_what_they_are_made_of_fails(project: ProjectInMemory, kind: str) -> None:
    move(project, "game", collection="game", below="")
    with pytest.raises(JobRefused, match="game/left, which is an input of the job; choose another folder") as refused:
        KINDS[kind](project)
    assert (refused.value.code, project.staged) == ("nothing-done", [])
    assert KINDS[kind](project, suffix="-short")["clips"] == 2


@pytest.mark.parametrize("kind", KINDS)
def test_a_result_that_would_replace_another_input_is_refused(project: ProjectInMemory, kind: str) -> None:
    again(project, 0, item="clip_other", name="left-short")
    move(project, "", below=None)
    result = KINDS[kind](project, suffix="-short")
    assert (result["clips"], codes(result)) == (2, ["own-input"])


def test_an_edit_in_place_replaces_its_clips(project: ProjectInMemory, monkeypatch: pytest.MonkeyPatch) -> None:
    def pinned(kind: Kind, item: str) -> Any:
        return next(pin.model_copy() for pin in project.inputs["clips"] if (pin.kind, pin.item) == (kind, item))

    monkeypatch.setattr(project, "item", pinned)
    result = KINDS["edit"](project, in_place=True)
    assert (result["clips"], result["refused"]) == (2, [])


@pytest.mark.parametrize("kind", KINDS)
def test_of_two_revisions_of_a_clip_the_second_is_refused(project: ProjectInMemory, kind: str) -> None:
    again(project, 0, revision=2)
    project.into = "out"
    result = KINDS[kind](project)
    assert (result["clips"], codes(result)) == (2, ["same-name"])


def add_annotation(project: ProjectInMemory, clip: str = "clip_left", revision: int = 1) -> None:
    document = Annotation.model_validate(
        {"clip": {"item": clip, "revision": revision}, "segments": [{"label": "a", "start": 0, "end": 30}]}
    )
    project.parts["annotation_1", 1, "annotation"] = document.model_dump(mode="json", by_alias=True)
    pin = {"item": "annotation_1", "revision": 1, "kind": Kind.ANNOTATION, "name": "said", "collection": "walks"}
    project.inputs["annotations"] = (PinnedInput(**pin),)


def test_a_piece_that_would_replace_an_input_is_refused(project: ProjectInMemory) -> None:
    add_annotation(project)
    again(project, 1, item="clip_piece", name="left_a_01")
    with pytest.raises(JobRefused, match="walks/left_a_01, which is an input of the job"):
        cut.run(project, CutParams())
    assert project.staged == []
    project.into = "pieces"
    assert cut.run(project, CutParams())["clips"] == 1


def test_pieces_are_named_after_the_clips_that_are_given_at_any_revision(project: ProjectInMemory) -> None:
    add_annotation(project, revision=2)
    project.parts["clip_left", 2, "motion"] = project.parts["clip_left", 1, "motion"]
    cut.run(project, CutParams())
    assert [output.item_name for output in project.staged if output.kind is Kind.CLIP] == ["left_a_01"]
    project.inputs["clips"] = project.inputs["clips"][1:]
    with pytest.raises(JobRefused, match="not among the given clips"):
        cut.run(project, CutParams())


@pytest.mark.parametrize(
    ("run", "params"), [(annotate.run, STEPS), (align.run, AlignParams(suffix=" aligned"))], ids=["annotate", "align"]
)
def test_results_that_would_get_one_name_are_refused_before_any_is_computed(
    project: ProjectInMemory, run: Callable[..., Any], params: BaseModel
) -> None:
    again(project, 0, revision=2)
    with pytest.raises(JobRefused, match="2 results would have the path walks/left") as refused:
        run(project, params)
    assert (refused.value.code, project.told) == ("same-name", [])


def test_a_clip_called_like_the_mirrored_twin_of_another_is_refused_before_any_is_computed(
    project: ProjectInMemory,
) -> None:
    again(project, 1, item="clip_twin", name="left mirrored")
    with pytest.raises(JobRefused, match="2 results would have the path walks/left mirrored"):
        align.run(project, AlignParams(mirroring="add"))
    assert project.told == []
    align.run(project, AlignParams(mirroring="add", suffix=" aligned"))
    assert len({output.name for output in project.staged}) == len(project.staged) == 6


def test_a_second_result_of_one_name_is_refused_and_does_not_replace_the_first(project: ProjectInMemory) -> None:
    results = StagedResults(project)
    one = StagedOutput(name="a", kind=Kind.CLIP, item_name="a", parts={"motion": {}})
    results.add(one)
    results.flush()
    with pytest.raises(JobRefused, match="two results of the job would have the name a"):
        results.add(one)


def annotated(project: ProjectInMemory) -> dict[str, Any]:
    return annotate.run(project, STEPS)


@pytest.mark.parametrize("run", [*KINDS.values(), annotated], ids=[*KINDS, "annotate"])
def test_a_clip_whose_skeleton_was_deleted_keeps_no_other_from_being_made(
    project: ProjectInMemory, run: Callable[..., Any]
) -> None:
    add_clip(project, "odd", generate_gait(1.2, 0.0, 3.0), skeleton="skeleton_gone")
    del project.parts["skeleton_gone", 1, "hierarchy"]
    project.into = "out"
    result = run(project)
    assert len(project.staged) == 2
    assert [(one["name"], one["code"]) for one in result["refused"]] == [("walks/odd", "no-skeleton")]


@pytest.mark.parametrize("run", [*KINDS.values(), annotated], ids=[*KINDS, "annotate"])
def test_a_clip_that_was_deleted_while_the_job_waited_keeps_no_other_from_being_made(
    project: ProjectInMemory, run: Callable[..., Any]
) -> None:
    del project.parts["clip_left", 1, "motion"]
    project.into = "out"
    result = run(project)
    assert (len(project.staged), codes(result)) == (1, ["no-clip"])


def test_a_target_skeleton_that_cannot_be_used_refuses_the_job_with_its_name(project: ProjectInMemory) -> None:
    mapping = {"schema": "marey/skeleton-mapping@1", "joints": {"pelvis": "Sphere"}}
    project.parts["skeleton_a", 1, "mapping"] = mapping
    with pytest.raises(JobRefused, match=r"skeleton a cannot be used: .*Sphere"):
        KINDS["retarget"](project)
    assert project.staged == []


def test_clips_with_the_same_place_have_files_of_their_own_in_an_archive(project: ProjectInMemory) -> None:
    again(project, 0, item="clip_other")
    again(project, 0, revision=2)
    again(project, 0, revision=3)
    result = export.run(project, ExportParams())
    with zipfile.ZipFile(io.BytesIO(project.blobs[result["archive"]["blob"]])) as archive:
        names = sorted(archive.namelist())
    assert names == sorted(set(names))
    assert names[-2:] == ["walks/left.bvh", "walks/right.bvh"]
    assert (len(names), result["clips"]) == (5, 5)


def test_an_archive_leaves_out_the_clip_whose_skeleton_was_deleted(project: ProjectInMemory) -> None:
    add_clip(project, "odd", generate_gait(1.2, 0.0, 3.0), skeleton="skeleton_gone")
    del project.parts["skeleton_gone", 1, "hierarchy"]
    result = export.run(project, ExportParams())
    assert (result["clips"], codes(result)) == (2, ["no-skeleton"])


@pytest.mark.parametrize("params", [AlignParams, EditParams, RetargetParams])
@pytest.mark.parametrize("suffix", ["/a", "\n", "x" * 65])
def test_a_suffix_that_no_name_may_have_is_refused_before_the_job(params: BaseModel, suffix: str) -> None:
    with pytest.raises(ValueError, match="suffix"):
        params.model_validate({"suffix": suffix})
