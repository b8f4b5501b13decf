"""Folders for the files of attempts, and their removal after a worker was killed."""

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import pytest

from marey_worker import scratch
from marey_worker.scratch import PREFIX, YOUNG_S, ScratchFolder, remove_abandoned


@pytest.fixture(autouse=True)
def temporary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder for temporary files of this test."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    return tmp_path


def aged(folder: Path) -> Path:
    """Let a folder look as old as one that a killed worker has left."""
    long_ago = time.time() - YOUNG_S - 1.0
    os.utime(folder, (long_ago, long_ago), follow_symlinks=False)
    return folder


def left(folder: Path) -> Path:
    """Return a folder with files, as if a worker was killed a while ago."""
    (folder / "deep").mkdir(parents=True)
    (folder / "deep" / "motion.npz").write_bytes(bytes(100))
    return aged(folder)


def test_the_folder_of_an_attempt_is_kept_until_the_attempt_ends() -> None:
    folder = ScratchFolder()
    (folder.path / "log").write_bytes(b"a line")
    aged(folder.path)
    remove_abandoned()
    assert (folder.path / "log").is_file()
    folder.remove()
    assert not folder.path.exists()


def test_the_folder_of_a_killed_worker_is_removed_by_the_next_one(temporary: Path) -> None:
    program = (
        f"import tempfile, time; tempfile.tempdir = {str(temporary)!r}; "
        "from marey_worker.scratch import ScratchFolder; made = ScratchFolder(); print(made.path, flush=True); "
        "time.sleep(60)"
    )
    with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True) as worker:
        assert worker.stdout is not None
        try:
            folder = aged(Path(worker.stdout.readline().strip()))
            assert folder.parent == temporary
            remove_abandoned()
            assert folder.is_dir()
        finally:
            worker.kill()
    remove_abandoned()
    assert not folder.exists()


def test_only_old_folders_with_the_name_of_scratch_folders_are_removed(temporary: Path) -> None:
    gone, other = left(temporary / f"{PREFIX}a"), left(temporary / "other-a")
    young = temporary / f"{PREFIX}b"
    young.mkdir()
    file = temporary / f"{PREFIX}c"
    file.write_bytes(b"")
    aged(file)
    remove_abandoned()
    assert not gone.exists()
    assert all(one.exists() for one in (other, young, file))


def test_links_are_not_followed(temporary: Path, caplog: pytest.LogCaptureFixture) -> None:
    elsewhere, link = left(temporary / "elsewhere"), temporary / f"{PREFIX}link"
    link.symlink_to(elsewhere)
    aged(link)
    remove_abandoned()
    assert (elsewhere / "deep" / "motion.npz").is_file()
    assert link.is_symlink()
    assert not caplog.records, "a link is nothing that a worker has left"


def test_folders_of_other_users_are_left(temporary: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = left(temporary / f"{PREFIX}a")
    monkeypatch.setattr(os, "geteuid", lambda: os.getuid() + 1)
    remove_abandoned()
    assert (folder / "deep" / "motion.npz").is_file()


def test_a_folder_that_cannot_be_removed_is_reported_and_the_others_are_removed(
    temporary: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    stuck, gone = left(temporary / f"{PREFIX}a"), left(temporary / f"{PREFIX}b")
    remove = scratch.remove_folder

    def refuse(folder: Path) -> None:
        if folder == stuck:
            raise PermissionError(13, "Permission denied", str(folder))
        remove(folder)

    monkeypatch.setattr(scratch, "remove_folder", refuse)
    remove_abandoned()
    assert stuck.is_dir()
    assert not gone.exists()
    assert f"{stuck} was left by a worker that was killed, and cannot be removed" in caplog.text
