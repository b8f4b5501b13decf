"""Searches of models over HTTP: the tree that a search uses, and the refusal of searches that are too large."""

from __future__ import annotations

from typing import Any

import httpx
import numpy as np
import pytest
from tests.support.search_primitives import FRAMES, standard_joints, walking

from marey_motion.documents import skeleton_to_document
from marey_motion.modelling.primitive_documents import primitive_to_tree
from marey_motion.modelling.search.steps import SeveralSteps, Step
from marey_motion.modelling.search.tree import END_EFFECTORS, build_tree
from marey_motion.modelling.search.tree_documents import sample_tree_to_tree
from marey_motion.modelling.search.work import drawing_work, searching_work
from marey_schemas.encoding.codecs import MSGPACK, encode_tree
from marey_schemas.options.modelling import TreeOptions
from marey_schemas.search_constraints import JointPositionConstraint
from marey_server.motions import search_answers, searching

MODELS = "/projects/lab/models"
AHEAD = {"type": "root_position", "at": "end", "target_m": [0, 1]}
FEW = TreeOptions(samples=50, features="latent")


def send(client: httpx.Client, method: str, url: str, tree: object, status: int) -> dict[str, Any]:
    headers = {"Content-Type": MSGPACK, "Accept": "application/json", **({"If-Match": "*"} if method == "PUT" else {})}
    answer = client.request(method, url, content=encode_tree(tree, MSGPACK), headers=headers)
    assert answer.status_code == status, answer.text
    return dict(answer.json())


@pytest.fixture
def document(owner: httpx.Client) -> dict[str, Any]:
    """The document of a model of walks, on a skeleton of the project."""
    primitive = walking()[0]
    hierarchy = skeleton_to_document(primitive.skeleton).model_dump(by_alias=True)
    skeleton = send(owner, "POST", "/projects/lab/skeletons", {"name": "rig", "parts": {"hierarchy": hierarchy}}, 201)
    return primitive_to_tree(primitive, {"item": skeleton["id"], "revision": 1})


def add_model(owner: httpx.Client, document: dict[str, Any], name: str = "walk") -> dict[str, Any]:
    return send(owner, "POST", MODELS, {"name": name, "parts": {"model": document}}, 201)


def search(owner: httpx.Client, model: str, **body: Any) -> httpx.Response:
    asked = {"constraints": [AHEAD], "refine": False, "motion": False, **body}
    return owner.post(f"{MODELS}/{model}/search", json=asked)


def found_step(owner: httpx.Client, model: str, **body: Any) -> dict[str, Any]:
    answer = search(owner, model, **body)
    assert answer.status_code == 200, answer.text
    return dict(answer.json()["steps"][0])


def test_a_model_whose_tree_is_outdated_gets_the_samples_of_each_seed(
    owner: httpx.Client, document: dict[str, Any]
) -> None:
    made = add_model(owner, document)
    tree = sample_tree_to_tree(
        build_tree(walking()[0], 3, FEW), model_digest=made["parts"]["model"]["document"], seed=3, options=FEW
    )
    url = f"{MODELS}/{made['id']}/parts"
    send(owner, "PUT", f"{url}/tree", tree, 200)
    own = [found_step(owner, made["id"], seed=seed) for seed in (1, 2)]
    assert [one["tree"] for one in own] == ["stored", "stored"]
    assert own[0]["latent"] == own[1]["latent"]
    send(owner, "PUT", f"{url}/model", {**document, "verdict": "changed"}, 200)
    second, first = (found_step(owner, made["id"], seed=seed) for seed in (2, 1))
    assert (first["tree"], second["tree"]) == ("drawn", "drawn")
    assert first["latent"] != second["latent"]


def test_a_target_out_of_all_reach_has_a_finite_answer(owner: httpx.Client, document: dict[str, Any]) -> None:
    model = add_model(owner, document)["id"]
    far = {
        "type": "joint_position", "joint": "head", "at": "end", "target_m": [1e6, 1e6, 1e6],
        "tolerance_cm": 1e-3, "weight": 1e6,
    }  # fmt: skip
    answer = search(owner, model, constraints=[far], refine=True, finish=True, motion=True, **{"lambda": 0})
    assert answer.status_code == 200, answer.text
    assert np.isfinite(answer.json()["errors"][0]["error_cm"])
    assert search(owner, model, constraints=[{**far, "tolerance_cm": 1e-6}]).status_code == 422


