"""Workflow of an archive: written, checked and extracted by the commands of the how-to page."""

from __future__ import annotations

import json
import re
import shlex
import tarfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.support.command_line import CommandLine

from marey_client.archives import contents, documents, receiving, writing
from marey_client.errors import RequestFailed
from marey_client.handles.clips import ClipHandle
from marey_client.handles.versions import DatasetHandle
from marey_client.project import ProjectHandle
from marey_motion.formats import write_bvh
from marey_motion.gait import generate_gait
from marey_versions.archive.reading import Archive

pytestmark = pytest.mark.timeout(300)

PAGE = Path(__file__).parents[3] / "docs" / "how-to" / "archive-a-dataset.md"


@pytest.fixture
def project(lab_of: Callable[..., ProjectHandle], run: CommandLine, tmp_path: Path) -> ProjectHandle:
    """A project with the dataset `gaits`, whose history has a merge, and a deleted clip that is in earlier versions."""
    for name, step in (("walk", 0.5), ("turn", 0.6), ("fall", 0.7)):
        (tmp_path / f"{name}.bvh").write_bytes(write_bvh(generate_gait(1.3, step, 1.0)))
    made = lab_of(*(tmp_path / f"{name}.bvh" for name in ("walk", "turn", "fall")), collection="gaits/raw")
    gaits = made.datasets.create("gaits", collection="gaits")
    gaits.commit("First takes")
    gaits.create_branch("trial")
    run("tag", "lab/gaits/raw/turn", "--add", "fast")
    gaits.commit("Tag the turn")
    gaits.check_out("trial")
    clip(made, "walk").put_info(clip(made, "walk").info().model_copy(update={"comment": "on trial"}))
    gaits.commit("Describe the walk", branch="trial")
    gaits.merge("trial")
    gaits.check_out()
    run("rm", "lab/gaits/raw/fall")
    gaits.commit("Drop the fall")
    gaits.create_tag("v1")
    return made


@pytest.fixture
def away(project: ProjectHandle, run: CommandLine) -> Iterator[ProjectHandle]:
    """An empty project, which is deleted after the test."""
    run("project", "create", "away")
    made = other_project(project, "away")
    yield made
    made.delete()


def clip(project: ProjectHandle, name: str) -> ClipHandle:
    """Return the clip with this name."""
    (found,) = (one for one in project.clips.list() if one.name == name)
    return found


def test_the_page_makes_checks_and_extracts_an_archive(run: CommandLine, project: ProjectHandle) -> None:
    create, verify, extract, *imported = re.findall(r"^marey .*$", PAGE.read_text(encoding="utf-8"), re.MULTILINE)
    run(*shlex.split(create)[1:])
    told = run(*shlex.split(verify)[1:]).stdout.splitlines()
    head = project.datasets.at("gaits").at("v1")
    assert told[-1].split() == ["commit", head.digest]
    assert [line.split()[-1] for line in told[:3]] == ["gaits", "5", "2"]
    run(*shlex.split(extract)[1:])
    found = sorted(path.name for path in (run.folder / "gaits/raw").iterdir())
    assert found == ["turn.bvh", "turn.clip.json", "walk.bvh", "walk.clip.json"]
    assert (run.folder / "gaits/raw/walk.bvh").read_bytes() == (run.folder / "walk.bvh").read_bytes()
    walk = json.loads((run.folder / "gaits/raw/walk.clip.json").read_text())
    assert walk["parts"]["info"]["comment"] == "on trial"
    assert len(walk["parts"]["motion"]["poses"]["data"]) == len(clip(project, "walk").motion().poses)
    (skeleton,) = walk["revisions"].values()
    assert skeleton["parts"]["hierarchy"]["joints"][0]["name"] == "Hips"
    for command in imported:
        run(*shlex.split(command)[1:])
    studio = other_project(project, "studio")
    assert studio.datasets.at("gaits").at() == head
    assert [one.digest for one in studio.datasets.at("gaits").log()] == [one.digest for one in gaits_of(project).log()]
    assert (clip(studio, "walk").info().comment, clip(studio, "turn").item.tags) == ("on trial", ("fast",))
    assert np.array_equal(clip(studio, "walk").motion().poses, clip(project, "walk").motion().poses)
    assert {one.item.collection for one in studio.clips.list()} == {"gaits/raw"}
    with pytest.raises(RequestFailed, match="Nothing has changed"):
        studio.datasets.at("gaits").commit("The folder has the entries of the version")
    run(*shlex.split(imported[1])[1:])
    studio.delete()


def gaits_of(project: ProjectHandle) -> DatasetHandle:
    return project.datasets.at("gaits")


def other_project(project: ProjectHandle, name: str) -> ProjectHandle:
    return ProjectHandle(project.transport, name)


