"""Files of archives and of copies between datasets, without a server."""

from __future__ import annotations

import fcntl
import json
import os
import time
from collections.abc import Iterator, Sequence
from datetime import UTC, datetime
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import httpx
import pytest

from marey_client.archives import receiving
from marey_client.archives.receiving import ReceivingDataset, send_versions
from marey_client.archives.transfers import MOST_DAYS_KEPT, MissingCommits, copy_missing, transfers_folder
from marey_client.archives.writing import short_name, write_archive
from marey_client.errors import (
    ArchiveInUse,
    BadRequest,
    Conflict,
    Forbidden,
    Invalid,
    LargeCommit,
    RequestFailed,
    Unavailable,
)
from marey_client.handles.datasets import _fast_forward
from marey_client.handles.versions import DatasetHandle
from marey_client.progress import ignore_progress
from marey_schemas.datasets.commits import TIME_OF_COMMIT, Commit, Entry
from marey_schemas.datasets.differences import DatasetDifference
from marey_schemas.kinds import Kind
from marey_schemas.problems import Problem
from marey_versions.archive.checking import check_archive
from marey_versions.archive.reading import Archive
from marey_versions.records import CommitRecord, key_of
from marey_versions.tree.building import build
from marey_versions.tree.chunks import ChunksInMemory

MOST_CHARACTERS = 255
"""Greatest length of a file name in usual file systems."""


class ListedDataset:
    """Dataset without branches: each version is given as the list of its entries; the last version is the newest."""

    transport = cast(Any, None)
    project_url = "/projects/lab"
    name = "gaits"
    refusal = "large-difference"
    """Code of the error with which the dataset refuses to compare versions."""

    def __init__(self, *versions: Sequence[Entry]) -> None:
        self.listed: dict[str, Sequence[Entry]] = {}
        self.commits: list[Commit] = []
        at = datetime(2026, 1, 1, tzinfo=UTC)
        for entries in versions:
            pairs = {key_of(one.path, one.kind): {"parts": one.parts, "tags": list(one.tags)} for one in entries}
            tree = build(ChunksInMemory(), sorted(pairs.items()))
            parents = tuple(one.digest for one in self.commits[-1:])
            digest = CommitRecord(tree, parents, "ada", "", at.strftime(TIME_OF_COMMIT)).digest
            count = len(entries)
            self.commits.append(
                Commit(digest=digest, tree=tree, parents=parents, author="ada", message="", at=at, entries=count)
            )
            self.listed[digest] = entries

    def at(self, version: str) -> Commit:
        return next(one for one in self.commits if one.digest == version)

    def log(self, version: str) -> Iterator[Commit]:
        return reversed(self.commits[: self.commits.index(self.at(version)) + 1])

    def entries(self, version: str) -> Iterator[Entry]:
        return iter(self.listed[version])

    def difference(self, before: str, after: str, *, limit: int) -> DatasetDifference:
        raise BadRequest(Problem(type="", title="", status=400, detail="", instance="", code=self.refusal))


def digest(number: int) -> str:
    return f"sha256:{number:064x}"


def test_the_name_of_an_archive_is_short_although_it_leaves_out_many_versions() -> None:
    bases = [digest(number) for number in range(1000)]
    name = short_name(digest(2000), bases)
    assert len(f"{name}.tar.{name}.part") < MOST_CHARACTERS
    assert short_name(digest(2000), reversed(bases)) == name


def test_archives_with_other_versions_have_other_names() -> None:
    one, other, third = map(digest, (1, 2, 3))
    names = {short_name(one, [other]), short_name(other, [one]), short_name(one, []), short_name(one, [other, third])}
    assert len(names) == 4


@pytest.fixture
def transfers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder for archives of running copies."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return transfers_folder()


def make_old(path: Path) -> None:
    """Set the time of a file's last change to a time before which files are deleted."""
    old = time.time() - (MOST_DAYS_KEPT + 1) * 86_400
    os.utime(path, (old, old))


def test_old_files_and_folders_of_killed_copies_are_deleted(transfers: Path) -> None:
    for name in ("old", "new"):
        (transfers / f"{name}.tar.part").touch()
        (transfers / name).mkdir()
        (transfers / name / "file").touch()
    make_old(transfers / "old.tar.part")
    make_old(transfers / "old")
    assert transfers_folder() == transfers
    assert {path.name for path in transfers.iterdir()} == {"new", "new.tar.part"}


