"""Move from Marey's predecessor: each kind of its documents is imported and exported, on a real server."""

from __future__ import annotations

import json
import re
import shlex
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

import httpx
import numpy as np
import pytest
from scipy.interpolate import BSpline
from tests.support import predecessor_documents as old
from tests.support import predecessor_models as models
from tests.support import predecessor_records as written_records
from tests.support.command_line import CommandLine
from tests.support.server_process import ServerProcess

from marey_client import Marey
from marey_client.errors import RequestFailed
from marey_client.imports import find_files
from marey_client.project import ProjectHandle
from marey_schemas.imports import ImportAnswer, ImportEntry
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
    for name, data in written_records.folder().items():
        (tmp_path / "old" / name).write_bytes(data)
    return tmp_path / "old"


def items_of(lab: ProjectHandle) -> dict[str, Any]:
    """Return handles of all items, by kind and name."""
    kinds = (Kind.SKELETON, Kind.CLIP, Kind.PROCESSED, Kind.ANNOTATION, Kind.MODEL, Kind.GRAPH, Kind.RECORD)
    return {f"{kind.value} {one.name}": one for kind in kinds for one in lab.items(kind).list()}


def require_same_numbers(found: dict[str, Any]) -> None:
    """Compare the stored numbers with the numbers in the documents."""
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


Way = Literal["command", "sdk", "rest", "job"]


@dataclass(frozen=True)
class Ways:
    """Imports and exports of one project in each way that users have."""

    lab: ProjectHandle
    marey: Marey
    run: CommandLine
    server: ServerProcess
    out: Path

    def bring_in(self, way: Way, folder: Path) -> list[ImportEntry]:
        """Import a folder at once; return the entries of its files."""
        if way == "command":
            told = self.run("upload", folder, "--project", "lab", "--collection", "old", "--json").stdout
            return [ImportEntry.model_validate(entry) for entry in json.loads(told)]
        if way == "sdk":
            return list(self.lab.upload(folder, collection="old", shown=False).entries)
        if way == "rest":
            files = [("files", (path.name, path.read_bytes())) for path in sorted(folder.iterdir())]
            answer = httpx.post(
                f"{self.server.url}/api/v1/projects/lab/imports", files=files, data={"collection": "old"},
                headers=self._rights, timeout=120,
            )  # fmt: skip
            assert answer.status_code == 200, answer.text
            return list(ImportAnswer.model_validate_json(answer.content).entries)
        sent = self.lab.imports.send(find_files([folder]).files)
        params = ImportParams(files=sent, collection="old").model_dump()
        job = self.marey.jobs.wait(self.lab.submit(JobCreate(kind="import", params=params)).id)
        assert job.result is not None
        return [ImportEntry.model_validate(entry) for entry in job.result["entries"]]

    def take_out(self, way: Way, item: Any, part: str | None) -> tuple[str, bytes]:
        """Export an item for the predecessor; return name and content of the file."""
        if way == "rest":
            query = {"format": "predecessor"} | ({"part": part} if part else {})
            answer = httpx.get(f"{self.server.url}/api/v1{item.url}/export", params=query, headers=self._rights)
            assert answer.status_code == 200, answer.text
            return answer.headers["Content-Disposition"], answer.content
        if way == "command":
            chosen = ("--part", part) if part else ()
            into = self.out / f"{item.id} {part}"
            self.run("download", f"lab/{item.path}", "--format", "predecessor", *chosen, "-o", into)
            (written,) = into.iterdir()
        else:
            written = item.export(self.out, format="predecessor", part=part)
        return written.name, written.read_bytes()

    @property
    def _rights(self) -> dict[str, str]:
        return {"Authorization": f"Bearer {self.server.token}"}


EXPECTED = [
    "annotation run contact", "annotation run swing", "annotation turn imported", "annotation walk imported",
    "clip run", "clip turn", "clip walk", "graph grasp", "graph steps",
    "model begin", "model idle_stand", "model left", "model old", "model right", "model stand",
    "model walk_begin", "model walk_left", "processed walk_aligned",
    "record begin_history", "record fetch_input", "record statistics_run", "record train_job",
    "skeleton hik (171 cm)",
]  # fmt: skip
OWNERS = {
    "body.skeleton": "skeleton hik (171 cm)", "walk_sections.json": "annotation walk imported",
    "turn_sections.json": "annotation turn imported", "run_sections.json": "annotation run contact",
    "walk_aligned.bson.bz2": "processed walk_aligned", "steps.json": "graph steps", "grasp.mg.zip": "graph grasp",
    "left_quaternion_mm.bson.bz2": "model left",
    **{name: f"record {name.split('.')[0]}" for name in written_records.records()},
}  # fmt: skip
"""Kind and name of the item that is exported as each file, for files whose names do not give both."""


