"""The functions of four job kinds (`compare`, `suggest`, `optimise`, `sweep`), with a project in memory."""

import json
from dataclasses import replace
from math import radians
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.support.project_in_memory import PARAMS, ProjectInMemory, add_clip
from tests.support.report_pages import is_sound

from marey_motion.clip import Clip
from marey_motion.documents import mapping_to_document
from marey_motion.gait import generate_gait
from marey_motion.rigs import map_joints
from marey_schemas.encoding.codecs import JSON, decode_tree
from marey_schemas.kinds import Kind
from marey_schemas.lru import LruCache
from marey_schemas.options.matching import DatabaseOptions
from marey_schemas.queue.job_params import CompareParams, OptimiseParams, SuggestParams, SweepParams
from marey_schemas.queue.worker_protocol import PinnedInput
from marey_worker.context import JobRefused, Task
from marey_worker.job_io import matching_clips, skeleton_cache
from marey_worker.kinds import compare, evaluate, optimise, suggest, sweep


class LoggedProject(ProjectInMemory):
    """Project that records what jobs log."""

    def log(self, text: str) -> None:
        self.lines = [*getattr(self, "lines", []), text]


@pytest.fixture
def project(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> LoggedProject:
    """A project with three walks and one clip that no trial needs; the cache of skeletons is empty."""
    monkeypatch.setattr(matching_clips, "_cache", LruCache(max_entries=1))
    monkeypatch.setattr(skeleton_cache, "_skeletons", LruCache(max_entries=4))
    made = LoggedProject(tmp_path)
    for speed, turn_rate in ((1.25, -50), (1.25, 0), (1.25, 50), (4.0, 0)):
        add_clip(made, f"walk {speed} {turn_rate}", generate_gait(speed, radians(turn_rate), 5.0))
    return made


def evaluated(project: LoggedProject, name: str, clips: tuple[Any, ...], **changes: Any) -> PinnedInput:
    """Evaluate some clips, with the parameters `changes`; return the evaluation as an input of a job."""
    every, params = project.inputs.get("clips", ()), PARAMS.model_copy(update=changes)
    project.inputs["clips"] = clips
    evaluate.gather(project, params, [evaluate.run(project, params)])
    project.inputs["clips"] = every
    for part, tree in project.staged[-1].parts.items():
        project.parts[name, 1, part] = tree
    return PinnedInput(item=name, revision=1, kind=Kind.EVALUATION, name=name, collection="results")


def of_taller_person(clip: Clip) -> Clip:
    """Return the same motion with longer bones."""
    poses = clip.poses.copy()
    poses[:, 1] *= 1.1  # the hips' height; the path on the ground stays
    return replace(clip, skeleton=replace(clip.skeleton, offsets=clip.skeleton.offsets * 1.1), poses=poses)


def document_of(project: LoggedProject, result: dict[str, Any]) -> dict[str, Any]:
    return decode_tree(project.blobs[result["document"]["blob"]], JSON)


def test_an_evaluation_and_itself_differ_in_nothing(project: LoggedProject) -> None:
    own = evaluated(project, "first", project.inputs["clips"])
    project.inputs = {"before": (own,), "after": (own,)}
    result = compare.run(project, CompareParams(report=False))
    assert (result["changed_trials"], result["better"], result["worse"]) == (0, [], [])
    assert "report" not in result
    assert document_of(project, result)["names"] == {"before": "results/first", "after": "results/first"}


def test_evaluations_under_two_normalisers_are_refused_with_what_to_type(project: LoggedProject) -> None:
    clips = project.inputs["clips"]
    first, second = evaluated(project, "first", clips), evaluated(project, "second", clips[:2])
    project.inputs = {"before": (first,), "after": (second,)}
    with pytest.raises(JobRefused, match="`marey evaluate … --normaliser PROJECT/results/first`") as refused:
        compare.run(project, CompareParams())
    assert refused.value.code == "not-comparable"


def test_several_sets_under_one_normaliser_are_compared_with_the_first_in_one_report(project: LoggedProject) -> None:
    clips = project.inputs["clips"]
    union = evaluated(project, "union", clips)
    project.inputs["normaliser"] = (union,)
    left, right = evaluated(project, "left", clips[1:]), evaluated(project, "right", clips[:3])
    project.inputs = {"before": (union,), "after": (left,), "others": (right, union)}
    result = compare.run(project, CompareParams())
    document = document_of(project, result)
    assert [one["names"]["after"] for one in document["others"]] == ["results/right", "results/union"]
    assert document["removed"] == [f"{clips[0].item}@1"]
    assert [one["removed"] for one in result["others"]] == [1, 0]
    assert result["others"][1]["changed_trials"] == 0
    page = project.blobs[result["report"]["blob"]].decode()
    assert all(
        text in page
        for text in ("than results/union", "results/left", "Sets of clips", "1 replicate, so it is unknown")
    )
    assert page.count("<svg") >= 2, "distances and density of all sets"

    project.inputs["others"] = (right,) * 7
    with pytest.raises(JobRefused, match="9 evaluations cannot be compared at once; choose up to 8"):
        compare.run(project, CompareParams())


def test_what_can_go_is_named_and_clips_of_other_skeletons_need_to_be_retargeted(project: LoggedProject) -> None:
    clips = project.inputs["clips"]
    own = evaluated(project, "first", clips[1:2])
    add_clip(project, "tall", of_taller_person(generate_gait(1.25, radians(50), 5.0)), skeleton="skeleton_b")
    project.inputs = {"evaluation": (own,), "candidates": project.inputs["clips"]}
    result = suggest.run(project, SuggestParams(removals=0, consider=0, confirmation_replicates=0))
    fillings = {one["name"]: one["needs_retarget"] for one in document_of(project, result)["fillings"]}
    assert fillings["walks/tall"]
    assert not fillings["walks/walk 1.25 50"]
    assert clips[1].name not in " ".join(fillings)
    assert result["needing_retarget"] == 1


def sunk(clip: Clip, depth_m: float) -> Clip:
    """Return the same motion, lower by `depth_m` metres."""
    poses = clip.poses.copy()
    poses[:, 1] -= depth_m
    return replace(clip, poses=poses)


def test_a_clip_that_fills_a_gap_is_named_if_its_defects_exceed_those_of_the_set(project: LoggedProject) -> None:
    clips = project.inputs["clips"]
    own = evaluated(project, "first", clips[1:2])
    add_clip(project, "sunk", sunk(generate_gait(1.25, radians(50), 5.0), 0.3))
    project.inputs = {"evaluation": (own,), "candidates": project.inputs["clips"]}
    result = suggest.run(project, SuggestParams(removals=0, consider=0, confirmation_replicates=0))
    document = document_of(project, result)
    found = {one["name"]: one for one in document["fillings"]}
    assert found["walks/walk 1.25 50"]["quality"]["excesses"] == []
    (excess,) = found["walks/sunk"]["quality"]["excesses"]
    assert (excess["measure"], excess["greatest"]) == ("penetration_max_m", pytest.approx(0.0, abs=0.02))
    assert excess["value"] == pytest.approx(0.3, abs=0.02)
    assert found["walks/sunk"]["quality"]["compared"] == 1
    assert "Look at it before you add it" in found["walks/sunk"]["reason"]
    page = is_sound(project.blobs[result["report"]["blob"]].decode())
    assert found["walks/sunk"]["reason"] in page.text
    assert "look at “walks/sunk” before you add it" in document["quality"]["reason"]
    assert document["quality"]["reason"] in page.text


def after_rest_pose(clip: Clip) -> Clip:
    """Return the same motion after one frame in the rest pose, as in many BVH files."""
    rest = clip.poses[:1].copy()
    rest[:, 3:] = np.tile((1.0, 0.0, 0.0, 0.0), clip.skeleton.joint_count)
    return replace(clip, poses=np.concatenate([rest, clip.poses]))


def evaluated_alone(
    project: LoggedProject, clip: Clip, *, skeleton: str = "skeleton_a", rig: PinnedInput | None = None, **changes: Any
) -> PinnedInput:
    """Evaluate one clip, with the parameters `changes`; return the evaluation as an input of a job."""
    project.inputs = {} if rig is None else {"rig": (rig,)}
    add_clip(project, "own", clip, skeleton)
    return evaluated(project, f"set {len(project.staged)}", project.inputs["clips"], **changes)


def suggestions_beside(project: LoggedProject, own: PinnedInput, candidate: Clip) -> dict[str, Any]:
    """Return the suggestions for an evaluated set with one candidate."""
    project.inputs = {}
    add_clip(project, "other", candidate)
    project.inputs = {"evaluation": (own,), "candidates": project.inputs["clips"]}
    return document_of(project, suggest.run(project, SuggestParams(removals=0, consider=0, confirmation_replicates=0)))


def excesses_beside(project: LoggedProject, of_set: Clip, candidate: Clip, **changes: Any) -> list[dict[str, Any]]:
    """Evaluate one clip, with the parameters `changes`; return in which measures a candidate is far worse."""
    (filling,) = suggestions_beside(project, evaluated_alone(project, of_set, **changes), candidate)["fillings"]
    assert filling["quality"]["compared"] == 1
    return filling["quality"]["excesses"]


def test_the_jump_from_a_rest_pose_is_no_defect_and_hides_none(project: LoggedProject) -> None:
    straight, turning = generate_gait(1.25, 0.0, 5.0), generate_gait(1.25, radians(50), 5.0)
    assert excesses_beside(project, straight, after_rest_pose(turning)) == []
    poses = turning.poses.copy()
    poses[100:108, 1] += 0.2
    jumps = replace(turning, poses=poses)
    (excess,) = excesses_beside(project, after_rest_pose(straight), jumps)
    assert excess["measure"] == "jerk_peak_m_s3"


def test_frames_of_the_set_outside_its_trims_do_not_hide_defects(project: LoggedProject) -> None:
    straight, turning = generate_gait(1.25, 0.0, 6.0), sunk(generate_gait(1.25, radians(50), 5.0), 0.3)
    poses = straight.poses.copy()
    poses[320:, 1] -= 0.5
    trims = {"clip_own": (20, 300)}
    (excess,) = excesses_beside(project, replace(straight, poses=poses), turning, trims=trims)
    assert (excess["measure"], excess["greatest"]) == ("penetration_max_m", pytest.approx(0.0, abs=0.02))


def test_clips_of_a_low_rate_are_compared_only_if_the_evaluation_has_a_low_rate(project: LoggedProject) -> None:
    straight, turning = (generate_gait(1.25, radians(turn), 5.0, frame_rate_hz=25.0) for turn in (0, 50))
    own = evaluated_alone(project, straight)
    document = suggestions_beside(project, own, turning)
    assert document["quality"]["reason"].startswith("None of them could be measured")
    (filling,) = document["fillings"]
    assert filling["reason"].endswith("not measured: it has 25 frames per second, fewer than the 30 that are measured.")
    document = suggestions_beside(project, own, generate_gait(1.25, radians(50), 5.0))
    assert document["quality"]["reason"].startswith("No clip of the set could be measured")
    own = evaluated_alone(project, straight, database=DatabaseOptions(rate_hz=25.0))
    (filling,) = suggestions_beside(project, own, turning)["fillings"]
    assert (filling["quality"]["compared"], filling["quality"]["problem"]) == (1, None)


def test_clips_are_measured_with_the_joint_mapping_of_the_set(project: LoggedProject) -> None:
    straight, turning = generate_gait(1.25, 0.0, 5.0), generate_gait(1.25, radians(50), 5.0)
    mapping = map_joints(straight.skeleton)
    for revision, known in ((1, replace(mapping, confidence=0.0)), (2, mapping)):
        document = mapping_to_document(known, {}).model_dump(by_alias=True)
        project.parts["skeleton_edited", revision, "mapping"] = document
    rig = PinnedInput(item="skeleton_edited", revision=2, kind=Kind.SKELETON, name="edited", collection="rigs")
    own = evaluated_alone(project, straight, skeleton="skeleton_edited", rig=rig)
    (filling,) = suggestions_beside(project, own, turning)["fillings"]
    assert (filling["quality"]["compared"], filling["quality"]["problem"]) == (1, None)


def test_suggestions_publish_the_harm_of_each_removal(project: LoggedProject) -> None:
    clips = project.inputs["clips"]
    own = evaluated(project, "first", clips)
    project.inputs, project.facets = {"evaluation": (own,)}, []
    result = suggest.run(project, SuggestParams(removals=0, estimation_replicates=1, confirmation_replicates=0))
    document = document_of(project, result)
    page = is_sound(project.blobs[result["report"]["blob"]].decode())
    assert document["unused"]["clips"][0]["reason"] in page.text
    harms = {one.item: one.values["removal_harm"] for one in project.facets}
    assert harms[clips[3].item] == 0, "no trial needs this clip"
    needed = {removal["source"].split("@")[0]: removal["harm"] for removal in document["redundant"]["clips"]}
    assert needed
    assert harms == {clips[3].item: 0.0, **needed}
    assert {one.revision for one in project.facets} == {1}


def test_every_step_of_an_optimisation_is_logged_and_kept(project: LoggedProject) -> None:
    clips = project.inputs["clips"]
    own = evaluated(project, "first", clips[1:2])
    project.inputs = {"evaluation": (own,), "candidates": clips}
    result = optimise.run(project, OptimiseParams(max_steps=2, estimation_replicates=2, confirmation_replicates=3))
    steps = document_of(project, result)["steps"]
    assert len(steps) == result["steps"] + 1
    assert [line.split(":")[0] for line in project.lines] == [*(f"step {step['number']}" for step in steps), "ended"]
    objectives = [step["objective"] for step in steps]
    assert objectives == sorted(objectives, reverse=True)
    assert objectives[-1] < objectives[0]


def test_a_sweep_is_the_same_however_many_tasks_it_is_spread_over(project: LoggedProject) -> None:
    own = evaluated(project, "first", project.inputs["clips"])
    project.inputs = {"evaluation": (own,)}
    params = SweepParams(factors=(0.5,), estimation_replicates=1, confirmation_replicates=0)
    whole = sweep.gather(project, params, [sweep.run(project, params)])
    results = []
    for position in range(3):
        project.task = Task(position, 3)
        results.append(json.loads(json.dumps(sweep.run(project, params))))
    assert sweep.gather(project, params, results) == whole
    assert whole["settings"] == 8
