"""Copies of versions between datasets: missing commits are found, and transferred in a temporary archive."""

from __future__ import annotations

import os
import shutil
import stat
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import NamedTuple, TypeVar

from marey_client.archives.writing import DatasetReader, short_name, write_transfer
from marey_client.errors import DifferencesRefused
from marey_client.progress import OnProgress
from marey_schemas.datasets.commits import Commit
from marey_schemas.sizes import DAY_S
from marey_versions.archive.reading import Archive

T = TypeVar("T")

MOST_DAYS_KEPT = 7
"""Number of days after which files of interrupted copies are deleted."""


class MissingCommits(NamedTuple):
    """Commits that another dataset lacks; `bases` are the newest of their ancestors that the other dataset has."""

    commits: tuple[Commit, ...]
    """The newest commit and its ancestors; the newest is the first."""
    bases: tuple[str, ...]


def find_missing(source: DatasetReader, head: Commit, has: Callable[[str], bool]) -> MissingCommits:
    """Return the commits that another dataset lacks, among `head` and its ancestors.

    `has` returns whether the other dataset has the commit with the given digest. A dataset that has a commit also has
    the commit's ancestors, so `has` is not called for these ancestors.
    """
    if has(head.digest):
        return MissingCommits((), (head.digest,))
    missing = {head.digest: head}
    bases: dict[str, None] = {}
    waiting = list(head.parents)
    while waiting:
        start = waiting.pop()
        if start in missing or start in bases:
            continue
        if has(start):  # asked before the log is read: most copies have one new commit
            bases[start] = None
            continue
        for commit in source.log(start):
            if commit.digest in missing:
                break
            if has(commit.digest):
                bases[commit.digest] = None
                break
            missing[commit.digest] = commit
            waiting += commit.parents[1:]
    return MissingCommits(tuple(missing.values()), tuple(bases))


def copy_missing(
    source: DatasetReader, missing: MissingCommits, receive: Callable[[Archive], T], on_progress: OnProgress
) -> T:
    """Write an archive of missing commits, and return the result of `receive`, which sends it to the other dataset.

    Arrays are sent as differences from the arrays in the commits that the other dataset has. Servers of earlier
    versions refuse differences; then the archive is written and sent again with whole arrays.

    Consents are not checked here: take records are copied with their clips, so that the other server checks the
    consents. Raises `LargeCommit` if the other server would refuse one of the commits.
    """
    if missing.bases:
        with suppress(DifferencesRefused), _fetched(source, missing, on_progress, differences=True) as archive:
            return receive(archive)
    with _fetched(source, missing, on_progress, differences=False) as archive:
        return receive(archive)


@contextmanager
def _fetched(
    source: DatasetReader, missing: MissingCommits, on_progress: OnProgress, *, differences: bool
) -> Iterator[Archive]:
    """Write an archive of missing commits, and yield the opened archive.

    The archive's file is deleted if the `with` block succeeds or raises `DifferencesRefused`; after any other error,
    the file remains for the next call. If writing the file is interrupted, the next call continues writing.
    """
    name = short_name(missing.commits[0].digest, missing.bases)
    path = transfers_folder() / (f"{name}.differences.tar" if differences else f"{name}.tar")
    if not path.exists():
        write_transfer(source, missing.commits, path, on_progress, differences=differences)
    try:
        with path.open("rb") as file:
            yield Archive(file)
    except DifferencesRefused:
        path.unlink(missing_ok=True)
        raise
    path.unlink(missing_ok=True)


def transfers_folder() -> Path:
    """Return the folder for archives of datasets that are being copied, below `XDG_CACHE_HOME` or `~/.cache`.

    Files and folders in it that are older than `MOST_DAYS_KEPT` are deleted: archives, and in earlier versions folders
    of downloaded files, remain there if a copy command is killed.
    """
    folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "marey" / "transfers"
    folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    oldest = time.time() - MOST_DAYS_KEPT * DAY_S
    for path in folder.iterdir():
        with suppress(FileNotFoundError):  # another copy may delete the same files
            found = path.lstat()
            if found.st_mtime < oldest:
                delete = shutil.rmtree if stat.S_ISDIR(found.st_mode) else os.unlink
                delete(path)
    return folder
