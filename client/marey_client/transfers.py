"""Copies of versions from one dataset to another: which commits are missing, and the archive in which they travel."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

from marey_client.archives import DatasetReader, OnProgress, short_name, write_archive
from marey_schemas.datasets.commits import Commit
from marey_versions.archive.reading import Archive

MOST_DAYS_KEPT = 7
"""Age in days from which on files of interrupted copies are deleted."""


class MissingCommits(NamedTuple):
    """Commits that another dataset lacks, and the newest commits before them, which it has."""

    commits: tuple[str, ...]
    bases: tuple[str, ...]


def find_missing(source: DatasetReader, head: Commit, has: Callable[[str], bool]) -> MissingCommits:
    """Return the commits up to `head` that another dataset lacks; `has` returns whether it has a commit.

    The commits before one that it has are not asked for: it has them, too.
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
    """Write an archive of the versions up to `head` and after `bases`, open it, and delete it after the `with` block.

    If writing is interrupted, the next attempt continues it. If the block ends with an error, the archive stays.
    """
    path = transfers_folder() / f"{short_name([head.digest, *bases])}.tar"
    if not path.exists():
        write_archive(source, head.digest, path, on_progress, since=bases)
    with path.open("rb") as file:
        yield Archive(file)
    path.unlink(missing_ok=True)


def transfers_folder() -> Path:
    """Return the folder of copies in progress, below `XDG_CACHE_HOME` or `~/.cache`. Old files in it are deleted."""
    folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "marey" / "transfers"
    folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    oldest = time.time() - MOST_DAYS_KEPT * 86_400
    for path in folder.iterdir():
        if path.stat().st_mtime < oldest:
            path.unlink(missing_ok=True)
    return folder