def test_a_model_of_many_keyframes_is_searched_with_a_tree_of_its_own_alone(
    owner: httpx.Client, document: dict[str, Any]
) -> None:
    keyframes = {f"k{number}": number for number in range(600)}
    made = add_model(owner, {**_stretched(document, 600), "keyframes": keyframes})
    refused = search(owner, made["id"])
    assert (refused.status_code, refused.json()["code"]) == (413, "tree-missing")
    assert "marey tree" in refused.json()["detail"]
    tree = sample_tree_to_tree(
        build_tree(walking()[0], 3, FEW), model_digest=made["parts"]["model"]["document"], seed=3, options=FEW
    )
    send(owner, "PUT", f"{MODELS}/{made['id']}/parts/tree", tree, 200)
    assert found_step(owner, made["id"])["tree"] == "stored"


def test_many_models_without_trees_are_too_much_for_one_search(
    owner: httpx.Client, document: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    one, other = (add_model(owner, {**document, "verdict": name}, name)["id"] for name in ("one", "other"))
    work = drawing_work(walking()[0], end_effectors=[standard_joints()[name] for name in END_EFFECTORS])
    monkeypatch.setattr(searching, "MOST_DRAWING_WORK", 1.5 * work)
    steps = [{"constraints": [AHEAD]}, {"constraints": [AHEAD], "model": other}]
    assert search(owner, one, constraints=[], steps=[steps[0]] * 2).status_code == 200
    for _ in range(2):  # what is kept from the first time counts as well
        refused = search(owner, one, constraints=[], steps=steps)
        assert (refused.status_code, refused.json()["code"]) == (413, "tree-missing")


@pytest.mark.parametrize("more", [{"candidates": 64}, {"passes": 4}, {"refine": True}, {"finish": True}])
def test_a_search_that_takes_too_long_is_refused(
    owner: httpx.Client, document: dict[str, Any], monkeypatch: pytest.MonkeyPatch, more: dict[str, Any]
) -> None:
    model = add_model(owner, document)["id"]
    wrist = {"type": "joint_position", "joint": "left_wrist", "at": "end", "target_m": [0.3, 1, 1]}
    asked = {"constraints": [wrist], "candidates": 8, "passes": 1}
    step = Step(
        walking()[0],
        (JointPositionConstraint(joint="left_wrist", at="end", target_m=(0.3, 1.0, 1.0)),),
        standard_joints(),
    )
    work = searching_work(
        SeveralSteps.of([step]),
        [build_tree(walking()[0], 0, end_effectors=[standard_joints()[name] for name in END_EFFECTORS])],
        candidates=8, passes=1, refining=None,
    )  # fmt: skip
    monkeypatch.setattr(search_answers, "MOST_WORK", 1.1 * work)
    assert search(owner, model, **asked).status_code == 200
    refused = search(owner, model, **{**asked, **more})
    assert (refused.status_code, refused.json()["code"]) == (413, "search-too-large")


@pytest.mark.parametrize(
    ("frames", "wrong"),
    [
        (FRAMES, {"keyframes": {f"k{number}": number % FRAMES for number in range(1001)}}),
        (FRAMES, {"duration_range_s": [5.0, 1.0]}),
        (20_000, {}),
    ],
)
def test_models_that_nobody_can_use_are_refused(
    owner: httpx.Client, document: dict[str, Any], frames: int, wrong: dict[str, Any]
) -> None:
    odd = {**_stretched(document, frames), **wrong}
    send(owner, "POST", MODELS, {"name": "odd", "parts": {"model": odd}}, 422)


def _stretched(document: dict[str, Any], frames: int) -> dict[str, Any]:
    """Return the document of the model, changed to `frames` canonical frames."""
    parts = {name: dict(document[name]) for name in ("spatial", "temporal")}
    for name, last in (("spatial", frames - 1), ("temporal", frames - 2)):
        parts[name]["knots"] = parts[name]["knots"] * (last / parts[name]["knots"][-1])
    return {**document, **parts}
