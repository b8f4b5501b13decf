"""Workflow of a dataset that other programs use: exported in all layouts, and uploaded again, as the page shows."""

from __future__ import annotations

import csv
import json
import re
import shlex
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.support.command_line import CommandLine
from tests.support.version_in_memory import tree

from marey_client.errors import CannotExport, Conflict, FolderNotEmpty
from marey_client.handles.clips import ClipHandle
from marey_client.handles.versions import DatasetHandle
from marey_client.jobs import Jobs
from marey_client.marey import Marey
from marey_client.project import ProjectHandle
from marey_motion.formats import write_bvh
from marey_motion.gait import generate_gait
from marey_schemas.datasets.exports import ExportedFolder
from marey_schemas.encoding.digests import digest_of_file
from marey_schemas.kinds import Kind
from marey_versions.records import revision_content

pytestmark = pytest.mark.timeout(300)

PAGE = Path(__file__).parents[3] / "docs" / "how-to" / "use-a-dataset-elsewhere.md"


@pytest.fixture
def project(lab_of: Callable[..., ProjectHandle], run: CommandLine, tmp_path: Path) -> ProjectHandle:
    """A project with the dataset `gaits`: walks with take records; one of the walks is the result of a job."""
    for name, step in (("walk", 0.5), ("turn", 0.6)):
        (tmp_path / f"{name}.bvh").write_bytes(write_bvh(generate_gait(1.3, step, 1.0)))
    made = lab_of(tmp_path / "walk.bvh", tmp_path / "turn.bvh", collection="gaits/raw")
    record = {"subject": "02", "action": "walk, slowly", "licence": "CC BY 4.0", "consent_for": ("research",)}
    clip(made, "walk").put_info(clip(made, "walk").info().model_copy(update={**record, "comment": 'a "comment"\n2'}))
    run("tag", "lab/gaits/raw/turn", "--add", "fast")
    made.datasets.create("gaits", collection="gaits")
    gaits = gaits_of(made)
    gaits.commit("Takes")
    job = made.edit([clip(made, "walk")], [{"command": "smooth", "frames": [2, 20]}], into="gaits/smooth")
    Jobs(made.transport).wait(job.id, timeout_s=120)
    clip(made, "turn").annotate("steps")
    gaits.commit("Smoothed walk")
    gaits.create_tag("v1")
    return made


def clip(project: ProjectHandle, name: str, collection: str | None = None) -> ClipHandle:
    (found,) = (one for one in project.clips.list(collection=collection) if one.name == name)
    return found


def gaits_of(project: ProjectHandle) -> DatasetHandle:
    return project.datasets.at("gaits")


def commands() -> list[list[str]]:
    return [shlex.split(line)[1:] for line in re.findall(r"^marey .*$", PAGE.read_text("utf-8"), re.MULTILINE)]


def test_the_page(run: CommandLine, marey: Marey, project: ProjectHandle, monkeypatch: pytest.MonkeyPatch) -> None:
    for command in commands():
        run(*command)
    studio = ProjectHandle(project.transport, "studio")
    try:
        names = {one.path for one in project.clips.list(collection="gaits")}
        assert {one.path for one in studio.clips.list()} == names
        for one in studio.clips.list():
            again = clip(project, one.name, one.item.collection)
            sent, kept = one.info(), again.info()
            for name in ("subject", "action", "licence", "consent_for", "comment"):
                assert getattr(sent, name) == getattr(kept, name), (one.path, name)
            assert one.item.tags == again.item.tags
            assert np.allclose(one.motion().poses, again.motion().poses, atol=1e-4)
        monkeypatch.chdir(run.folder)
        for example in re.findall(r"```python\n(.*?)```", PAGE.read_text("utf-8"), re.DOTALL):
            exec(example, {"marey": marey})  # the examples of the page
        again = clip(studio, "walk", "again/raw")
        assert again.info().consent_for == ("research",)
        assert np.array_equal(again.motion().poses, clip(project, "walk", "gaits/raw").motion().poses)
    finally:
        studio.delete()


