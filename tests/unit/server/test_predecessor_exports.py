"""What is given back of files of the predecessor, and what is written anew."""

import json

import numpy as np
import pytest

import predecessor_models as models
from marey_motion.importing import FileDigests, ImportRequest, import_file, plan_imports
from marey_schemas.kinds import Kind
from marey_server.errors import Invalid, NotFound
from marey_server.predecessor_exports import PredecessorOptions, unchanged_original, write_predecessor

FILE, TREE_FILE = f"sha256:{'1' * 64}", f"sha256:{'2' * 64}"


@pytest.fixture(scope="module")
def stored():
    """The parts of a model with its tree, as they are stored when they are imported, and the skeleton's hierarchy."""
    planned, companion = plan_imports(["in/walk_mm.json", "in/walk_cluster_tree.json"])
    assert (planned.companion, companion.role) == ("in/walk_cluster_tree.json", "companion")
    data, tree = (json.dumps(one).encode() for one in (models.layout_3(), models.tree()))
    found = import_file(planned, data, FileDigests(FILE, TREE_FILE, companion.name), ImportRequest(), tree)
    parts = found.modelled.parts
    model = {**parts["model"], "skeleton": {"item": "skeleton_1", "revision": 1}}
    return {"model": model, "tree": {**parts["tree"], "model_digest": FILE}}, found.hierarchy


def test_unchanged_parts_are_given_back_as_their_files(stored):
    parts, _ = stored
    model = unchanged_original(Kind.MODEL, parts, PredecessorOptions())
    tree = unchanged_original(Kind.MODEL, parts, PredecessorOptions(part="tree"))
    assert (model.name, model.blob) == ("walk_mm.json", FILE)
    assert (tree.name, tree.blob) == ("walk_cluster_tree.json", TREE_FILE)


def test_a_changed_part_and_another_layout_are_not(stored):
    parts, _ = stored
    changed = {**parts, "model": {**parts["model"], "keyframes": {"contact": 3}}}
    assert unchanged_original(Kind.MODEL, changed, PredecessorOptions()) is None
    assert unchanged_original(Kind.MODEL, parts, PredecessorOptions(layout="2")) is None
    assert unchanged_original(Kind.MODEL, {"model": parts["model"]}, PredecessorOptions(part="tree")) is None
    assert unchanged_original(Kind.ANNOTATION, {"annotation": {}}, PredecessorOptions()) is None


@pytest.mark.parametrize("layout", [None, "2", "3"])
def test_a_model_is_written_in_the_layout_asked_for(stored, layout):
    parts, hierarchy = stored
    name, data = write_predecessor(Kind.MODEL, "walk", parts, hierarchy, PredecessorOptions(layout=layout))
    document = json.loads(data)
    assert name == "walk_mm.json"
    assert ("sspm" in document) == (layout != "2")
    mean = document["mean_spatial_vector"] if layout == "2" else document["sspm"]["mean"]
    np.testing.assert_allclose(mean, models.layout_3()["sspm"]["mean"], atol=1e-9)


def test_a_tree_is_written_with_the_spatial_part_of_its_samples(stored):
    parts, hierarchy = stored
    name, data = write_predecessor(Kind.MODEL, "walk", parts, hierarchy, PredecessorOptions(part="tree"))
    document = json.loads(data)
    assert name == "walk_cluster_tree.json"
    assert np.shape(document["data"]) == (40, models.SPATIAL + models.TEMPORAL)
    assert np.shape(document["features"]) == (40, models.SPATIAL)
    with pytest.raises(NotFound):
        write_predecessor(Kind.MODEL, "walk", {"model": parts["model"]}, hierarchy, PredecessorOptions(part="tree"))


def test_the_time_function_beside_an_aligned_clip_is_written_in_whole_frames():
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


def test_other_kinds_have_no_file_of_the_predecessor():
    with pytest.raises(Invalid, match="exported as json"):
        write_predecessor(Kind.STUDY, "s", {"study": {}}, None, PredecessorOptions())
