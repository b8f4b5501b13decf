"""Moving in from Marey's predecessor: every document of it goes in and out, on a real server."""

from __future__ import annotations

import json
import re
import shlex
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.interpolate import BSpline
from tests.support import predecessor_documents as old
from tests.support import predecessor_models as models
from tests.support.command_line import CommandLine

from marey_client import Marey
from marey_client.imports import find_files
from marey_client.project import ProjectHandle
from marey_schemas.imports import ImportEntry
from marey_schemas.kinds import Kind
from marey_schemas.queue.job_params import ImportParams
from marey_schemas.queue.jobs import JobCreate

pytestmark = pytest.mark.timeout(300)

PAGE = Path(__file__).parents[3] / "docs" / "how-to" / "move-in-from-the-predecessor.md"
OFFSET_CM = np.array(old.RIG[0].offset)
PARTS = {
    "body_skeleton_model.json": ("body.skeleton", "skeleton_model"),
    "begin_cluster_tree.json": ("begin_mm.json", "tree"),
    "walk_aligned_alignment.json": ("walk_aligned.bson.bz2", "alignment"),
}
"""Files that are exported as parts of the items of other files."""


@pytest.fixture
def lab(new_lab: Callable[[], ProjectHandle]) -> ProjectHandle:
    """An empty project."""
    return new_lab()


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with one document of each kind."""
    (tmp_path / "old").mkdir()
    for name, data in old.folder().items():
        (tmp_path / "old" / name).write_bytes(data)
    return tmp_path / "old"


def items_of(lab: ProjectHandle) -> dict[str, Any]:
    """Return handles of all items, by kind and name."""
    kinds = (Kind.SKELETON, Kind.CLIP, Kind.PROCESSED, Kind.ANNOTATION, Kind.MODEL, Kind.GRAPH)
    return {f"{kind.value} {one.name}": one for kind in kinds for one in lab.items(kind).list()}


def require_same_numbers(found: dict[str, Any]) -> None:
    """Compare the stored numbers with those of the documents."""
    for name, document in old.clips().items():
        kind = Kind.PROCESSED if "aligned" in name else Kind.CLIP
        motion = found[f"{kind.value} {name.split('.')[0]}"].part("motion")
        names, poses = old.read_clip(document)
        poses = poses[:, : 3 + 4 * len(names)]
        np.testing.assert_allclose(motion["poses"][:, :3] * 100, poses[:, :3] + OFFSET_CM, atol=1e-3)
        assert tuple(motion["joints"]) == names
        np.testing.assert_allclose(motion["poses"][:, 3:], poses[:, 3:], atol=1e-6)
        assert motion["frame_rate_hz"] == pytest.approx(30.0)
        if kind is Kind.CLIP:
            places = old.positions(old.RIG, names, poses)
            joints = ["LeftHand", "RightFoot", "Head"]
            ours = found[f"clip {name.split('.')[0]}"].positions(joints=joints)
            np.testing.assert_allclose(ours * 100, np.stack([places[joint] for joint in joints], 1), atol=2e-3)
    for name, document in old.primitives().items():
        model = found[f"model {name.split('_')[0]}"].part("model")
        require_same_model(model, document)
    assert found["model begin"].part("model")["keyframes"] == dict(
        zip([f"contact{number}" for number in range(4)], [20, 47, 47, 47], strict=True)
    )
    tree = found["model begin"].part("tree")
    samples = np.sort(np.array(old.cluster_tree()["data"], np.float32), axis=0)
    np.testing.assert_array_equal(np.sort(tree["samples"], axis=0), samples)
    info = found["processed walk_aligned"].part("info")
    assert np.abs(info["time_function"] - old.TIME_FUNCTION).max() < 1.0
    assert info["keyframes"] == {"contact0": 20}


def require_same_model(model: dict[str, Any], document: dict[str, Any]) -> None:
    """Compare a stored model with its document at random scores."""
    space = model["spatial"]
    frames = np.arange(models.FRAMES)
    scores = np.random.default_rng(3).normal(size=len(space["directions"]))
    coefficients = space["mean"] + np.tensordot(scores, space["directions"], axes=1)
    ours = BSpline(space["knots"], coefficients, space["degree"])(frames)
    if "spatial_coeffs" in document:
        theirs = BSpline(document["knots"], np.array(document["spatial_coeffs"]), 3)(frames)
    else:
        theirs = old.model_poses(document, scores)
    np.testing.assert_allclose(ours[:, :3] * 100, theirs[:, :3] + OFFSET_CM, atol=1e-9)
    np.testing.assert_allclose(ours[:, 3:], theirs[:, 3:], atol=1e-12)


def segments_of(item: Any) -> list[tuple[str, int, int]]:
    return [(one.label, one.start, one.end) for one in item.document().segments]


def test_a_folder_with_one_of_each_goes_in_with_one_command_and_out_byte_for_byte(
    lab: ProjectHandle, run: CommandLine, folder: Path, tmp_path: Path
) -> None:
    run("upload", folder, "--project", "lab", "--collection", "old")
    found = items_of(lab)
    assert sorted(found) == [
        "annotation run contact", "annotation run swing", "annotation turn imported", "annotation walk imported",
        "clip run", "clip turn", "clip walk", "graph steps",
        "model begin", "model left", "model old", "model right", "model stand",
        "processed walk_aligned", "skeleton hik (171 cm)",
    ]  # fmt: skip
    require_same_numbers(found)
    assert segments_of(found["annotation walk imported"]) == [("section 1", 0, 20), ("section 2", 20, 40)]
    assert segments_of(found["annotation turn imported"]) == [("left", 0, 10), ("right", 10, 20), ("left", 20, 40)]
    assert segments_of(found["annotation run contact"]) == [("contact", 3, 6), ("contact", 11, 12)]
    mapping = found["skeleton hik (171 cm)"].mapping()
    assert mapping.joints == {name: joint for name, joint in old.skeleton_model()["joints"].items() if joint}
    assert mapping.axes["LeftArm"].swing == (0.0, 0.0, 1.0)

    files = old.folder()
    items = {
        "body.skeleton": "skeleton hik (171 cm)", "walk_sections.json": "annotation walk imported",
        "turn_sections.json": "annotation turn imported", "run_sections.json": "annotation run contact",
        "walk_aligned.bson.bz2": "processed walk_aligned", "steps.json": "graph steps",
        "left_quaternion_mm.bson.bz2": "model left",
    }  # fmt: skip
    for name, data in files.items():
        owner, part = PARTS.get(name, (name, None))
        kind = "model" if "_mm" in owner else "clip"
        item = found[items.get(owner) or f"{kind} {owner.split('.')[0].removesuffix('_mm')}"]
        written = item.export(tmp_path / "out", format="predecessor", part=part)
        assert (written.name, written.read_bytes()) == (name, data)
    again = json.loads(run("upload", folder, "--project", "lab", "--collection", "old", "--json").stdout)
    assert {entry["status"] for entry in again} == {"unchanged", "companion"}


def test_a_job_imports_the_same_as_a_request(marey: Marey, lab: ProjectHandle, folder: Path, tmp_path: Path) -> None:
    sent = lab.imports.send(find_files([folder]).files)
    job = marey.jobs.wait(lab.submit(JobCreate(kind="import", params=ImportParams(files=sent).model_dump())).id)
    assert job.result is not None
    entries = [ImportEntry.model_validate(entry) for entry in job.result["entries"]]
    assert [(one.name, one.error) for one in entries if one.status == "failed"] == []
    found = items_of(lab)
    assert len(found) == 15
    require_same_numbers(found)
    for name, key, part in (
        ("body_skeleton_model.json", "skeleton hik (171 cm)", "skeleton_model"), ("walk.bson.bz2", "clip walk", None),
        ("walk_aligned_alignment.json", "processed walk_aligned", "alignment"),
        ("turn_sections.json", "annotation turn imported", None),
    ):  # fmt: skip
        assert found[key].export(tmp_path, format="predecessor", part=part).read_bytes() == old.folder()[name]


def test_the_commands_of_the_page_run(lab: ProjectHandle, run: CommandLine, folder: Path, tmp_path: Path) -> None:
    refused = run("upload", folder / "walk.bson.bz2", "--project", "lab", status=1)
    assert "name a skeleton of the project with --skeleton" in refused.stdout + refused.stderr
    (tmp_path / "body.skeleton").write_bytes((folder / "body.skeleton").read_bytes())
    blocks = re.findall(r"```sh\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    commands = [shlex.split(line, comments=True) for block in blocks for line in block.splitlines()]
    for command in commands:
        run(*command[1:])
    for name in ("walk.bson.bz2", "begin_cluster_tree.json", "walk_aligned_alignment.json"):
        assert (tmp_path / name).read_bytes() == (folder / name).read_bytes()
    (clip,) = lab.clips.list(path="walk")
    names, poses = old.read_clip(old.clips()["walk.bson.bz2"])
    places = old.positions(old.RIG, names, poses)
    np.testing.assert_allclose(clip.positions(joints=["LeftHand"])[:, 0] * 100, places["LeftHand"], atol=2e-3)
    layout_2 = old.decode((tmp_path / "begin_mm.json").read_bytes())
    scores = np.random.default_rng(6).normal(size=models.TEMPORAL)
    expected = old.model_times(old.primitives()["begin_mm.json"], scores)
    np.testing.assert_allclose(old.model_times(layout_2, scores), expected, atol=1e-9)
    model = old.decode((tmp_path / "hik (171 cm).skeleton").read_bytes())["skeleton_model"]
    assert model["joints"] == {**dict.fromkeys(model["joints"]), **old.skeleton_model()["joints"]}
    assert model["cos_map"]["LeftArm"] == {"x": [0.0, 0.0, 1.0], "y": [1.0, 0.0, 0.0]}
    assert model["joint_constraints"] == old.skeleton_model()["joint_constraints"]
    frames = old.decode((tmp_path / "walk imported_sections.json").read_bytes())["semantic_annotation"]
    assert frames == {"section 1": list(range(20)), "section 2": list(range(20, 40))}
