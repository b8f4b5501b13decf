"""Exported folders: names of files, cards of the Hugging Face Hub, sidecars (`marey.json`), and a later import."""

from __future__ import annotations

import csv
import io
from pathlib import Path
from typing import Any, cast

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from tests.support.version_in_memory import VersionInMemory, tree

from marey_client.bridges import files, huggingface
from marey_client.bridges.files import MotionFiles
from marey_client.bridges.folders import file_names, new_folder
from marey_client.bridges.huggingface import dataset_card, size_category, write_huggingface
from marey_client.bridges.sidecars import SidecarWriter, read_sidecar
from marey_client.errors import BadSidecar, CannotExport, FolderNotEmpty, NothingToUpload
from marey_client.handles.versions import DatasetHandle
from marey_client.imports import find_files
from marey_motion.gait import generate_gait
from marey_schemas.datasets.exports import ExportedClip, ExportedIdentity, ExportedRecord

IDENTITY = ExportedIdentity(
    dataset="gaits", commit="sha256:" + "ab" * 32, tag="v1", author="ada", at="2026-11-23T10:00:00.000000Z",
    message="First takes",
)  # fmt: skip
CONTENT = "sha256:" + "cd" * 32


@pytest.mark.parametrize(
    ("path", "file"),
    [
        ("raw/walk", "raw/walk.bvh"),
        ("raw/walk.1", "raw/walk.1.bvh"),
        ("a:b/what?", "a_b/what_.bvh"),
        ("con/Lpt1", "con_/Lpt1_.bvh"),
        ("aux.txt/nul.a", "aux_.txt/nul_.a.bvh"),
        ("ends. /.hidden", "ends/hidden.bvh"),
        ("console/é", "console/é.bvh"),
        ("a\\..\\b", "a_.._b.bvh"),
    ],
)
def test_paths_become_names_that_all_systems_accept(path: str, file: str) -> None:
    assert file_names([path], ".bvh") == [file]


@pytest.mark.parametrize("path", ["..", "../x", "a/../b", "a/.", "a//b", "/etc/passwd", "a/ .. /b"])
def test_paths_that_lead_elsewhere_are_refused(path: str) -> None:
    with pytest.raises(CannotExport, match="cannot be a file"):
        file_names(["fine", path], ".bvh")


def test_files_never_share_a_name_with_another_file_or_a_folder() -> None:
    paths = ["Walk", "walk", "a?", "a*", "x.bvh/y", "x", "records"]
    names = file_names(paths, ".bvh", reserved=("records.bvh",))
    assert names == [
        "Walk.bvh", "walk (2).bvh", "a_.bvh", "a_ (2).bvh", "x.bvh/y.bvh", "x (2).bvh", "records (2).bvh",
    ]  # fmt: skip


NAME = st.text(
    st.characters(exclude_characters="/", min_codepoint=32, exclude_categories=["Cs", "Cc"]), min_size=1, max_size=80
)


@given(st.lists(st.lists(NAME, min_size=1, max_size=4).map("/".join), max_size=8, unique=True))
def test_files_of_any_paths_are_distinct_and_stay_below_the_folder(paths: list[str]) -> None:
    try:
        names = file_names(paths, ".bvh")
    except CannotExport:
        assert any(name.strip() in ("", ".", "..") for path in paths for name in path.split("/"))
        return
    assert len({name.casefold() for name in names}) == len(paths)
    root = Path("/somewhere/out")
    for name in names:
        assert (root / name).is_relative_to(root)
        assert not {"..", "."} & set(name.split("/"))
        assert all(0 < len(step.encode()) <= 255 and not step.startswith(".") for step in name.split("/"))
    folders = {parent.as_posix().casefold() for name in names for parent in Path(name).parents}
    assert not folders & {name.casefold() for name in names}


