"""Files of archives and of copies between datasets, without a server."""

from __future__ import annotations

import os
import time
from pathlib import Path

import pytest

from marey_client.archives.transfers import MOST_DAYS_KEPT, transfers_folder
from marey_client.archives.writing import short_name

MOST_CHARACTERS = 255
"""Greatest length of a file name in usual file systems."""


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
    """Set the time of a file's last change to a time after which the file is no longer kept."""
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
