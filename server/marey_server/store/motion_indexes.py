"""Indexes of motions: finds the index of a project and the clips changed since its update, and copies its files.

Searches map the files of an index into memory. So each server keeps copies of them in its data folder, whatever the
backing of its blobs. A copy is named by its digest and never changes.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Collection, Iterable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from sqlalchemy import func, or_, select

from marey_schemas.documents.motion_indexes import INDEX_VERSION, MotionIndexDocument
from marey_schemas.documents.reports import StoredFile
from marey_schemas.kinds import Kind
from marey_schemas.sizes import GIB
from marey_server.errors import ConflictProblem, NotFoundProblem, TooLargeProblem
from marey_server.store import items, projects
from marey_server.store.jobs import reach
from marey_server.store.tables import blob, collection, item, job, revision
from marey_server.store.transaction import Transaction, in_lists

MOST_CHANGES = 20_000
"""Greatest number of clips that may have changed since an index was updated; a search checks each of them."""
MOST_COPIED_BYTES = 8 * GIB
"""Greatest total size, in bytes, of the copies of index files on one server. A larger index cannot be searched."""
_DIGEST_DIGITS = 64


class FoundIndex(NamedTuple):
    """Index of motions, and the clips that were changed, created or deleted since the request to build the index.

    `heads` maps the ids of these clips to the numbers of their newest revisions, or to 0 for a deleted clip.
    """

    item: str
    revision: int
    document: MotionIndexDocument
    heads: dict[str, int]


@dataclass(frozen=True, slots=True)
class FoundClip:
    """Clip that a search has found: its path, and the number of its newest revision."""

    path: str
    head: int


def find_index(tx: Transaction, project: str, index: str | None) -> FoundIndex:
    """Return the index of motions with the id `index`; if it is None, the index that was updated last.

    Raises `NotFoundProblem` if there is no such index. Raises `ConflictProblem` if the index must be updated: an
    earlier version of Marey made it, or more than `MOST_CHANGES` clips have changed since.
    """
    project_row = projects.require(tx, project)
    wanted = (item.c.project_id == project_row.id, item.c.kind == Kind.INDEX.value, item.c.deleted_us.is_(None))
    statement = (
        select(item.c.id, item.c.head, revision.c.created_us, job.c.created_us.label("submitted_us"))
        .join(revision, (revision.c.item_id == item.c.id) & (revision.c.number == item.c.head))
        .outerjoin(job, job.c.id == revision.c.job_id)
        .where(*wanted, *([] if index is None else [item.c.id == index]))
        .order_by(item.c.updated_us.desc(), item.c.id)
        .limit(1)
    )
    row = tx.execute(statement).one_or_none()
    if row is None or reach.unreachable_items(tx, [row.id]):
        raise NotFoundProblem(
            f"This project has no index of motions; `marey index {project}` builds one."
            if index is None
            else f"There is no index {index!r}; without an id, the index that was updated last is searched.",
            code="no-index",
            unnamed="There is no such index of motions.",
        )
    found = items.read_part(tx, project, Kind.INDEX, row.id, "index", revision=row.head)
    document = MotionIndexDocument.model_validate(found.tree)
    if document.version != INDEX_VERSION:
        raise ConflictProblem(
            "The index was made by an earlier version of Marey; update it with `marey index`.", code="index-outdated"
        )
    since_us = row.created_us if row.submitted_us is None else row.submitted_us
    return FoundIndex(row.id, row.head, document, _changed_since(tx, project_row.id, since_us))


def _changed_since(tx: Transaction, project_id: str, since_us: int) -> dict[str, int]:
    """Return, by id, the newest revision number of each clip that changed at or after a time; 0 for deleted clips.

    Raises `ConflictProblem` if there are more than `MOST_CHANGES` such clips.
    """
    own = (item.c.project_id == project_id, item.c.kind == Kind.CLIP.value)
    changed = or_(item.c.updated_us >= since_us, item.c.deleted_us >= since_us)
    statement = select(item.c.id, item.c.head, item.c.deleted_us).where(*own, changed).limit(MOST_CHANGES + 1)
    rows = tx.execute(statement).all()
    if len(rows) > MOST_CHANGES:
        raise ConflictProblem(
            f"More than {MOST_CHANGES:,} clips have changed since the index was updated; update it with `marey index`.",
            code="index-outdated",
        )
    return {row.id: row.head if row.deleted_us is None else 0 for row in rows}


def require_all_clips(tx: Transaction, project: str, found: FoundIndex) -> None:
    """Raise `ConflictProblem` if the project has more clips than the index contains.

    This is so if the index was built for some folders only, or if clips were created since it was built.
    """
    project_row = projects.require(tx, project)
    existing = (item.c.project_id == project_row.id, item.c.kind == Kind.CLIP.value, item.c.deleted_us.is_(None))
    clips = tx.execute(select(func.count()).select_from(item).where(*existing)).scalar_one()
    deleted = sum(head == 0 for head in found.heads.values())
    indexed = found.document.clips + found.document.left_out - deleted
    if clips > indexed:
        raise ConflictProblem(
            f"The newest index of motions has {max(indexed, 0):,} of the {clips:,} clips of the project, so conditions "
            f"on motion cannot be decided for the others; `marey index {project}` indexes all of them.",
            code="index-outdated",
        )


def name_clips(tx: Transaction, project: str, ids: Collection[str]) -> dict[str, FoundClip]:
    """Return the paths and newest revisions of clips, by id.

    Clips that do not exist, or that the caller may not read, are left out.
    """
    project_row = projects.require(tx, project)
    refused = reach.unreachable_items(tx, ids)
    found: dict[str, FoundClip] = {}
    for some in in_lists(sorted(set(ids) - refused)):
        statement = (
            select(item.c.id, item.c.head, item.c.name, collection.c.path)
            .join(collection, collection.c.id == item.c.collection_id)
            .where(item.c.project_id == project_row.id, item.c.kind == Kind.CLIP.value, item.c.id.in_(some))
            .where(item.c.deleted_us.is_(None))
        )
        for row in tx.execute(statement):
            found[row.id] = FoundClip(f"{row.path}/{row.name}".lstrip("/"), row.head)
    return found


class IndexFiles:
    """Folder of this server with copies of the files of indexes, from which searches read."""

    def __init__(self, folder: Path, *, most_bytes: int = MOST_COPIED_BYTES) -> None:
        self._folder = folder
        self._most_bytes = most_bytes

    def path(self, digest: str) -> Path:
        """Return the path of the copy of a blob, whether or not it exists."""
        return self._folder / digest.removeprefix("sha256:")

    def missing(self, document: MotionIndexDocument) -> list[StoredFile]:
        """Return the files of an index that have no copy yet, and free space for them by removing old copies.

        Raises `TooLargeProblem` if the index is too large to be searched.
        """
        files = [file for shard in document.shards for file in (shard.clips, shard.poses)]
        needed_bytes = sum(file.size_bytes for file in files)
        if needed_bytes > self._most_bytes:
            raise TooLargeProblem(
                f"The index has {needed_bytes:,} bytes; indexes of up to {self._most_bytes:,} bytes can be searched. "
                "Index fewer folders of the project.",
                code="index-too-large",
            )
        self._folder.mkdir(mode=0o700, exist_ok=True)
        missing = []
        for file in files:
            try:
                os.utime(self.path(file.blob))
            except FileNotFoundError:
                missing.append(file)
        if missing:
            self._make_room(self._most_bytes - sum(file.size_bytes for file in missing), {file.blob for file in files})
        return missing

    def copy(self, tx: Transaction, stored: StoredFile) -> None:
        """Copy a file of an index that the caller may read; a copy appears only when it is complete.

        Raises `NotFoundProblem` if bytes are missing, or if the file does not have the size that the index states. An
        index written by hand may state a wrong size, but `missing` has made room only for the stated size.
        """
        digest = stored.blob
        size = tx.execute(select(blob.c.size_bytes).where(blob.c.digest == digest)).scalar_one()
        if size != stored.size_bytes:
            raise NotFoundProblem(
                f"A file of the index has {size:,} bytes instead of {stored.size_bytes:,}; build the index again.",
                code="no-index",
            )
        handle, name = tempfile.mkstemp(dir=self._folder)
        try:
            with os.fdopen(handle, "wb") as file:
                written = sum(file.write(chunk) for chunk in tx.blobs.read(tx.connection, digest, 0, size))
            if written != size:
                raise NotFoundProblem("Files of the index are missing; build the index again.", code="no-index")
            os.replace(name, self.path(digest))
        except BaseException:
            with suppress(FileNotFoundError):
                os.unlink(name)
            raise

    def remove_unstored(self, tx: Transaction) -> int:
        """Remove the copies of files that the server no longer stores, such as those of a purged index.

        Returns the number of removed copies.
        """
        removed = 0
        for some in in_lists(f"sha256:{path.name}" for path in self._copies()):
            stored = set(tx.execute(select(blob.c.digest).where(blob.c.digest.in_(some))).scalars())
            for digest in set(some) - stored:
                self.path(digest).unlink(missing_ok=True)
                removed += 1
        return removed

    def _copies(self) -> list[Path]:
        """Return the paths of the complete copies, whose names are digests; a copy in progress has another name."""
        if not self._folder.exists():
            return []
        return [path for path in self._folder.iterdir() if len(path.name) == _DIGEST_DIGITS]

    def _make_room(self, most_bytes: int, kept: Collection[str]) -> None:
        """Remove copies that are not in `kept`, the longest unused first, until all files have at most `most_bytes`."""
        copies = sorted(self._others({self.path(digest).name for digest in kept}), key=lambda one: one[1])
        held_bytes = sum(path.stat().st_size for path in self._folder.iterdir())
        for path, _used, size_bytes in copies:
            if held_bytes <= most_bytes:
                return
            path.unlink(missing_ok=True)
            held_bytes -= size_bytes

    def _others(self, kept: Collection[str]) -> Iterable[tuple[Path, float, Any]]:
        for path in self._folder.iterdir():
            if path.name not in kept:
                found = path.stat()
                yield path, found.st_mtime, found.st_size