def test_a_folder_appears_when_it_is_complete(tmp_path: Path) -> None:
    target = tmp_path / "new" / "out"
    with new_folder(target) as folder:
        (folder / "file").write_text("text")
        assert not target.exists()
    assert tree(tmp_path) == {"new/out/file": b"text"}
    target = tmp_path / "empty"
    target.mkdir()
    with new_folder(target) as folder:
        (folder / "file").write_text("text")
    assert tree(target) == {"file": b"text"}
    with pytest.raises(FolderNotEmpty, match="not empty"), new_folder(target):
        pass
    with pytest.raises(FolderNotEmpty, match="is a file"), new_folder(target / "file"):
        pass
    assert sorted(path.name for path in tmp_path.iterdir()) == ["empty", "new"]


def test_a_folder_that_fills_up_meanwhile_is_kept(tmp_path: Path) -> None:
    target = tmp_path / "out"

    def fill_up() -> None:
        with new_folder(target):
            target.mkdir()
            (target / "mine").write_text("mine")

    with pytest.raises(OSError, match="not empty"):
        fill_up()
    assert tree(tmp_path) == {"out/mine": b"mine"}


def metadata_of(card: str) -> dict[str, Any]:
    _, metadata, text = card.split("---\n", 2)
    assert text.startswith("\n# ")
    found: dict[str, Any] = yaml.safe_load(metadata)
    return found


@pytest.mark.parametrize(
    ("licences", "license", "name"),
    [
        (["CC BY 4.0"], "cc-by-4.0", None),
        (["cc0-1.0", "CC0-1.0"], "cc0-1.0", None),
        ([None], "unknown", None),
        (["mit", None], ["mit", "unknown"], None),
        (['My "own": licence\n# x'], "other", 'My "own": licence\n# x'),
        (["mit", "b", "a"], ["mit", "other"], "a, b"),
    ],
)  # fmt: skip
def test_the_card_has_the_metadata_of_the_hub(licences: list[str | None], license: object, name: str | None) -> None:  # noqa: A002
    identity = IDENTITY.model_copy(update={"message": '"; evil: true\n--- # <b>'})
    card = dataset_card(identity, dict.fromkeys(licences, 400), {None: 3, ("retarget", (CONTENT,)): 2}, "bvh")
    found = metadata_of(card)
    assert (found["license"], found.get("license_name")) == (license, name)
    assert found["size_categories"] == [size_category(400 * len(set(licences)))]
    assert found["configs"] == [{"config_name": "default", "data_files": [{"split": "train", "path": "metadata.csv"}]}]
    assert found["marey"] == {key: value for key, value in identity.model_dump().items() if value}
    assert "evil" not in found
    assert f"commit: `{IDENTITY.commit}`" in card
    assert f"made by jobs of the kind retarget, from `{CONTENT}`: 2 clips" in card
    assert "<b>" not in card.split("---\n", 2)[2]


@pytest.mark.parametrize(
    ("count", "name"),
    [(1, "n<1K"), (999, "n<1K"), (1000, "1K<n<10K"), (142_220, "100K<n<1M"), (10**7, "n>10M")],
)
def test_sizes_are_named_as_the_hub_names_them(count: int, name: str) -> None:
    assert size_category(count) == name


def test_no_folder_of_the_hub_has_too_many_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(huggingface, "MOST_FILES_PER_FOLDER", 4)
    walk = generate_gait(1.0, 0.0, 0.2)
    version = VersionInMemory.of({f"walks/{place:02d}": walk for place in range(10)})

    def write(_motions: MotionFiles, one: Any, target: Path) -> str:
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_text(one.clip.path)
        return CONTENT

    motions = MotionFiles(version, "bvh", None, None)
    monkeypatch.setattr(MotionFiles, "_write_one", write)
    write_huggingface(motions, tmp_path / "out", lambda *_: None)
    files = [name for name in tree(tmp_path / "out") if name.startswith("data/")]
    assert sorted(files) == [f"data/{place // 4:05d}/walks/{place:02d}.bvh" for place in range(10)]
    rows = list(csv.DictReader(io.StringIO((tmp_path / "out/metadata.csv").read_text("utf-8"))))
    assert next(iter(rows[0])) == "file_name"
    assert [(tmp_path / "out" / row["file_name"]).read_text() for row in rows] == [row["clip"] for row in rows]


