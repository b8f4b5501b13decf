"""Import and export of models, trees and graphs in the formats of Marey's predecessor, on a real server."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.support import predecessor_models as models
from tests.support.command_line import CommandLine
from tests.support.server_process import ServerProcess

from marey_client import Marey
from marey_client.errors import RequestFailed
from marey_client.imports import find_files
from marey_client.project import ProjectHandle
from marey_motion.formats.predecessor.encoding import encode_document
from marey_motion.formats.predecessor.model import read_predecessor_model
from marey_schemas.imports import ImportEntry
from marey_schemas.items import ItemChange
from marey_schemas.kinds import Kind
from marey_schemas.options.imports import ImportOptions
from marey_schemas.queue.job_params import ImportParams
from marey_schemas.queue.jobs import JobCreate

pytestmark = pytest.mark.timeout(300)


@pytest.fixture
def lab(new_lab: Callable[[], ProjectHandle]) -> ProjectHandle:
    """An empty project."""
    return new_lab()


def upload(lab: ProjectHandle, folder: Path, files: dict[str, bytes]) -> dict[str, ImportEntry]:
    folder.mkdir()
    for name, data in files.items():
        (folder / name).write_bytes(data)
    entries = lab.imports.upload(find_files([folder]).files, ImportOptions(collection="models"))
    return {entry.name: entry for entry in entries}


def model_files(**more: bytes) -> dict[str, bytes]:
    return {
        "walk_left_quaternion_mm.json": json.dumps(models.layout_3(), indent=1).encode(),
        "walk_left_quaternion_cluster_tree.json": json.dumps(models.tree(), indent=2).encode(),
        "walk_right_mm.bson.bz2": encode_document(models.layout_2(), "bson.bz2"),
        "old_mm.bson": encode_document(models.layout_1(), "bson"),
        "stand_mm.json": json.dumps(models.static()).encode(),
        **more,
    }


def transition(action: str, name: str) -> dict[str, Any]:
    return {f"{action}:{name}": {"action_name": action, "model_name": name, "model_id": "?"}}


GRAPH = {
    "nodes": {
        "idle": {
            "7": {
                "name": "stand", "type": "idle",
                "transitions": {**transition("idle", "stand"), **transition("walk", "walk_left")},
            }
        },
        "walk": {
            "8": {"name": "walk_left", "type": "start", "transitions": transition("walk", "walk_right")},
            "9": {"name": "walk_right", "type": "end", "transitions": transition("idle", "stand")},
        },
    },
    "startNode": ["idle", "7"],
}  # fmt: skip


def test_every_layout_goes_in_and_comes_out_as_it_was(lab: ProjectHandle, tmp_path: Path) -> None:
    files = model_files()
    entries = upload(lab, tmp_path / "in", files)
    assert {name: entry.status for name, entry in entries.items()} == {
        name: "companion" if "tree" in name else "created" for name in files
    }
    found = {one.name: one for one in lab.items(Kind.MODEL).list()}
    assert found.keys() == {"walk_left", "walk_right", "old", "stand"}
    for name, entry in entries.items():
        if entry.item is None:
            continue
        model = lab.items(Kind.MODEL).get(entry.item)
        for form in ("predecessor", "original"):
            written = model.export(tmp_path / form, format=form)
            assert (written.name, written.read_bytes()) == (name, files[name])
    for form in ("predecessor", "original"):
        tree = found["walk_left"].export(tmp_path / "trees", format=form, part="tree")
        assert tree.read_bytes() == files["walk_left_quaternion_cluster_tree.json"]
    assert len(list(lab.skeletons.list())) == 1

    again = upload(lab, tmp_path / "again", files)
    assert {entry.status for entry in again.values()} == {"unchanged", "companion"}


def test_a_model_knows_its_tree_and_how_it_was_read(lab: ProjectHandle, tmp_path: Path) -> None:
    entries = upload(lab, tmp_path / "in", model_files())
    model = lab.items(Kind.MODEL).get(str(entries["walk_left_quaternion_mm.json"].item))
    assert set(model.item.parts) == {"model", "tree"}
    assert model.part("tree")["model_digest"] == model.item.parts["model"].document
    provenance = model.part("model")["provenance"]["predecessor"]
    assert (provenance["layout"], provenance["time_form"]) == ("3", "coefficients")
    assert provenance["animated_joints"] == list(models.ANIMATED)
    np.testing.assert_array_equal(
        np.sort(model.part("tree")["samples"], axis=0),
        np.sort(np.array(models.tree()["data"], dtype=np.float32), axis=0),
    )


def test_another_layout_and_a_changed_model_are_written_anew(lab: ProjectHandle, tmp_path: Path) -> None:
    entries = upload(lab, tmp_path / "in", model_files())
    model = lab.items(Kind.MODEL).get(str(entries["walk_right_mm.bson.bz2"].item))
    as_3 = read_predecessor_model(model.export(tmp_path / "as 3", format="predecessor", layout="3").read_bytes(), "3")
    original = read_predecessor_model(model_files()["walk_right_mm.bson.bz2"], "2")
    latents = original.primitive.sample(5, 1)
    np.testing.assert_allclose(as_3.primitive.poses(latents), original.primitive.poses(latents), atol=1e-9)
    assert as_3.animated_joints == models.ANIMATED

    document = model.part("model")
    model.put_part("model", {**document, "keyframes": {"contact": 12}})
    written = json.loads(model.export(tmp_path / "changed", format="predecessor").read_bytes())
    assert written["keyframes"] == {"contact": 12}
    with pytest.raises(RequestFailed, match="no tree"):
        model.export(tmp_path / "none", format="predecessor", part="tree")
    with pytest.raises(RequestFailed, match="not imported from a file or was changed since"):
        model.export(tmp_path / "none", format="original", part="tree")
    with pytest.raises(RequestFailed, match="model has no file for the part 'alignment'"):
        model.export(tmp_path / "none", format="predecessor", part="alignment")
    with pytest.raises(RequestFailed, match="/provenance/predecessor") as refused:
        model.put_part("model", {**document, "provenance": {"predecessor": "x"}})
    assert [error.pointer for error in refused.value.errors] == ["/model/provenance/predecessor"]


def test_a_graph_finds_its_models_by_name_and_comes_out_as_it_was(lab: ProjectHandle, tmp_path: Path) -> None:
    alone = upload(lab, tmp_path / "alone", {"graph.json": json.dumps(GRAPH).encode()})["graph.json"]
    assert alone.error is not None
    assert alone.error.code == "no-model"
    assert "no model is called 'stand'" in alone.error.detail
    upload(lab, tmp_path / "in", model_files())
    data = json.dumps(GRAPH, indent=3).encode()
    entry = upload(lab, tmp_path / "graph", {"graph.json": data})["graph.json"]
    assert entry.status == "created", entry.error
    graph = lab.items(Kind.GRAPH).get(str(entry.item))
    part = graph.part("graph")
    (stand,) = [one for one in lab.items(Kind.MODEL).list() if one.name == "stand"]
    assert part["actions"]["idle"]["primitives"]["stand"]["model"] == {"item": stand.id, "revision": 1}
    assert graph.export(tmp_path / "out", format="predecessor").read_bytes() == data

    part["actions"]["walk"]["primitives"]["walk_left"]["type"] = "standard"
    graph.put_part("graph", part)
    written = json.loads(graph.export(tmp_path / "changed", format="predecessor").read_bytes())
    assert written["nodes"]["walk"]["8"]["type"] == "standard"
    assert written["start_node"] == written["startNode"] == ["idle", "stand"]
    part["actions"]["walk"]["primitives"]["walk_left"]["model"] = {"item": "model_gone", "revision": 1}
    with pytest.raises(RequestFailed, match="no model 'model_gone'"):
        graph.put_part("graph", part)


@pytest.mark.soak
def test_what_a_server_stores_is_verified_while_it_runs(
    lab: ProjectHandle, run: CommandLine, server: ServerProcess, tmp_path: Path
) -> None:
    upload(lab, tmp_path / "in", model_files())
    checked = run("db", "fsck", status=0, stdin="", **server.environment).stdout
    assert re.match(r"checked .*[1-9][0-9]* documents", checked)


def test_a_tree_alone_and_a_model_without_a_skeleton_are_refused_with_what_to_do(
    lab: ProjectHandle, tmp_path: Path
) -> None:
    bare = {name: value for name, value in models.layout_2().items() if name != "skeleton"}
    files = {"a_cluster_tree.json": json.dumps(models.tree()).encode(), "b_mm.json": json.dumps(bare).encode()}
    entries = upload(lab, tmp_path / "in", files)
    codes = {name: entry.error and entry.error.code for name, entry in entries.items()}
    assert codes == {"a_cluster_tree.json": "model-missing", "b_mm.json": "skeleton-missing"}
    upload(lab, tmp_path / "whole", {"whole_mm.json": json.dumps(models.layout_3()).encode()})
    (skeleton,) = lab.skeletons.list()
    skeleton.change(ItemChange(name="worker"))
    found = find_files([tmp_path / "in" / "b_mm.json"]).files
    (entry,) = lab.imports.upload(found, ImportOptions(collection="models", skeleton=skeleton.id))
    assert entry.status == "created", entry.error


def test_models_of_a_large_upload_come_in_by_a_job_with_their_trees(
    marey: Marey, lab: ProjectHandle, tmp_path: Path
) -> None:
    files = {f"walk{number}_mm.json": json.dumps(models.layout_3(number)).encode() for number in range(9)}
    files |= {f"walk{number}_cluster_tree.json": json.dumps(models.tree()).encode() for number in (0, 7)}
    folder = tmp_path / "in"
    folder.mkdir()
    for name, data in files.items():
        (folder / name).write_bytes(data)
    sent = lab.imports.send(find_files([folder]).files)
    job = marey.jobs.wait(lab.submit(JobCreate(kind="import", params=ImportParams(files=sent).model_dump())).id)
    assert job.result is not None
    assert {entry["status"] for entry in job.result["entries"]} == {"created", "companion"}
    model = next(one for one in lab.items(Kind.MODEL).list() if one.name == "walk7")
    assert model.export(tmp_path / "out", format="predecessor").read_bytes() == files["walk7_mm.json"]
    tree = model.export(tmp_path / "out", format="predecessor", part="tree")
    assert tree.read_bytes() == files["walk7_cluster_tree.json"]
    assert model.part("tree")["model_digest"] == model.item.parts["model"].document
    with pytest.raises(RequestFailed, match="give the digest"):
        model.put_part("tree", {**model.part("tree"), "model_digest": {"digest_of": "model"}})


def test_a_graph_that_a_job_imports_finds_models_of_the_job_and_of_the_project(
    marey: Marey, lab: ProjectHandle, tmp_path: Path
) -> None:
    alone, whole = tmp_path / "alone", tmp_path / "whole"
    for folder in (alone, whole):
        folder.mkdir()
        (folder / "zgraph.json").write_text(json.dumps(GRAPH))
    for name, data in model_files().items():
        (whole / name).write_bytes(data)

    def imported(folder: Path) -> dict[str, ImportEntry]:
        sent = lab.imports.send(find_files([folder]).files)
        job = marey.jobs.wait(lab.submit(JobCreate(kind="import", params=ImportParams(files=sent).model_dump())).id)
        assert job.result is not None
        return {entry["name"]: ImportEntry.model_validate(entry) for entry in job.result["entries"]}

    refused = imported(alone)["zgraph.json"].error
    assert refused is not None
    assert refused.code == "no-model"
    assert imported(whole)["zgraph.json"].status == "created"
    (graph,) = lab.items(Kind.GRAPH).list()
    (stand,) = [one for one in lab.items(Kind.MODEL).list() if one.name == "stand"]
    reference = {"item": stand.id, "revision": 1}
    assert graph.part("graph")["actions"]["idle"]["primitives"]["stand"]["model"] == reference
    # The same files again, now that the project has the models: the job is not answered with the earlier refusal.
    assert imported(alone)["zgraph.json"].status == "unchanged"
