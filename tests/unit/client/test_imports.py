"""Import of folders of files."""

import json
import os
import time
from collections.abc import Iterable, Iterator
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, cast

import httpx
import pytest
from tests.support.scripted_server import ScriptedServer

from marey_client import errors
from marey_client.imports import (
    FILES_PER_IMPORT,
    Imports,
    LocalFile,
    batches,
    find_files,
    left_out_texts,
    refusal_text,
)
from marey_schemas.imports import NO_MODEL
from marey_schemas.options.imports import ImportOptions


def named(names: list[str], size: int = 100) -> list[LocalFile]:
    return [LocalFile(name, cast(Any, None), size) for name in names]


def names_of(portions: Iterator[Any]) -> list[list[str]]:
    return [[file.name for file in portion] for portion in portions]


def test_folders_are_searched_and_other_files_are_named_as_left_out(tmp_path: Path) -> None:
    for name in ("b/walk.bvh", "a/01.asf", "a/01_01.AMC", "notes.txt", ".hidden/x.bvh", "b/.y.bvh"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("x")
    found = find_files([tmp_path])
    assert [file.name for file in found.files] == ["a/01.asf", "a/01_01.AMC", "b/walk.bvh"]
    assert [path.name for path in found.left_out] == ["notes.txt", ".hidden", ".y.bvh"]


def test_what_is_left_out_is_named_by_kind_and_in_full(tmp_path: Path) -> None:
    for name in ("walk.bvh", "a.FBX", "b.fbx", "take.trc", "notes.txt", "README", ".old.bvh", "._walk.bvh"):
        (tmp_path / name).write_text("x")
    found = find_files([tmp_path])
    assert left_out_texts(found.left_out) == [
        "left out: 2 FBX: not readable here, export as BVH (a.FBX, b.fbx)",
        "left out: 1 TRC: not readable here, export as BVH (take.trc)",
        "left out: 1 TXT: not motion (notes.txt)",
        "left out: 1 hidden BVH: name them to import them (.old.bvh)",
        "left out: 1 without ending: not motion (README)",
    ]
    assert [path.name for path in found.motions_left_out] == ["a.FBX", "b.fbx", "take.trc", ".old.bvh"]
    (tmp_path / "walk.bvh").unlink()
    with pytest.raises(errors.NothingToUpload, match="2 FBX: not readable here, export as BVH"):
        find_files([tmp_path])


def test_a_file_named_itself_is_taken_whatever_it_is(tmp_path: Path) -> None:
    path = tmp_path / "odd.ending"
    path.write_text("x")
    assert [file.name for file in find_files([path]).files] == ["odd.ending"]


def test_folders_and_links_that_are_not_followed_are_named_if_there_is_motion(tmp_path: Path) -> None:
    takes, elsewhere = tmp_path / "takes", tmp_path / "elsewhere"
    for path in (
        takes / "walk.bvh",
        takes / ".git" / "index",
        takes / "b" / ".old" / "c" / "run.fbx",
        elsewhere / "x.bvh",
    ):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(b"x")
    (takes / "more").symlink_to(elsewhere)
    (takes / "same.bvh").symlink_to(elsewhere / "x.bvh")
    (takes / "gone.bvh").symlink_to(elsewhere / "nothing.bvh")
    found = find_files(takes)
    assert [file.name for file in found.files] == ["same.bvh", "walk.bvh"]
    assert left_out_texts(found.left_out) == [
        "left out: 1 BVH: a link that leads nowhere (gone.bvh)",
        "left out: 1 hidden folder with motion: name it to import it (.old)",
        "left out: 1 linked folder with motion: name it to import it (more)",
    ]
    assert len(found.motions_left_out) == 3


def test_files_that_would_get_one_name_are_refused_and_none_is_left_out_silently(tmp_path: Path) -> None:
    for name in ("monday/walk.bvh", "tuesday/walk.bvh"):
        (tmp_path / name).parent.mkdir()
        (tmp_path / name).write_text("x")
    with pytest.raises(
        errors.SameName, match=r"monday/walk\.bvh and .*tuesday/walk\.bvh would both get the name walk\.bvh"
    ):
        find_files([tmp_path / "monday", tmp_path / "tuesday"])
    assert len(find_files([tmp_path]).files) == 2
    assert len(find_files([tmp_path / "monday", tmp_path / "monday/walk.bvh"]).files) == 1


@pytest.mark.parametrize("name", ["clip.bson", "clip.BSON.bz2", "clip.npz", "clip.json", "lab.skeleton"])
def test_every_format_with_a_reader_is_found_in_a_folder(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text("x")
    assert [file.name for file in find_files([tmp_path]).files] == [name]


@pytest.mark.parametrize("place", ["absent", "."])
def test_places_without_motion_are_an_error_that_says_so(tmp_path: Path, place: str) -> None:
    with pytest.raises(errors.NothingToUpload, match=r"does not exist|no motion files"):
        find_files([tmp_path / place])


def test_every_amc_travels_with_the_asf_of_its_folder() -> None:
    takes = [f"16/16_{number:03d}.amc" for number in range(2 * FILES_PER_IMPORT)]
    portions = names_of(batches(named(["16/16.asf", *takes])))
    assert len(portions) > 2
    assert all("16/16.asf" in portion for portion in portions)
    assert sorted(name for portion in portions for name in portion if name != "16/16.asf") == takes


def test_files_that_differ_in_their_ending_alone_stay_together() -> None:
    names = [f"t/{number:03d}.{ending}" for number in range(FILES_PER_IMPORT) for ending in ("bvh", "npz")]
    for portion in names_of(batches(named(names))):
        stems = [name.partition(".")[0] for name in portion]
        assert all(stems.count(stem) == 2 for stem in stems)
        assert len(portion) <= FILES_PER_IMPORT


def test_large_files_make_small_portions() -> None:
    portions = names_of(batches(named([f"{number}.bvh" for number in range(6)], size=40 << 20)))
    assert [len(portion) for portion in portions] == [1] * 6


def test_only_bytes_the_server_lacks_are_sent_and_each_file_gets_its_entry(
    script: ScriptedServer, tmp_path: Path
) -> None:
    for name in ("a.bvh", "b.bvh", "copy-of-b.bvh", "c.bvh"):
        (tmp_path / name).write_text(name.removeprefix("copy-of-"))
    sent, imported = [], []

    def answer(request: httpx.Request) -> httpx.Response:
        if request.method == "PUT":
            sent.append(request.content)
            return httpx.Response(204)
        body = json.loads(request.content)
        if request.url.path.endswith("/blobs/missing"):
            assert len(body["digests"]) == 3
            return httpx.Response(200, json={"missing": body["digests"][:2]})
        imported.append(body)
        entries = [
            {"name": file["name"], "status": "failed" if file["name"] == "c.bvh" else "created", "frames": 10}
            for file in body["files"]
        ]
        return httpx.Response(200, json={"entries": entries})

    script.answers = [answer] * 10
    told = []
    entries = (
        script.marey()
        .project("lab")
        .imports.upload(
            find_files([tmp_path]).files,
            ImportOptions(collection="raw", unit="cm"),
            notice=lambda *news: told.append(news),
        )
    )
    assert sorted(sent) == [b"a.bvh", b"b.bvh"]
    assert [(entry.name, entry.status) for entry in entries] == [
        ("a.bvh", "created"), ("b.bvh", "created"), ("c.bvh", "failed"), ("copy-of-b.bvh", "created"),
    ]  # fmt: skip
    assert imported[0]["collection"] == "raw"
    assert imported[0]["unit"] == "cm"
    assert "up_axis" not in imported[0]
    assert told[-1] == ("importing", 4, 4)


@pytest.mark.parametrize(("name", "shown"), [(b"caf\xe9.bvh", r"caf\udce9.bvh"), (b"new\nline.bvh", r"new\nline.bvh")])
def test_a_file_whose_name_cannot_be_sent_is_refused_and_keeps_no_other_out(
    script: ScriptedServer, tmp_path: Path, name: bytes, shown: str
) -> None:
    (tmp_path / "walk.bvh").write_text("x")
    (tmp_path / os.fsdecode(name)).write_text("y")

    def answer(request: httpx.Request) -> httpx.Response:
        body = json.loads(request.content)
        if request.url.path.endswith("/blobs/missing"):
            return httpx.Response(200, json={"missing": []})
        return httpx.Response(
            200, json={"entries": [{"name": file["name"], "status": "created"} for file in body["files"]]}
        )

    script.answers = [answer] * 2
    lab = script.marey().project("lab")
    files = find_files([tmp_path]).files
    entries = {entry.name: entry for entry in lab.imports.upload(files)}
    assert {name: entry.status for name, entry in entries.items()} == {shown: "failed", "walk.bvh": "created"}
    assert "rename the file (file-name)" in refusal_text(entries[shown])
    assert script.answers == []
    with pytest.raises(errors.BadFileName, match="rename the file"):
        lab.imports.send(files)


def test_a_folder_that_cannot_be_read_is_never_passed_over_in_silence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "walk.bvh").write_text("x")
    (tmp_path / "locked").mkdir()
    scan = os.scandir

    def scan_all_but_one(folder: str) -> AbstractContextManager[Iterator[os.DirEntry[str]]]:
        if os.fspath(folder).endswith("locked"):
            raise PermissionError(13, "Permission denied", folder)
        return scan(folder)

    monkeypatch.setattr(os, "scandir", scan_all_but_one)
    with pytest.raises(PermissionError, match="locked"):
        find_files([tmp_path])


def test_places_may_be_texts_and_are_named_where_they_hold_no_motion(tmp_path: Path) -> None:
    (tmp_path / "walk.bvh").write_text("x")
    assert [file.name for file in find_files([str(tmp_path)]).files] == ["walk.bvh"]
    (tmp_path / "empty").mkdir()
    with pytest.raises(errors.NothingToUpload, match=r"in .*empty"):
        find_files(iter([str(tmp_path / "empty")]))


def test_an_asf_never_travels_without_the_amc_files_that_need_it() -> None:
    others = [f"a/{number:03d}.bvh" for number in range(FILES_PER_IMPORT - 1)]
    names = [*others, "b/b.asf", "b/b_01.amc", "b/b_02.amc", "c/c.asf"]
    portions = names_of(batches(named(names)))
    assert sorted({name for portion in portions for name in portion}) == names
    assert all(any(name.endswith(".amc") for name in portion) for portion in portions if "b/b.asf" in portion)


@pytest.mark.parametrize(
    ("companion", "file"), [("{}_cluster_tree.json", "{}_mm.json"), ("{}_skeleton.json", "{}_take.bson.bz2")]
)
def test_files_that_belong_together_travel_together(companion: str, file: str) -> None:
    stems = [f"m/walk{number:03d}" for number in range(FILES_PER_IMPORT)]
    names = ["a/alone.bvh", *sorted(pattern.format(stem) for stem in stems for pattern in (companion, file))]
    portions = names_of(batches(named(names)))
    assert sorted(name for portion in portions for name in portion) == names
    for portion in portions:
        assert len(portion) <= FILES_PER_IMPORT
        assert all((companion.format(stem) in portion) == (file.format(stem) in portion) for stem in stems)


def test_an_amc_travels_with_its_own_asf_alone_if_its_name_tells_which_it_is() -> None:
    subjects = range(2 * FILES_PER_IMPORT)
    names = [f"all/{subject}{ending}" for subject in subjects for ending in (".asf", "_01.amc", "_02.amc")]
    portions = names_of(batches(named(names)))
    assert len(portions) < 10
    for portion in portions:
        assert len(portion) <= FILES_PER_IMPORT
        assert {name.partition("_")[0] for name in portion if name.endswith(".amc")} == {
            name.removesuffix(".asf") for name in portion if name.endswith(".asf")
        }


def test_an_amc_whose_asf_is_unclear_travels_with_all_of_its_folder() -> None:
    others = [f"a/{number:03d}.bvh" for number in range(FILES_PER_IMPORT - 2)]
    portions = names_of(batches(named([*others, "b/1.asf", "b/1_01.amc", "b/2.asf", "b/take.amc"])))
    (portion,) = (one for one in portions if "b/take.amc" in one)
    assert {"b/1.asf", "b/2.asf"} <= set(portion)


class FullDisk:
    """Blobs of a server that stores nothing."""

    def __init__(self) -> None:
        self.sent: list[str] = []

    def missing(self, digests: Iterable[str]) -> set[str]:
        return set(digests)

    def put_file(self, _path: Path, *, digest: str) -> None:
        self.sent.append(digest)
        time.sleep(0.01)
        raise errors.Unreachable("the server has stopped")


def test_after_a_failure_no_further_file_is_sent(tmp_path: Path) -> None:
    for number in range(200):
        (tmp_path / f"walk-{number}.bvh").write_text(str(number))
    full: Any = FullDisk()
    nothing: Any = None
    with pytest.raises(errors.Unreachable):
        Imports(nothing, "lab", full, nothing).send(find_files([tmp_path]).files)
    assert len(full.sent) < 100


def test_graphs_that_were_sent_before_their_models_are_sent_again(script: ScriptedServer, tmp_path: Path) -> None:
    graphs = [f"graph {number:03d}.json" for number in range(FILES_PER_IMPORT + 1)]
    for name in [*graphs, "model_mm.json"]:
        (tmp_path / name).write_text(name)
    portions: list[list[str]] = []

    def answer(request: httpx.Request) -> httpx.Response:
        if request.method == "PUT":
            return httpx.Response(204)
        body = json.loads(request.content)
        if request.url.path.endswith("/blobs/missing"):
            return httpx.Response(200, json={"missing": []})
        portions.append([file["name"] for file in body["files"]])
        error = {"code": NO_MODEL, "detail": "no model"}
        entries = [
            {"name": name, "status": "failed", "error": error}
            if name in graphs and len(portions) <= 2
            else {"name": name, "status": "created"}
            for name in portions[-1]
        ]
        return httpx.Response(200, json={"entries": entries})

    script.answers = [answer] * 10
    entries = script.marey().project("lab").imports.upload(find_files([tmp_path]).files)
    assert portions == [graphs[:-1], [graphs[-1], "model_mm.json"], graphs[:-1], graphs[-1:]]
    assert [entry.status for entry in entries] == ["created"] * (FILES_PER_IMPORT + 2)


def test_a_graph_whose_models_are_nowhere_is_sent_once_if_all_files_were_sent_together(
    script: ScriptedServer, tmp_path: Path
) -> None:
    (tmp_path / "graph.json").write_text("graph")
    refused = {"name": "graph.json", "status": "failed", "error": {"code": NO_MODEL, "detail": "no model"}}
    script.answers = [
        httpx.Response(200, json={"missing": []}),
        httpx.Response(200, json={"entries": [refused]}),
    ]
    (entry,) = script.marey().project("lab").imports.upload(find_files([tmp_path]).files)
    assert entry.status == "failed"
