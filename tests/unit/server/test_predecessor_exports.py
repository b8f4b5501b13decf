"""Exports to formats of Marey's predecessor: unchanged originals and newly written files."""

import json
from collections.abc import Mapping
from typing import Any, Literal

import numpy as np
import pytest
from tests.support import predecessor_models as models
from tests.support.predecessor_models import FILE, TREE_FILE

from marey_schemas.kinds import Kind
from marey_server.errors import InvalidProblem, NotFoundProblem
from marey_server.motions.predecessor_exports import PredecessorOptions, unchanged_original, write_predecessor

Part = Literal["model", "tree", "alignment"]


@pytest.fixture(scope="module")
def stored() -> tuple[Mapping[str, Any], dict[str, Any]]:
    """The parts of an imported model with its tree, and the hierarchy of its skeleton."""
    parts, hierarchy = models.imported()
    model = {**parts["model"], "skeleton": {"item": "skeleton_1", "revision": 1}}
    return {"model": model, "tree": {**parts["tree"], "model_digest": FILE}}, hierarchy


def test_unchanged_parts_are_given_back_as_their_files(
    stored: tuple[Mapping[str, Any], dict[str, Any]],
) -> None:
    parts, _ = stored
    model = unchanged_original(Kind.MODEL, parts, PredecessorOptions())
    tree = unchanged_original(Kind.MODEL, parts, PredecessorOptions(part="tree"))
    assert model is not None
    assert tree is not None
    assert (model.name, model.blob) == ("walk_mm.json", FILE)
    assert (tree.name, tree.blob) == ("walk_cluster_tree.json", TREE_FILE)


def test_a_changed_part_and_another_layout_are_not(stored: tuple[Mapping[str, Any], dict[str, Any]]) -> None:
    parts, _ = stored
    changed = {**parts, "model": {**parts["model"], "keyframes": {"contact": 3}}}
    assert unchanged_original(Kind.MODEL, changed, PredecessorOptions()) is None
    assert unchanged_original(Kind.MODEL, parts, PredecessorOptions(layout="2")) is None
    assert unchanged_original(Kind.MODEL, {"model": parts["model"]}, PredecessorOptions(part="tree")) is None
    assert unchanged_original(Kind.ANNOTATION, {"annotation": {}}, PredecessorOptions()) is None


@pytest.mark.parametrize("layout", [None, "2", "3"])
def test_a_model_is_written_in_the_layout_asked_for(
    stored: tuple[Mapping[str, Any], dict[str, Any]], layout: Literal["2", "3"] | None
) -> None:
    parts, hierarchy = stored
    name, data = write_predecessor(Kind.MODEL, "walk", parts, hierarchy, PredecessorOptions(layout=layout))
    document = json.loads(data)
    assert name == "walk_mm.json"
    assert ("sspm" in document) == (layout != "2")
    mean = document["mean_spatial_vector"] if layout == "2" else document["sspm"]["mean"]
    np.testing.assert_allclose(mean, models.layout_3()["sspm"]["mean"], atol=1e-9)


def test_a_tree_is_written_with_the_spatial_part_of_its_samples(
    stored: tuple[Mapping[str, Any], dict[str, Any]],
) -> None:
    parts, hierarchy = stored
    name, data = write_predecessor(Kind.MODEL, "walk", parts, hierarchy, PredecessorOptions(part="tree"))
    document = json.loads(data)
    assert name == "walk_cluster_tree.json"
    assert np.shape(document["data"]) == (40, models.SPATIAL + models.TEMPORAL)
    assert np.shape(document["features"]) == (40, models.SPATIAL)
    with pytest.raises(NotFoundProblem):
        write_predecessor(Kind.MODEL, "walk", {"model": parts["model"]}, hierarchy, PredecessorOptions(part="tree"))


def test_the_time_function_beside_an_aligned_clip_is_written_in_whole_frames() -> None:
    info = {
        "schema": "marey/alignment@1", "frame_rate_hz": 60.0, "source_frames": 5,
        "time_function": np.array([0.0, 1.4, 2.6, 4.0]), "keyframes": {"contact": 2},
    }  # fmt: skip
    options = PredecessorOptions(part="alignment")
    name, data = write_predecessor(Kind.PROCESSED, "take", {"info": info}, None, options)
    assert name == "take_alignment.json"
    assert json.loads(data) == {
        "sections": [{"start_idx": 0, "end_idx": 2}, {"start_idx": 2, "end_idx": 4}],
        "time_function": [0, 1, 3, 4],
    }


def test_other_kinds_have_no_file_of_the_predecessor() -> None:
    with pytest.raises(InvalidProblem, match="exported as json"):
        write_predecessor(Kind.CHARACTER, "s", {"character": {}}, None, PredecessorOptions())


@pytest.mark.parametrize(
    "predecessor",
    [
        "x",
        5,
        None,
        {"original": "x"},
        {"original": {}},
        {"tree": [1]},
        {"animated_joints": 5},
        {"animated_joints": [1]},
    ],
)
@pytest.mark.parametrize("part", ["model", "tree"])
def test_a_model_that_an_older_server_took_with_odd_notes_is_written_anew(
    stored: tuple[Mapping[str, Any], dict[str, Any]], predecessor: Any, part: Part
) -> None:
    parts, hierarchy = stored
    noted = {"provenance": {"predecessor": predecessor}, "training": {"examples": 5}}
    parts = {**parts, "model": {**parts["model"], **noted}}
    options = PredecessorOptions(part=part)
    assert unchanged_original(Kind.MODEL, parts, options) is None
    assert json.loads(write_predecessor(Kind.MODEL, "walk", parts, hierarchy, options)[1])


def test_a_tree_whose_nodes_are_none_is_refused(stored: tuple[Mapping[str, Any], dict[str, Any]]) -> None:
    parts, hierarchy = stored
    parts = {**parts, "tree": {**parts["tree"], "children": np.ones_like(parts["tree"]["children"])}}
    with pytest.raises(InvalidProblem) as refused:
        write_predecessor(Kind.MODEL, "walk", parts, hierarchy, PredecessorOptions(part="tree"))
    assert refused.value.error_code == "cannot-be-exported"


@pytest.mark.parametrize(
    ("kind", "part"),
    [(Kind.MODEL, "alignment"), (Kind.PROCESSED, "tree"), (Kind.CLIP, "model"), (Kind.ANNOTATION, "alignment")],
)
def test_a_part_that_items_of_a_kind_do_not_have_is_refused(kind: Kind, part: Part) -> None:
    with pytest.raises(InvalidProblem, match=f"{kind} has no file for the part '{part}'") as refused:
        PredecessorOptions(part=part).require_fit(kind)
    assert refused.value.error_code == "no-part"
    PredecessorOptions().require_fit(kind)


@pytest.mark.parametrize(("kind", "part"), [(Kind.MODEL, "model"), (Kind.MODEL, "tree"), (Kind.PROCESSED, "alignment")])
def test_a_part_that_items_of_a_kind_have_may_be_asked_for(kind: Kind, part: Part) -> None:
    PredecessorOptions(part=part).require_fit(kind)
