"""Workflow of a search: trees, constraints over REST and files, on a real server with a real worker."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.support.command_line import CommandLine
from tests.support.present import present

from marey_client.errors import Invalid, RequestFailed
from marey_client.handles.models import ModelHandle
from marey_client.handles.skeletons import SkeletonHandle
from marey_client.project import ProjectHandle
from marey_motion.documents import clip_from_document
from marey_motion.formats import read_motion
from marey_motion.kinematics import global_positions
from marey_schemas.queue.jobs import ItemInput, JobCreate

pytestmark = pytest.mark.timeout(300)

EXAMPLES = 12
SAMPLES = 1500
QUICK: dict[str, Any] = {"leave_one_out": False, "report_samples": 0, "report": False}
"""Options of a model that is trained without measuring how good it is."""
AHEAD = {"type": "root_position", "at": "end", "target_m": [None, 1.2]}
TAIL = {"type": "joint_position", "at": "end", "joint": "tail", "target_m": [0, 0, 0]}


@pytest.fixture(scope="module")
def bare(lab: ProjectHandle) -> ModelHandle:
    """A model without a tree."""
    return lab.model(lab.train_model("aligned", name="bare", into="models", **QUICK))


@pytest.fixture(scope="module")
def walk(lab: ProjectHandle) -> ModelHandle:
    """A model with a tree."""
    made = lab.model(lab.train_model("aligned", name="walk", into="models", **QUICK))
    made.make_tree(seed=3, samples=SAMPLES)
    return lab.models.get(made.id)


def test_a_tree_becomes_a_part_of_its_model_and_leaves_the_others(walk: ModelHandle) -> None:
    assert set(walk.item.parts) == {"model", "tree"}
    assert walk.path == "models/walk"
    tree = walk.part("tree")
    assert tree["model_digest"] == walk.item.parts["model"].document
    assert tree["samples"].shape == (SAMPLES, walk.document()["mixture"]["means"].shape[1])
    assert (tree["seed"], tree["options"]["samples"]) == (3, SAMPLES)
    assert [(edge.item, edge.revision) for edge in walk.lineage().inputs] == [(walk.id, 1)]


def test_the_same_seed_makes_the_same_tree(lab: ProjectHandle, walk: ModelHandle) -> None:
    before = walk.item.parts["tree"].document
    params = {"samples": SAMPLES}
    job = JobCreate(kind="tree", inputs={"model": ItemInput(item=walk.id)}, params=params, seed=3, cache="off")
    lab.model(lab.submit(job))
    assert lab.models.get(walk.id).item.parts["tree"].document == before


def test_a_tree_does_not_go_elsewhere(lab: ProjectHandle, bare: ModelHandle) -> None:
    with pytest.raises(Invalid, match="part of its model"):
        lab.submit(JobCreate(kind="tree", inputs={"model": bare.as_input()}, into="elsewhere"))


def test_a_search_comes_near_to_what_is_asked(walk: ModelHandle) -> None:
    answer = walk.search([AHEAD], likelihood_weight=0.01)
    (error,) = answer.errors
    assert answer.reached
    assert error.error_cm is not None
    assert error.error_cm < 0.1
    assert error.error_cm < present(error.searched_error) < 5.0
    (step,) = answer.steps
    assert step.tree == "stored"
    assert (step.model.item, step.model.revision) == (walk.id, 2)
    assert step.likelihood_percentile is not None
    assert 0.0 <= step.likelihood_percentile <= 100.0
    assert answer.motion is not None


def test_the_motion_that_is_sent_does_what_was_asked(lab: ProjectHandle, walk: ModelHandle) -> None:
    wanted = {"type": "joint_position", "joint": "left_wrist", "at": "end", "target_m": [0.25, 0.9, 1.2]}
    answer = walk.search([wanted], start={"x": 0.0, "z": 0.0, "heading_deg": 0.0}, finish=True)
    assert answer.motion is not None
    skeleton = lab.skeletons.get(walk.document()["skeleton"]["item"])
    clip = clip_from_document(answer.motion, _skeleton_of(skeleton))
    joint = clip.skeleton.index_of(_standard_joint(skeleton, "left_wrist"))
    reached = global_positions(clip)[-1, joint]
    (error,) = answer.errors
    assert error.finished_error is not None
    assert error.finished_error < 0.1
    np.testing.assert_allclose(reached, (0.25, 0.9, 1.2), atol=2e-3)


def test_a_model_without_a_tree_is_searched_with_one_drawn_for_it(bare: ModelHandle) -> None:
    answer = bare.search([AHEAD], refine=False)
    assert [step.tree for step in answer.steps] == ["drawn"]
    assert bare.search([AHEAD], refine=False, seed=1).steps[0].latent != answer.steps[0].latent


def test_a_tree_of_a_model_that_was_trained_anew_is_not_used(lab: ProjectHandle) -> None:
    made = lab.model(lab.train_model("aligned", name="changing", into="models", **QUICK))
    made.make_tree(samples=500)
    again = lab.model(lab.train_model("aligned", name="changing", into="models", **QUICK, scaling="none"))
    assert again.id == made.id
    assert set(again.item.parts) == {"model", "tree"}
    assert [step.tree for step in again.search([AHEAD]).steps] == ["drawn"]


def test_the_same_question_has_the_same_answer(walk: ModelHandle) -> None:
    body = json.dumps({"constraints": [AHEAD]}).encode()
    answers = {walk.transport.send("POST", f"{walk.url}/search", content=body).content for _ in range(3)}
    assert len(answers) == 1


def test_several_steps_follow_one_another(walk: ModelHandle, bare: ModelHandle) -> None:
    steps: list[dict[str, Any]] = [
        {"constraints": [{**AHEAD, "target_m": [0.1, 1.1]}]},
        {"model": bare.id, "constraints": [{**AHEAD, "target_m": [0.3, 2.2]}]},
    ]
    answer = walk.search(steps=steps, start={"x": 0.1, "z": 0.0, "heading_deg": 5.0})
    assert [step.model.item for step in answer.steps] == [walk.id, bare.id]
    assert answer.motion is not None
    frames = [round(step.duration_s * answer.motion.frame_rate_hz) for step in answer.steps]
    assert len(answer.motion.poses) == sum(frames) + 1
    jumps = np.linalg.norm(np.diff(answer.motion.poses[:, :3], axis=0), axis=1)
    assert jumps[frames[0] - 1 : frames[0] + 1].max() < 1.2 * jumps.max(initial=0.0, where=away_from(frames[0], jumps))
    assert answer.steps[1].jumps_cm["pelvis"] < 5.0


def away_from(seam: int, jumps: np.ndarray) -> np.ndarray:
    return np.abs(np.arange(len(jumps)) - seam + 0.5) > 1.0


def test_what_was_found_becomes_a_file_that_reads_back(walk: ModelHandle, tmp_path: Path) -> None:
    answer = walk.search([AHEAD])
    assert answer.motion is not None
    for form in ("bvh", "npz"):
        file = walk.save_search(tmp_path / f"found.{form}", [AHEAD], format=form)
        clip = read_motion(file.read_bytes(), file.name).clip
        assert clip is not None
        np.testing.assert_allclose(clip.root_translations, answer.motion.poses[:, :3], atol=1e-5)


@pytest.mark.parametrize(
    ("body", "status", "pointer"),
    [
        ({"constraints": [{**AHEAD, "at": "nowhere"}]}, 422, "/constraints/0/at"),
        ({"constraints": [{**AHEAD, "at": 1e6}]}, 422, "/constraints/0/at"),
        ({"constraints": [{**AHEAD, "target_m": [None, None]}]}, 422, "/constraints/0/target_m"),
        ({"constraints": [TAIL]}, 422, "/constraints/0"),
        ({"constraints": [{**AHEAD, "type": "wish"}]}, 422, "/constraints/0"),
        ({"constraints": [{**AHEAD, "tolerance_cm": 0}]}, 422, "/constraints/0"),
        ({"steps": [{"constraints": [{**AHEAD, "at": "nowhere"}]}]}, 422, "/steps/0/constraints/0/at"),
        ({"steps": [{}], "constraints": [AHEAD]}, 422, ""),
        ({"constraints": [AHEAD] * 65}, 422, "/constraints"),
        ({"steps": [{"model": "model_nothing"}]}, 404, None),
    ],
)  # fmt: skip
def test_questions_that_make_no_sense_are_refused(
    walk: ModelHandle, body: dict[str, Any], status: int, pointer: str | None
) -> None:
    with pytest.raises(RequestFailed) as caught:
        walk.transport.send("POST", f"{walk.url}/search", content=json.dumps(body).encode())
    assert caught.value.status == status, caught.value
    if pointer is not None:
        assert any(error.pointer.startswith(pointer) for error in caught.value.problem.errors), caught.value.problem


def test_only_models_are_searched(lab: ProjectHandle) -> None:
    clip = next(iter(lab.clips.list()))
    with pytest.raises(RequestFailed, match="models can"):
        lab.transport.send("POST", f"{clip.url}/search", content=b'{"constraints": []}')


def test_from_the_command_line(run: CommandLine, walk: ModelHandle, bare: ModelHandle, tmp_path: Path) -> None:
    asked = ("--at", "end:left_wrist=_,0.9,1.2", "--stand", "start=0,0", "--lambda", 0.01)
    told = run("search", "lab/models/walk", *asked, "--out", "found.bvh").stdout
    assert "joint_position left_wrist" in told
    assert "likelier than" in told
    assert (tmp_path / "found.bvh").read_bytes().startswith(b"HIERARCHY")
    answer = json.loads(run("search", "lab/models/walk", "--face", "end=5", "--json").stdout)["answer"]
    assert answer["errors"][0]["type"] == "root_heading"
    assert "500 samples" in run("tree", f"lab/models/{bare.name}", "--samples", "500").stdout
    assert "a search needs at least one constraint" in run("search", "lab/models/walk", status=2).stderr
    assert "WHEN:JOINT" in run("search", "lab/models/walk", "--at", "left_wrist", status=2).stderr
    assert "no keyframe 'never'" in run("search", "lab/models/walk", "--stand", "never=0,0", status=1).stderr


def _skeleton_of(handle: SkeletonHandle) -> Any:
    from marey_motion.documents import skeleton_from_document

    return skeleton_from_document(handle.hierarchy())


def _standard_joint(handle: SkeletonHandle, name: str) -> str:
    return str(handle.mapping().joints[name])