def test_the_sidecar_names_the_version_and_the_origin_of_each_clip(
    run: CommandLine, project: ProjectHandle, tmp_path: Path
) -> None:
    gaits, out = gaits_of(project), tmp_path / "out"
    told = json.loads(run("dataset", "export", "lab/gaits@v1", out, "--json").stdout)
    head = gaits.at("v1")
    assert (told["commit"], told["clips"], told["left_out"]) == (head.digest, 3, {"annotation": 1})
    text = (out / "marey.json").read_text("utf-8")
    assert project.transport.url not in text
    found = ExportedFolder.model_validate_json(text)
    assert (found.dataset, found.commit, found.tag, found.author) == ("gaits", head.digest, "v1", head.author)
    assert (found.format, found.unit, found.licences) == ("bvh", "cm", ("CC BY 4.0",))
    entries = {one.path: one for one in gaits.entries("v1") if one.kind is Kind.CLIP}
    assert [one.path for one in found.clips] == sorted(entries)
    for one in found.clips:
        assert one.content == revision_content("clip", entries[one.path].parts)
        assert (one.file, one.digest) == (f"{one.path}.bvh", digest_of_file(out / f"{one.path}.bvh"))
    made, turn, walk = (by_name(found, name) for name in ("smooth/", "raw/turn", "raw/walk"))
    assert made.job is not None
    used = made.job.inputs[0]
    assert (made.job.kind, used.role, used.kind) == ("edit", "clips", "clip")
    assert used.item == clip(project, "walk", "gaits/raw").id
    assert turn.tags == ("fast",)
    assert walk.job is None
    assert walk.source is not None
    assert (walk.source.name, walk.source.digest) == ("walk.bvh", digest_of_file(tmp_path / "walk.bvh"))
    with (out / "records.csv").open(newline="", encoding="utf-8") as table:
        rows = {row["clip"]: row for row in csv.DictReader(table)}
    assert (rows["raw/walk"]["action"], rows["raw/turn"]["action"]) == ("walk, slowly", "")
    run("record", "lab/gaits", "--table", out / "records.csv")  # the table has the form that the command reads


def by_name(found: ExportedFolder, name: str) -> Any:
    return next(one for one in found.clips if one.path.startswith(name))


def test_the_same_commit_gives_the_same_bytes_whatever_happens_later(
    run: CommandLine, project: ProjectHandle, tmp_path: Path
) -> None:
    for layout in ("files", "huggingface", "lerobot"):
        run("dataset", "export", "lab/gaits@v1", tmp_path / f"{layout}1", "--as", layout)
    run("mv", "lab/gaits/raw/walk", "lab/gaits/raw/stroll")
    clip(project, "turn").put_info(clip(project, "turn").info().model_copy(update={"action": "turn"}))
    gaits_of(project).commit("Rename")
    for layout in ("files", "huggingface", "lerobot"):
        run("dataset", "export", "lab/gaits@v1", tmp_path / f"{layout}2", "--as", layout)
        assert tree(tmp_path / f"{layout}1") == tree(tmp_path / f"{layout}2")


def test_an_ended_consent_refuses_all_layouts(run: CommandLine, project: ProjectHandle, tmp_path: Path) -> None:
    past = datetime.now(UTC).date() - timedelta(days=2)
    walk = clip(project, "walk", "gaits/raw")
    walk.put_info(walk.info().model_copy(update={"consent_until": past}))
    for layout in ("files", "huggingface", "lerobot"):
        out = tmp_path / layout
        refused = run("dataset", "export", "lab/gaits@v1", out, "--as", layout, status=1)
        assert "consent" in refused.stderr
        assert not out.exists()
        run("dataset", "export", "lab/gaits@v1", out, "--as", layout, "--allow-expired-consent", "the lab agreed")
        assert (out / "marey.json").is_file()
    with pytest.raises(Conflict):
        gaits_of(project).export_files(tmp_path / "never", "v1", path="raw")
    gaits_of(project).export_files(tmp_path / "others", "v1", path="smooth", allow_expired_consent="the lab agreed")
    recorded = [one.about for one in project.audit(kind="consent.overridden")]
    assert recorded == ["walk"] * 5  # of each version, and of each of its files that the server wrote


def test_names_that_not_all_systems_accept_come_back(run: CommandLine, project: ProjectHandle, tmp_path: Path) -> None:
    walk = clip(project, "walk", "gaits/raw")
    parts = {name: walk.part(name) for name in ("motion", "info")}
    for folder, name in (
        ("gaits/a:b", "con"),
        ("gaits/A", "x?"),
        ("gaits/a", "X?"),
        ("gaits", "marey"),
        ("gaits/.h", "é"),
    ):
        project.clips.create(name, parts, collection=folder)
    gaits_of(project).commit("Names")
    told = json.loads(run("dataset", "export", "lab/gaits", "out", "--json").stdout)
    assert told["renamed"]["a:b/con"] == "a_b/con_.bvh"
    assert len({name.casefold() for name in told["renamed"].values()}) == len(told["renamed"])
    run("project", "create", "studio")
    run("upload", "out", "--project", "studio", "--collection", "gaits")
    studio = ProjectHandle(project.transport, "studio")
    found = {one.path for one in studio.clips.list()}
    studio.delete()
    assert found == {one.path for one in project.clips.list(collection="gaits")}