def test_a_file_that_another_copy_deletes_at_the_same_time_is_skipped(
    transfers: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (transfers / "old.tar").touch()
    make_old(transfers / "old.tar")
    gone = transfers / "gone.tar"
    monkeypatch.setattr(Path, "iterdir", lambda _folder: iter((gone, transfers / "old.tar")))
    transfers_folder()
    assert not (transfers / "old.tar").exists()


def written(dataset: ListedDataset, path: Path) -> None:
    """Write an archive of the newest version, without the earlier versions."""
    head = dataset.commits[-1]
    write_archive(dataset, head.digest, path, ignore_progress, since=head.parents, check=lambda _contents: None)


def test_beside_the_unfinished_archive_no_file_is_left_by_a_process_that_is_killed(tmp_path: Path) -> None:
    beside: list[list[str]] = []

    def check(_contents: Sequence[str]) -> None:
        beside.append([path.suffix for path in tmp_path.iterdir()])

    dataset = ListedDataset([])
    write_archive(dataset, dataset.commits[-1].digest, tmp_path / "gaits.tar", ignore_progress, check=check)
    assert beside == [[".part"]]


def test_a_finished_archive_gets_its_name_before_another_process_may_write_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    dataset = ListedDataset([])
    replace = Path.replace

    def replace_while_another_process_writes(part: Path, path: Path) -> Path:
        with pytest.raises(ArchiveInUse):
            written(dataset, path)
        return replace(part, path)

    monkeypatch.setattr(Path, "replace", replace_while_another_process_writes)
    written(dataset, tmp_path / "gaits.tar")
    with (tmp_path / "gaits.tar").open("rb") as file:
        check_archive(Archive(file))


def test_a_file_that_was_finished_just_before_it_was_locked_is_not_changed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    finished = tmp_path / "gaits.tar"
    lock = fcntl.flock

    def lock_after_another_process_has_finished(file: Any, how: int) -> None:
        if not finished.exists():
            (part,) = tmp_path.glob("*.part")
            part.write_bytes(b"finished")
            os.link(part, tmp_path / "kept.tar")
            part.rename(finished)
        lock(file, how)

    monkeypatch.setattr(fcntl, "flock", lock_after_another_process_has_finished)
    written(ListedDataset([]), finished)
    assert (tmp_path / "kept.tar").read_bytes() == b"finished"
    with finished.open("rb") as file:
        check_archive(Archive(file))


def entry(path: str) -> Entry:
    parts = {"motion": digest(sum(path.encode()))}
    return Entry(path=path, kind=Kind.CLIP, parts=parts, tags=(), item=None, revision=None)


def test_versions_that_the_server_refuses_to_compare_are_listed_whole(tmp_path: Path) -> None:
    dataset = ListedDataset([entry("a"), entry("b"), entry("c")], [entry("b")])
    written(dataset, tmp_path / "gaits.tar")
    with (tmp_path / "gaits.tar").open("rb") as file:
        changes = Archive(file).changes(dataset.commits[-1].digest)
    assert {key: change.value for key, change in changes.items()} == {key_of(path, "clip"): None for path in "ac"}


def test_another_refusal_to_compare_versions_is_reported(tmp_path: Path) -> None:
    dataset = ListedDataset([entry("a")], [])
    dataset.refusal = "bad-version"
    with pytest.raises(BadRequest):
        written(dataset, tmp_path / "gaits.tar")


@pytest.fixture
def one_change_is_received(monkeypatch: pytest.MonkeyPatch) -> None:
    """Limit the changes of a commit that a server receives to one."""
    monkeypatch.setattr(receiving, "MOST_RECEIVED_CHANGES", 1)


@pytest.mark.usefixtures("one_change_is_received")
def test_a_commit_that_no_server_receives_is_archived_but_not_imported(tmp_path: Path) -> None:
    dataset = ListedDataset([entry("a"), entry("b")], [])
    base, large = dataset.commits
    written(dataset, tmp_path / "gaits.tar")
    receiver = cast(ReceivingDataset, SimpleNamespace())
    with (
        (tmp_path / "gaits.tar").open("rb") as file,
        pytest.raises(LargeCommit, match=f"{large.digest} changes 2 .* 1"),
    ):
        send_versions(receiver, Archive(file), ignore_progress, lambda commit: commit == base.digest)


@pytest.mark.parametrize("branch", [None, "main"])
@pytest.mark.parametrize("known", [1, 2])
def test_each_commit_is_sent_once_and_the_newest_with_the_branch_that_begins_with_it(
    tmp_path: Path, known: int, branch: str | None
) -> None:
    dataset = ListedDataset([entry("a"), entry("b")], [entry("a")])
    written(dataset, tmp_path / "gaits.tar")
    sent: list[Any] = []

    def send(method: str, url: str, *, content: bytes) -> httpx.Response:
        sent.append(json.loads(content))
        return httpx.Response(201, content=dataset.commits[-1].model_dump_json())

    has = [one.digest for one in dataset.commits[:known]].__contains__
    receiver = SimpleNamespace(
        at=dataset.at,
        url="/gaits",
        transport=SimpleNamespace(send_compressed=send),
    )
    with (tmp_path / "gaits.tar").open("rb") as file:
        send_versions(cast(ReceivingDataset, receiver), Archive(file), ignore_progress, has, begins=branch)
    expected = [] if known == 2 and branch is None else [branch]
    assert [one.get("begins") for one in sent] == expected
    assert all(len(one["changes"]) == 1 for one in sent)


@pytest.mark.usefixtures("one_change_is_received", "transfers")
def test_a_copy_with_a_commit_that_no_server_receives_ends_before_documents_are_read() -> None:
    # The dataset has no transport, so a request for documents would be another error.
    dataset = ListedDataset([entry("a"), entry("b")])
    missing = MissingCommits(tuple(dataset.commits), ())
    with pytest.raises(LargeCommit):
        copy_missing(dataset, missing, lambda _archive: None, ignore_progress)


@pytest.mark.parametrize(
    ("failure", "hidden"), [(Conflict, True), (Invalid, True), (Forbidden, False), (Unavailable, False)]
)
def test_only_a_merge_that_a_person_must_decide_leaves_the_branch_without_an_error(
    failure: type[RequestFailed], hidden: bool
) -> None:
    def merge(*_versions: str, **_options: Any) -> None:
        raise failure(Problem(type="", title="", status=failure.status, detail="", instance="", code=""))

    dataset = cast(DatasetHandle, SimpleNamespace(merge=merge))
    if hidden:
        assert not _fast_forward(dataset, "main", "sha256:new")
        return
    with pytest.raises(failure):
        _fast_forward(dataset, "main", "sha256:new")
