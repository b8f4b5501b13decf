"""Searches of models over HTTP: which tree they take, and what is too much of them."""

from __future__ import annotations

from typing import Any

import httpx
import numpy as np
import pytest

from marey_motion.documents import skeleton_to_document
from marey_motion.modelling.primitive_documents import primitive_to_tree
from marey_motion.modelling.sample_tree_documents import sample_tree_to_tree
from marey_motion.modelling.tree import TreeOptions, build_tree
from marey_schemas.codecs import MSGPACK, encode_tree
from search_primitives import walking

MODELS = "/projects/lab/models"
AHEAD = {"type": "root_position", "at": "end", "target_m": [0, 1]}
FEW = TreeOptions(samples=50, features="latent")


def send(client: httpx.Client, method: str, url: str, tree: Any, status: int) -> dict[str, Any]:
    headers = {"Content-Type": MSGPACK, "Accept": "application/json", **({"If-Match": "*"} if method == "PUT" else {})}
    answer = client.request(method, url, content=encode_tree(tree, MSGPACK), headers=headers)
    assert answer.status_code == status, answer.text
    return dict(answer.json())


@pytest.fixture
def document(owner: httpx.Client) -> dict[str, Any]:
    """A model of walks, on a skeleton of the project."""
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
