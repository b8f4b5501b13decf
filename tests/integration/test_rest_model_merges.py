"""Merges of models that both sides have changed, and the lineage of merged and restored revisions."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import httpx
import pytest
from tests.support.rest_server import Server
from tests.support.search_primitives import walking

from marey_motion.documents import skeleton_to_document
from marey_motion.modelling.primitive_documents import primitive_to_tree
from marey_motion.modelling.search.tree import build_tree
from marey_motion.modelling.search.tree_documents import sample_tree_to_tree
from marey_schemas.encoding.codecs import MSGPACK, encode_tree
from marey_schemas.encoding.digests import digest_of
from marey_schemas.options.modelling import TreeOptions
from marey_server.access.principal import SYSTEM
from marey_server.store.fsck import check_store
from marey_server.store.tables import lineage
from marey_server.store.transaction import Transaction

LAB = "/projects/lab"
GAITS = f"{LAB}/datasets/gaits"
PAGE = b"<html></html>"
AHEAD = {"type": "root_position", "at": "end", "target_m": [0, 1]}


class Model:
    """The model `walk` in the folder of the dataset `gaits`."""

    def __init__(self, client: httpx.Client) -> None:
        self.client = client
        primitive = walking()[0]
        hierarchy = skeleton_to_document(primitive.skeleton).model_dump(by_alias=True)
        rig = self.send("POST", f"{LAB}/skeletons", {"name": "rig", "parts": {"hierarchy": hierarchy}})
        self.document = primitive_to_tree(primitive, {"item": rig["id"], "revision": 1})
        made = {"name": "walk", "collection": "gaits", "parts": {"model": self.document}}
        self.url = f"{LAB}/models/{self.send('POST', f'{LAB}/models', made)['id']}"
        self.sample(0)
        self.send("POST", f"{LAB}/datasets", {"name": "gaits", "collection": "gaits"})

    def send(self, method: str, url: str, tree: object = None, status: int | None = None) -> Any:
        headers = {
            "Content-Type": MSGPACK,
            "Accept": "application/json",
            **({"If-Match": "*"} if method == "PUT" else {}),
        }
        content = None if tree is None else encode_tree(tree, MSGPACK)
        answer = self.client.request(method, url, content=content, headers=headers)
        assert answer.status_code == status or (status is None and answer.status_code < 300), answer.text
        return answer.json()

    def train(self, verdict: str) -> None:
        """Replace the model, and draw a tree of samples for it."""
        self.replace(verdict)
        self.sample(1)

    def replace(self, verdict: str) -> None:
        self.send("PUT", f"{self.url}/parts/model", {**self.document, "verdict": verdict})

    def sample(self, seed: int) -> None:
        few = TreeOptions(samples=30, features="latent")
        digest = self.send("GET", self.url)["parts"]["model"]["document"]
        tree = sample_tree_to_tree(build_tree(walking()[0], seed, few), model_digest=digest, seed=seed, options=few)
        self.send("PUT", f"{self.url}/parts/tree", tree)

    def report(self) -> None:
        digest = digest_of(PAGE)
        assert self.client.put(f"/blobs/{digest}", content=PAGE).status_code in (201, 204)
        html = {"blob": digest, "size_bytes": len(PAGE)}
        self.send("PUT", f"{self.url}/parts/report", {"schema": "marey/model-report@1", "title": "walk", "html": html})

    def commit(self, branch: str = "main") -> Any:
        return self.send("POST", f"{GAITS}/commits", {"message": branch, "branch": branch})

    def check_out(self, version: str = "main") -> Any:
        return self.send("POST", f"{GAITS}/checkout", {"version": version})

    def merge(self, status: int = 200, **request: Any) -> Any:
        return self.send("POST", f"{GAITS}/merges", {"version": "trial", **request}, status)

    def diverge(self, on_trial: Callable[[], object], on_main: Callable[[], object]) -> None:
        """Commit a change on each of two branches, and leave `main` checked out."""
        self.commit()
        self.send("POST", f"{GAITS}/refs", {"name": "trial", "kind": "branch"})
        on_trial()
        self.commit("trial")
        self.check_out()
        on_main()
        self.commit()

    def parts(self, version: str) -> dict[str, str]:
        (found,) = self.send("GET", f"{GAITS}/entries?version={version}")["items"]
        return dict(found["parts"])

    def search(self) -> Any:
        (step,) = self.send("POST", f"{self.url}/search", {"constraints": [AHEAD], "refine": False, "motion": False})[
            "steps"
        ]
        return step


@pytest.fixture
def model(owner: httpx.Client) -> Model:
    return Model(owner)


def test_a_model_that_both_sides_have_trained_is_taken_whole_from_one_side(model: Model, server: Server) -> None:
    model.diverge(lambda: model.train("of trial"), lambda: model.train("of main"))
    refused = model.merge(409)
    (conflict,) = refused["context"]["conflicts"]
    assert (conflict["path"], conflict["kind"], conflict["parts"]) == ("walk", "model", ["model", "tree"])
    theirs = {"path": "walk", "kind": "model", "take": "theirs", "part": "model"}
    model.merge(resolutions=[theirs])
    assert model.parts("main") == model.parts("trial")
    model.check_out()
    assert model.send("GET", f"{model.url}/parts/model")["verdict"] == "of trial"
    assert model.search()["tree"] == "stored", "the tree is that of the model"
    assert list(check_store(server.database)) == []


def test_a_new_tree_of_a_replaced_model_is_in_conflict_with_the_new_model(model: Model) -> None:
    model.diverge(lambda: model.sample(5), lambda: model.replace("of main"))
    (conflict,) = model.merge(409)["context"]["conflicts"]
    assert conflict["parts"] == ["model", "tree"]
    model.merge(resolutions=[{"path": "walk", "kind": "model", "take": "ours"}])
    assert model.parts("main") == model.parts("main~1")


def test_a_tree_and_a_report_of_one_model_are_combined_and_name_both_sides(model: Model, server: Server) -> None:
    model.diverge(lambda: model.sample(5), model.report)
    model.merge()
    merged = model.parts("main")
    assert merged["tree"] == model.parts("trial")["tree"]
    assert merged["report"] == model.parts("main~1")["report"]
    model.check_out()
    assert model.search()["tree"] == "stored"
    (restored,) = model.send("GET", f"{model.url}/lineage")["inputs"]
    assert (restored["role"], restored["job"]) == ("restored", None)
    own = model.url.rpartition("/")[2]
    graph = model.send("GET", f"{model.url}/lineage-graph?direction=inputs")
    assert sorted(one["revision"] for one in graph["revisions"] if one["item"] == own) == [3, 5, 6]
    assert sorted(one["role"] for one in graph["links"]) == ["merged", "merged", "restored"]
    assert not model.send("GET", f"{model.url}/stale")["stale"], "the merged revisions are no outdated inputs"
    assert list(check_store(server.database)) == []


@pytest.mark.parametrize("by", ["checkout", "revert"])
def test_a_restored_revision_keeps_the_inputs_of_its_content(model: Model, server: Server, by: str) -> None:
    """A job made revision 2 from the skeleton; the result is replaced, and comes back."""
    own = model.url.rpartition("/")[2]
    rig = model.document["skeleton"]["item"]

    def make(tx: Transaction) -> None:
        row = {"role": "skeleton", "position": 0, "input_item_id": rig, "input_number": 1}
        tx.execute(lineage.insert().values(item_id=own, number=2, **row))

    server.database.write(SYSTEM, make)
    first = model.commit()["digest"]
    model.replace("by hand")
    model.commit()
    if by == "checkout":
        model.check_out(first)
    else:
        answer = model.client.post(f"{model.url}/revert", json={"revision": 2}, headers={"If-Match": "*"})
        assert answer.status_code == 200, answer.text
    (source,) = model.send("GET", f"{model.url}/lineage")["inputs"]
    assert (source["item"], source["revision"], source["role"]) == (own, 2, "restored")
    graph = model.send("GET", f"{model.url}/lineage-graph?direction=inputs")
    assert {(one["item"], one["revision"]) for one in graph["revisions"]} == {(own, 4), (own, 2), (rig, 1)}
    assert not model.send("GET", f"{model.url}/stale")["stale"]
    changed = {"schema": "marey/skeleton-mapping@1", "joints": {"hips": "hips"}}
    model.send("PUT", f"{LAB}/skeletons/{rig}/parts/mapping", changed)
    assert model.send("GET", f"{model.url}/stale")["stale"], "the skeleton has a newer revision"