def test_a_path_that_leads_elsewhere_is_refused(run: CommandLine, project: ProjectHandle, tmp_path: Path) -> None:
    walk = clip(project, "walk", "gaits/raw")
    project.clips.create("..", {"motion": walk.part("motion")}, collection="gaits/raw")
    gaits_of(project).commit("Tricks")
    with pytest.raises(CannotExport, match=r"'raw/\.\.' cannot be a file"):
        gaits_of(project).export_files(tmp_path / "deep/out")
    assert not (tmp_path / "deep").exists()


def test_an_interrupted_command_leaves_nothing_and_a_full_folder_is_kept(
    run: CommandLine, project: ProjectHandle, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "full").mkdir()
    (tmp_path / "full/mine").write_text("mine")
    refused = run("dataset", "export", "lab/gaits", tmp_path / "full", status=1)
    assert "is not empty" in refused.stderr
    with pytest.raises(FolderNotEmpty):
        gaits_of(project).export_huggingface(tmp_path / "full/mine")
    before = sorted(path.name for path in tmp_path.iterdir())

    def stop(_what: str, done: int, _total: int | None) -> None:
        if done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        gaits_of(project).export_files(tmp_path / "out", on_progress=stop)
    assert sorted(path.name for path in tmp_path.iterdir()) == before


def test_other_skeletons_must_be_retargeted_before_an_export_to_lerobot(
    run: CommandLine, project: ProjectHandle, tmp_path: Path
) -> None:
    rig = project.skeletons.get(clip(project, "turn").item.summary["skeleton"])
    hierarchy = rig.part("hierarchy")
    hierarchy["joints"][1]["offset"] = [0.2, 0.1, 0.0]
    other = project.skeletons.create("other", {"hierarchy": hierarchy}, collection="skeletons")
    motion = clip(project, "turn").part("motion")
    motion["skeleton"] = {"item": other.id, "revision": 1}
    project.clips.create("x-tall", {"motion": motion}, collection="gaits/raw")
    gaits_of(project).commit("Another performer")
    refused = run("dataset", "export", "lab/gaits", "out", "--as", "lerobot", status=1)
    assert "raw/x-tall (another skeleton)" in refused.stderr
    assert "retarget" in refused.stderr
    assert not (run.folder / "out").exists()


def test_wrong_use_is_explained(run: CommandLine, project: ProjectHandle) -> None:
    assert "files, huggingface" in run("dataset", "export", "lab/gaits", "out", "--as", "zip", status=2).stderr
    assert (
        "no meaning"
        in run("dataset", "export", "lab/gaits", "out", "--as", "lerobot", "--format", "bvh", status=2).stderr
    )
    assert "not one of the formats" in run("dataset", "export", "lab/gaits", "out", "--format", "json", status=1).stderr
    assert "has no clips below" in run("dataset", "export", "lab/gaits", "out", "--path", "nothing", status=1).stderr
    run("dataset", "export", "lab/gaits@v1", "episodes", "--as", "lerobot")
    assert "is a LeRobotDataset" in run("upload", "episodes", "--project", "lab", status=1).stderr
    (run.folder / "episodes/marey.json").write_text("{}")
    assert "is not the sidecar of an export" in run("upload", "episodes", "--project", "lab", status=1).stderr


def test_a_changed_table_is_not_used_and_the_command_that_applies_it_is_named(
    run: CommandLine, project: ProjectHandle
) -> None:
    run("dataset", "export", "lab/gaits@v1", "out")
    table = run.folder / "out/records.csv"
    table.write_text(table.read_text("utf-8").replace("CC BY 4.0", "CC0"), encoding="utf-8")
    told = run("upload", "out", "--project", "lab", "--collection", "copies", "--subject", "07")
    assert "records.csv was changed after the export" in told.stderr
    info = clip(project, "walk", "copies/raw").info()
    assert (info.action, info.licence) == ("walk, slowly", "CC BY 4.0")
    assert info.subject == "07"  # given with the upload
    run(*shlex.split(told.stderr.partition("run marey ")[2].strip()))
    assert clip(project, "walk", "copies/raw").info().licence == "CC0"


@pytest.mark.every_nth(2)
@pytest.mark.parametrize("layout", ["files", "huggingface"])
def test_other_formats_come_back(
    run: CommandLine,
    project: ProjectHandle,
    layout: str,
) -> None:
    run("dataset", "export", "lab/gaits@v1", "out", "--as", layout, "--format", "npz")
    assert "left out" not in run("upload", "out", "--project", "lab", "--collection", "copies").stderr
    refused = run("build-model", "out", "--project", "lab", "--name", "walks", status=2).stderr
    expected = "first import the folder with `marey upload`, which also imports take records and consents"
    assert expected in " ".join(refused.split())
    for one in project.clips.list(collection="gaits"):
        again = clip(project, one.name, f"copies/{one.item.collection.removeprefix('gaits/')}")
        assert np.allclose(one.motion().poses, again.motion().poses, atol=1e-4)
        assert (again.info().subject, again.item.tags) == (one.info().subject, one.item.tags)