def test_an_import_continues_and_sends_what_is_missing_only(
    run: CommandLine, project: ProjectHandle, away: ProjectHandle, monkeypatch: pytest.MonkeyPatch
) -> None:
    first, second = run.folder / "first.tar", run.folder / "second.tar"
    gaits_of(project).archive(first, "main~1")
    gaits_of(project).archive(second)
    copy = away.datasets.create("gaits", collection="gaits")
    once = receiving._Import._send_commit

    def fail(_sending: Any, record: Any, *more: Any) -> None:
        if record.message == "Tag the turn":
            raise ConnectionError("the server went away")
        once(_sending, record, *more)

    with monkeypatch.context() as broken:
        broken.setattr(receiving._Import, "_send_commit", fail)
        with pytest.raises(ConnectionError):
            away.datasets.import_archive(first, "gaits")
    assert copy.ref("main").commit is None
    assert away.datasets.import_archive(first, "gaits").branch == "main"
    sent: list[int] = []
    send = receiving._Import._send

    def count(sending: Any, contents: list[str]) -> None:
        sent.append(len(contents))
        send(sending, contents)

    monkeypatch.setattr(receiving._Import, "_send", count)
    assert away.datasets.import_archive(second, "gaits").commit == gaits_of(project).at()
    assert sent == []  # the newest version only drops a clip


def test_an_archive_of_later_versions_is_small_and_imported_where_the_earlier_ones_are(
    run: CommandLine, project: ProjectHandle, away: ProjectHandle
) -> None:
    whole, later = run.folder / "whole.tar", run.folder / "later.tar"
    gaits_of(project).archive(whole, "v1")
    walk = clip(project, "walk")
    walk.put_info(walk.info().model_copy(update={"comment": "later"}))
    head = gaits_of(project).commit("Describe the walk again")
    run("archive", "create", "lab/gaits", later, "--since", "v1")
    told = run("archive", "verify", later).stdout
    assert f"without   {gaits_of(project).at('v1').digest}" in told
    assert later.stat().st_size < 20_000
    assert "the archive builds on the version" in run("archive", "import", later, "away/gaits", status=1).stderr
    run("archive", "import", whole, "away/gaits")
    for _ in range(2):
        run("archive", "import", later, "away/gaits")
    assert gaits_of(away).at() == head
    gaits_of(away).check_out()
    assert clip(away, "walk").info().comment == "later"
    assert np.array_equal(clip(away, "walk").motion().poses, clip(project, "walk").motion().poses)
    assert "nothing to archive" in run("archive", "create", "lab/gaits@v1", later, "--since", "main", status=1).stderr


def test_a_branch_with_other_versions_does_not_move_and_is_merged(
    run: CommandLine, project: ProjectHandle, away: ProjectHandle
) -> None:
    file = run.folder / "gaits.tar"
    gaits_of(project).archive(file, "main~1")
    run("archive", "import", file, "away/gaits")
    copy = gaits_of(away)
    copy.check_out()
    turn = clip(away, "turn")
    turn.put_info(turn.info().model_copy(update={"comment": "ours"}))
    mine = copy.commit("Describe the turn")
    gaits_of(project).archive(file)
    told = run("archive", "import", file, "away/gaits").stderr
    assert copy.at() == mine
    command = told[told.index("marey dataset merge") :]
    run(*shlex.split(command)[1:])
    copy.check_out()
    assert {one.name for one in away.clips.list()} == {"walk", "turn"}
    assert clip(away, "turn").info().comment == "ours"


def test_an_archive_is_continued_where_an_attempt_ended(
    run: CommandLine, project: ProjectHandle, monkeypatch: pytest.MonkeyPatch
) -> None:
    gaits = project.datasets.at("gaits")
    whole, again = run.folder / "whole.tar", run.folder / "again.tar"
    gaits.archive(whole)
    asked: list[Any] = []
    once = contents.request_contents

    def ask(*request: Any, **options: Any) -> Any:
        asked.append(request)
        if len(asked) == 2:
            raise ConnectionError("the server went away")
        return once(*request, **options)

    monkeypatch.setattr(contents, "request_contents", ask)
    monkeypatch.setattr(documents, "MOST_CONTENTS", 2)
    with pytest.raises(ConnectionError):
        gaits.archive(again)
    assert not again.exists()
    gaits.archive(again)
    with whole.open("rb") as one, again.open("rb") as other:
        assert Archive(one).members.keys() == Archive(other).members.keys()
    assert not list(run.folder.glob("*.part"))


def test_versions_that_differ_in_many_entries_are_listed_whole(
    run: CommandLine, project: ProjectHandle, monkeypatch: pytest.MonkeyPatch
) -> None:
    gaits = project.datasets.at("gaits")
    gaits.archive(run.folder / "one.tar")
    monkeypatch.setattr(writing, "MOST_LISTED", 1)
    gaits.archive(run.folder / "other.tar")
    assert (run.folder / "one.tar").read_bytes() == (run.folder / "other.tar").read_bytes()


def test_a_changed_archive_is_refused_with_the_member(
    run: CommandLine, project: ProjectHandle, away: ProjectHandle
) -> None:
    file = run.folder / "gaits.tar"
    project.datasets.at("gaits").archive(file)
    with tarfile.open(file) as tar:
        header = next(one for one in tar if one.name.startswith("documents/"))
    data = bytearray(file.read_bytes())
    data[header.offset_data + 2] ^= 1
    file.write_bytes(data)
    told = run("archive", "import", file, "away/gaits", status=1)
    assert header.name in told.stderr
    assert not list(away.datasets.list())
    for command in ("verify", "extract"):
        told = run("archive", command, file, status=1)
        assert told.stderr.startswith(f"{file}: ")
        assert "Traceback" not in told.stderr
    assert "not an archive" in run("archive", "verify", run.folder / "walk.bvh", status=1).stderr
    assert "does not exist" in run("archive", "verify", "none.tar", status=2).stderr