@pytest.mark.every_nth(2)
@pytest.mark.parametrize("way", get_args(Way))
def test_a_folder_with_one_of_each_goes_in_at_once_and_out_byte_for_byte(
    way: Way, lab: ProjectHandle, marey: Marey, run: CommandLine, server: ServerProcess, folder: Path, tmp_path: Path
) -> None:
    ways = Ways(lab, marey, run, server, tmp_path / "out")
    entries = ways.bring_in(way, folder)
    assert [(one.name, one.error) for one in entries if one.error is not None] == []
    assert {one.name for one in entries} == set(written_records.folder())
    (hidden,) = [one for one in entries if one.name == "train_job.json"]
    assert [one.code for one in hidden.warnings] == ["credentials-in-file"]
    found = items_of(lab)
    assert sorted(found) == EXPECTED
    require_same_numbers(found)
    assert segments_of(found["annotation walk imported"]) == [("section 1", 0, 20), ("section 2", 20, 40)]
    assert segments_of(found["annotation turn imported"]) == [("left", 0, 10), ("right", 10, 20), ("left", 20, 40)]
    assert segments_of(found["annotation run contact"]) == [("contact", 3, 6), ("contact", 11, 12)]
    mapping = found["skeleton hik (171 cm)"].mapping()
    assert mapping.joints == {name: joint for name, joint in old.skeleton_model()["joints"].items() if joint}
    assert mapping.axes["LeftArm"].swing == (0.0, 0.0, 1.0)
    require_same_graph(found)

    for name, data in written_records.folder().items():
        owner, part = PARTS.get(name, (name, None))
        kind = "model" if "_mm" in owner else "clip"
        item = found[OWNERS.get(owner) or f"{kind} {owner.split('.')[0].removesuffix('_mm')}"]
        called, content = ways.take_out(way, item, part)
        assert name in called
        assert content == data, name
    again = ways.bring_in("command" if way == "job" else way, folder)
    assert {entry.status for entry in again} == {"unchanged", "companion"}


def require_same_graph(found: dict[str, Any]) -> None:
    """Check that the graph `grasp` and its models have the contents of the archive."""
    graph = found["graph grasp"].part("graph")
    node = graph["actions"]["walk"]["primitives"]["walk_begin"]
    begin = found["model walk_begin"]
    assert (node["model"]["item"], node["type"]) == (begin.id, "start")
    assert node["transitions"] == [{"action": "walk", "primitive": "walk_left"}]
    assert begin.part("model")["keyframes"] == {"contact": 30, "last": 47, "contact0": 20}
    require_same_model(begin.part("model"), models.layout_3(11, old.joints_of(old.RIG)))
    samples = np.sort(np.array(old.cluster_tree()["data"], np.float32), axis=0)
    np.testing.assert_array_equal(np.sort(begin.part("tree")["samples"], axis=0), samples)


def test_an_annotation_of_a_stored_clip_is_given_back_until_it_is_changed(
    lab: ProjectHandle, run: CommandLine, folder: Path, tmp_path: Path
) -> None:
    names = ("body.skeleton", "walk.bson.bz2")
    lab.upload([folder / name for name in names], collection="old", shown=False)
    odd = b' {"sections":\n{"swing": [{"start_idx": 0, "end_idx": 9}], "contact": [{"start_idx": 10, "end_idx": -1}]} }'
    (tmp_path / "late.json").write_bytes(odd)
    place = run("annotation", "import", "lab/old/walk", tmp_path / "late.json").stdout.strip()
    written = run("annotation", "export", place, "-o", "out").stdout.strip()
    assert (tmp_path / written).read_bytes() == odd
    (clip,) = lab.clips.list(path="old/walk")
    packed = old.encode({"sections": {"all": [{"start_idx": 0, "end_idx": -1}]}}, "one.bson.bz2")
    (tmp_path / "one.bson.bz2").write_bytes(packed)
    made = clip.import_annotation(tmp_path / "one.bson.bz2", layer="packed")
    assert made.export(tmp_path / "out", format="predecessor").read_bytes() == packed
    assert segments_of(made) == [("all", 0, 40)]

    run("annotation", "move", place, 10, "--end", 39)
    again = run("annotation", "export", place, "-o", "out").stdout.strip()
    assert json.loads((tmp_path / again).read_bytes())["sections"]["contact"] == [{"start_idx": 10, "end_idx": 38}]
    (tmp_path / "late.json").write_bytes(b"{")
    refused = run("annotation", "import", "lab/old/walk", tmp_path / "late.json", "--layer", "b", status=1)
    assert "late.json: the document cannot be read" in refused.stderr


def test_a_record_whose_fields_were_edited_is_no_longer_its_file(lab: ProjectHandle, tmp_path: Path) -> None:
    (tmp_path / "train_job.json").write_bytes(written_records.records()["train_job.json"])
    lab.upload(tmp_path / "train_job.json", shown=False)
    (record,) = lab.items(Kind.RECORD).list()
    assert record.item.summary == {"form": "job", "fields": 20}
    document = record.part("record")
    record.put_part("record", {**document, "fields": {**document["fields"], "/job_name": "another"}})
    with pytest.raises(RequestFailed, match="no longer the imported file"):
        record.export(tmp_path / "out", format="predecessor")
    kept = record.export(tmp_path / "out", format="predecessor", revision=1)
    assert kept.read_bytes() == (tmp_path / "train_job.json").read_bytes()


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
