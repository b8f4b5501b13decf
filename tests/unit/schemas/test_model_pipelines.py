"""Conversion of a plan for a model to a pipeline of jobs, from takes to the model, with the inputs of each job."""

from typing import Any

import pytest
from pydantic import ValidationError

from marey_schemas.queue.job_kinds import find_kind
from marey_schemas.queue.model_pipelines import ModelPlan, model_pipeline
from marey_schemas.queue.pipelines import job_of_step, order_steps

FILES = {"files": {"files": [{"name": "walk.bvh", "blob": f"sha256:{'0' * 64}"}]}}
CLIPS = {"clips": [{"collection": "raw"}]}
STEPS = {"annotate": {"proposal": {"method": "steps"}}}
LAYER = {"annotations": [{"item": "annotation_1"}]}
GAME = {"skeleton": {"item": "skeleton_1"}}


def plan(*choices: dict[str, Any]) -> ModelPlan:
    merged: dict[str, Any] = {"name": "walk", "into": "models"}
    for choice in choices:
        merged |= choice
    return ModelPlan.model_validate(merged)


def wiring(made: ModelPlan) -> dict[str, dict[str, Any]]:
    """Return the inputs of every step in the form in which they are sent, in the order of the steps."""
    pipeline = model_pipeline(made)
    dumped = pipeline.model_dump(mode="json", exclude_unset=True)["steps"]
    return {name: dumped[name].get("inputs", {}) for name in order_steps(pipeline)}


def test_takes_that_are_examples_are_aligned_as_they_are() -> None:
    assert wiring(plan(CLIPS)) == {
        "align": {"clips": [{"collection": "raw"}]},
        "model": {"aligned": {"step": "align"}},
        "tree": {"model": {"step": "model"}},
    }


def test_files_are_imported_carried_over_annotated_and_cut_before_they_are_aligned() -> None:
    assert wiring(plan(FILES, GAME, STEPS, {"cut": {"labels": ["step_left"]}})) == {
        "import": {},
        "retarget": {"clips": {"step": "import"}, "skeleton": {"item": "skeleton_1"}},
        "annotate": {"clips": {"step": "retarget"}},
        "cut": {"annotations": {"step": "annotate"}, "clips": {"step": "retarget"}},
        "align": {"clips": {"step": "cut"}, "annotations": {"step": "cut"}},
        "model": {"aligned": {"step": "align"}},
        "tree": {"model": {"step": "model"}},
    }


def test_clips_are_cut_along_annotations_that_are_there_before_they_are_carried_over() -> None:
    found = wiring(plan(CLIPS, GAME, LAYER, {"cut": {}}))
    assert list(found) == ["cut", "retarget", "align", "model", "tree"]
    assert found["retarget"]["clips"] == {"step": "cut"}
    assert found["align"] == {"clips": {"step": "retarget"}}


def test_whole_takes_are_aligned_by_their_annotations() -> None:
    assert wiring(plan(CLIPS, LAYER))["align"]["annotations"] == [{"item": "annotation_1"}]
    assert wiring(plan(CLIPS, STEPS))["align"] == {
        "clips": [{"collection": "raw"}],
        "annotations": {"step": "annotate"},
    }


def test_mappings_that_were_edited_are_gone_by_wherever_the_clips_skeleton_is_read() -> None:
    rigs = {"rigs": [{"item": "skeleton_2"}]}
    found = wiring(plan(CLIPS, rigs, STEPS))
    assert (found["annotate"]["rigs"], found["align"]["rig"]) == ([{"item": "skeleton_2"}], {"item": "skeleton_2"})
    carried = wiring(plan(CLIPS, rigs, STEPS, GAME))
    assert carried["retarget"]["rigs"] == [{"item": "skeleton_2"}]
    assert "rigs" not in carried["annotate"]
    assert "rig" not in carried["align"]


def test_every_step_is_a_job_its_kind_takes_with_a_place_of_its_own() -> None:
    made = plan(FILES, GAME, STEPS, {"cut": {}, "align": {"rate_hz": 30}, "tree": {"samples": 100}})
    pipeline = model_pipeline(made, seed=5, priority=3)
    places = {}
    for name in order_steps(pipeline):
        job = job_of_step(pipeline, name, dict.fromkeys(pipeline.steps, "job_1"))
        kind = find_kind(job.kind)
        kind.params.model_validate(job.params)
        assert job.inputs.keys() <= kind.inputs.keys()
        assert (job.seed, job.priority) == (5, 3)
        places[name] = job.into
    assert places == {
        "import": "models/takes",
        "retarget": "models/retargeted",
        "annotate": "models/annotations",
        "cut": "models/pieces",
        "align": "models/aligned",
        "model": "models",
        "tree": "",
    }
    assert pipeline.steps["model"].params == {"name": "walk"}
    assert pipeline.steps["align"].params == {"rate_hz": 30}


def test_a_model_can_do_without_a_tree() -> None:
    assert "tree" not in wiring(plan(CLIPS, {"tree": None}))


@pytest.mark.parametrize(
    ("choices", "reason"),
    [
        ((), "either files"),
        ((FILES, CLIPS), "either files"),
        ((FILES, LAYER), "annotations: can be combined only with `clips`"),
        ((CLIPS, LAYER, STEPS), "annotations: can be combined only with `clips`"),
        ((CLIPS, {"cut": {}}), "needs annotations"),
        ((CLIPS, LAYER, GAME), "cannot be used after retargeting"),
        ((CLIPS, {"align": {"window": 4}}), "odd"),
    ],
)
def test_plans_that_make_no_sense_are_refused_with_a_reason(choices: tuple[dict[str, Any], ...], reason: str) -> None:
    with pytest.raises(ValidationError, match=reason):
        plan(*choices)