def test_the_handle_of_a_dataset_writes_the_folder_of_the_hub(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    version = VersionInMemory.of({"walks/slow": generate_gait(1.0, 0.0, 0.2)})
    asked: list[object] = []

    def found(dataset: object, name: str, path: str, **_: object) -> VersionInMemory:
        asked.extend((dataset, name, path))
        return version

    def write(_motions: MotionFiles, one: Any, target: Path) -> str:
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_text(one.clip.path)
        return CONTENT

    monkeypatch.setattr(files, "version_to_export", found)
    monkeypatch.setattr(MotionFiles, "_write_one", write)
    gaits = DatasetHandle(cast(Any, None), "/projects/lab/datasets/gaits")
    done = gaits.export_huggingface(tmp_path / "out", "v1", path="walks", format="npz")
    assert asked == [gaits, "v1", "walks"]
    assert (done.clips, done.folder) == (1, tmp_path / "out")
    assert {"README.md", "data/00000/walks/slow.npz"} <= tree(tmp_path / "out").keys()


def exported_folder(folder: Path, *clips: ExportedClip, **header: Any) -> Path:
    """Write a sidecar, and a file for each clip, to a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    fields = {**IDENTITY.model_dump(exclude_none=True), "layout": "files", "format": "bvh", "unit": "m", **header}
    with SidecarWriter(folder, fields) as sidecar:
        for clip in clips:
            sidecar.add(clip)
            if clip.file is not None:
                (folder / clip.file).parent.mkdir(parents=True, exist_ok=True)
                (folder / clip.file).write_text("motion")
        sidecar.finish()
    return folder


def test_a_sidecar_is_read_as_it_was_written(tmp_path: Path) -> None:
    record = ExportedRecord(action='a, "b"\nc', licence="mit", consent_for=("research",))
    clip = ExportedClip(path="raw/é", content=CONTENT, file="raw/é.bvh", tags=("a",), record=record)
    found = read_sidecar(exported_folder(tmp_path, clip))
    assert found is not None
    assert (found.clips, found.licences, found.commit) == ((clip,), ("mit",), IDENTITY.commit)
    assert read_sidecar(tmp_path / "raw") is None


def test_files_of_an_export_are_imported_under_the_paths_of_their_clips(tmp_path: Path) -> None:
    clips = [
        ExportedClip(path="a:b/con", content=CONTENT, file="a_b/con_.bvh"),
        ExportedClip(path="gone", content=CONTENT, file="gone.bvh"),
        ExportedClip(path="outside", content=CONTENT, file="../outside.bvh"),
    ]
    folder = exported_folder(tmp_path / "out", *clips)
    (folder / "gone.bvh").unlink()
    (folder / "mine.bvh").write_text("motion")
    found = find_files(folder)
    assert {one.name: one.path.relative_to(folder).as_posix() for one in found.files} == {
        "a:b/con.bvh": "a_b/con_.bvh",
        "mine.bvh": "mine.bvh",
    }
    assert (dict(found.exported), found.unit, found.left_out) == ({"a:b/con.bvh": clips[0]}, "m", ())
    assert find_files([folder, tmp_path / "outside.bvh"]).unit is None


def test_a_damaged_sidecar_is_refused_and_names_the_place(tmp_path: Path) -> None:
    folder = exported_folder(tmp_path, ExportedClip(path="walk", content=CONTENT, file="walk.bvh"))
    whole = (folder / "marey.json").read_bytes()
    for damaged, place in (
        (whole[:-20], "JSON"),
        (whole.replace(b"export@1", b"export@9"), "schema"),
        (b"[]", "object"),
    ):
        (folder / "marey.json").write_bytes(damaged)
        with pytest.raises(BadSidecar, match=place):
            find_files(folder)


def test_a_lerobot_dataset_is_not_imported(tmp_path: Path) -> None:
    folder = exported_folder(tmp_path, ExportedClip(path="walk", content=CONTENT, episode=0), layout="lerobot")
    with pytest.raises(NothingToUpload, match="LeRobotDataset"):
        find_files(folder)
