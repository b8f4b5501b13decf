"""Copies of versions between datasets: missing commits are found, and transferred in a temporary archive."""

from __future__ import annotations

import os
import shutil
import stat
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import NamedTuple

from marey_client.archives.writing import DatasetReader, short_name, write_archive
from marey_client.progress import OnProgress
from marey_schemas.datasets.commits import Commit
from marey_versions.archive.reading import Archive

MOST_DAYS_KEPT = 7
"""Number of days after which files of interrupted copies are deleted."""


class MissingCommits(NamedTuple):
    """Commits that another dataset lacks; `bases` are the newest of their ancestors that the other dataset has."""

    commits: tuple[str, ...]
    bases: tuple[str, ...]


def find_missing(source: DatasetReader, head: Commit, has: Callable[[str], bool]) -> MissingCommits:
    """Return which commits, among `head` and its ancestors, another dataset lacks.

    `has` returns whether the other dataset has the commit with a digest. A dataset that has a commit also has the
    ancestors of the commit, so `has` is not called for these.
    """
    missing: dict[str, None] = {}
    bases: dict[str, None] = {}
    waiting = [head.digest]
    while waiting:
        for commit in source.log(waiting.pop()):
            if commit.digest in missing:
                break
            if has(commit.digest):
                bases[commit.digest] = None
                break
            missing[commit.digest] = None
            waiting += commit.parents[1:]
    return MissingCommits(tuple(missing), tuple(bases))


@contextmanager
def fetched_versions(
    source: DatasetReader, head: Commit, bases: Sequence[str], on_progress: OnProgress
) -> Iterator[Archive]:
    """Write an archive of `head` and its ancestors, without `bases` and their ancestors; yield the opened archive.

    The archive's file is deleted after the `with` block, but kept if the block ends with an error. If the program is
    interrupted while it writes the file, the next call continues writing. Consents are not checked here: take records
    are copied with their clips, so that the other server checks the consents. Raises `LargeCommit` if the other server
    would refuse one of the commits.
    """
    path = transfers_folder() / f"{short_name(head.digest, bases)}.tar"
    if not path.exists():
        write_archive(source, head.digest, path, on_progress, since=bases, check=_accept, to_send=True)
    with path.open("rb") as file:
        yield Archive(file)
    path.unlink(missing_ok=True)


def _accept(_contents: Sequence[str]) -> None:
    """Accept all revisions, without a check of consents."""


def transfers_folder() -> Path:
    """Return the folder for archives of datasets that are being copied, below `XDG_CACHE_HOME` or `~/.cache`.

    Old content of the folder is deleted: a copy command that is killed leaves its archive. In earlier versions, it also
    left the folder of its downloaded files.
    """
    folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "marey" / "transfers"
    folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    oldest = time.time() - MOST_DAYS_KEPT * 86_400
    for path in folder.iterdir():
        with suppress(FileNotFoundError):  # another copy may delete the same files
            found = path.lstat()
            if found.st_mtime < oldest:
                delete = shutil.rmtree if stat.S_ISDIR(found.st_mode) else os.unlink
                delete(path)
    return folder
