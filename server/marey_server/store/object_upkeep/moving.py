"""Movement of blobs to the storage that the settings name, while servers run.

Each blob is copied without a transaction. Then one transaction changes the row of the blob, which says where its bytes
are, and frees the old bytes. If the process dies in between, the row still names the old bytes; garbage collection
deletes the copy. The next run continues with the blobs that are not moved yet.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sqlalchemy import ColumnElement, Row, and_, delete, exists, or_, select, update

from marey_schemas.encoding.digests import digest_of_hash
from marey_schemas.sizes import MIB
from marey_schemas.wording import counted
from marey_server import faults
from marey_server.access.principal import SYSTEM
from marey_server.store.blob_backings import DirectoryBlobs
from marey_server.store.database.connections import Database
from marey_server.store.object_storage.backing import ObjectBlobs, may_be_named, name_object
from marey_server.store.object_storage.client import ObjectStorageProblem, StoredObject
from marey_server.store.tables import blob, blob_chunk
from marey_server.store.transaction import Transaction

BLOBS_AT_ONCE = 100
"""Number of rows of blobs that are read at a time."""
READ_BYTES = 4 * MIB
"""Number of bytes that one transaction reads."""


@dataclass(slots=True)
class Moved:
    """Numbers of blobs and bytes that were moved, and the digests of the blobs that could not be read completely."""

    blobs: int = 0
    size_bytes: int = 0
    damaged: tuple[str, ...] = ()

    def __str__(self) -> str:
        return f"{counted(self.blobs, 'blob')} ({self.size_bytes:,} bytes)"


class CannotMove(Exception):
    """Error for a storage, given by the settings, to which blobs cannot be moved; its text says what is possible."""


def move_blobs(database: Database, moved: Moved, *, progress: Callable[[Moved], None] = lambda _moved: None) -> None:
    """Move all blobs to the storage in which the database stores new blobs.

    After each blob, the numbers in `moved` are updated, and `progress` is called with `moved`. Damaged blobs stay where
    they are. Raises `CannotMove` if new blobs are stored in the database: blobs can only be moved to object storage and
    to files.
    """
    _move_all(database, _elsewhere(database), moved, progress)


def move_uploads(database: Database, damaged: Collection[str] = ()) -> Moved:
    """Move the blobs that arrived as uploads to object storage, if new blobs are stored there; leave out `damaged`."""
    moved = Moved()
    if isinstance(database.blobs, ObjectBlobs) and database.blobs.stores_objects:
        which = and_(blob.c.upload_id.is_not(None), blob.c.digest.not_in(sorted(damaged)))
        _move_all(database, which, moved, lambda _moved: None)
    return moved


def _move_all(database: Database, which: ColumnElement[bool], moved: Moved, progress: Callable[[Moved], None]) -> None:
    behind = ""
    while page := database.read(SYSTEM, _page, which, behind):
        for row in page:
            if _move(database, row):
                moved.blobs += 1
                moved.size_bytes += row.size_bytes
            elif database.read(SYSTEM, _is_unchanged, row):
                moved.damaged += (row.digest,)
            progress(moved)
        behind = page[-1].digest


def _elsewhere(database: Database) -> ColumnElement[bool]:
    """Return the SQL condition for blobs that are not in the storage for new blobs."""
    if _target(database) is None:
        return blob.c.object_id.is_(None)
    in_rows = exists().where(blob_chunk.c.digest == blob.c.digest)
    return or_(blob.c.object_id.is_not(None), blob.c.upload_id.is_not(None), in_rows)


def _target(database: Database) -> DirectoryBlobs | None:
    """Return the folder of files in which new blobs are stored; None if new blobs are stored as objects.

    Raises `CannotMove` if new blobs are stored in the database.
    """
    backing = database.blobs
    if isinstance(backing, ObjectBlobs):
        if backing.stores_objects:
            return None
        backing = backing.local
    if not isinstance(backing, DirectoryBlobs):
        raise CannotMove(
            'Blobs can be moved to object storage (blobs = "s3") or to files (blobs = "directory"), but not into the '
            "database."
        )
    return backing


def _page(tx: Transaction, which: ColumnElement[bool], behind: str) -> list[Row[Any]]:
    rows = select(blob.c.digest, blob.c.size_bytes, blob.c.upload_id, blob.c.object_id)
    return list(tx.execute(rows.where(which, blob.c.digest > behind).order_by(blob.c.digest).limit(BLOBS_AT_ONCE)))


def _move(database: Database, row: Row[Any]) -> bool:
    """Move a blob; return False if its bytes are damaged, or if it was deleted or moved meanwhile."""
    target = _target(database)
    return _to_object(database, row) if target is None else _to_file(database, target, row)


def _to_object(database: Database, row: Row[Any]) -> bool:
    assert isinstance(database.blobs, ObjectBlobs)
    storage = database.blobs.storage
    one = StoredObject.new(row.digest, database.read(SYSTEM, lambda tx: tx.now_us))
    found: list[tuple[str, int]] = []
    storage.put(one.name, _hashed(_chunks(database, row), found))
    faults.point("move.after_copy")
    if found != [(row.digest, row.size_bytes)] or storage.size_of(one.name) != row.size_bytes:
        storage.delete([one.name])
        return False
    return database.write(SYSTEM, _name_object, row, one)


def _to_file(database: Database, target: DirectoryBlobs, row: Row[Any]) -> bool:
    copy = target.new_copy()
    found: list[tuple[str, int]] = []
    try:
        with open(copy, "wb") as file:
            for chunk in _hashed(_chunks(database, row), found):
                file.write(chunk)
            file.flush()
            os.fsync(file.fileno())
        faults.point("move.after_copy")
        return found == [(row.digest, row.size_bytes)] and database.write(SYSTEM, _name_file, row, target, copy)
    finally:
        copy.unlink(missing_ok=True)


def _hashed(chunks: Iterator[bytes], found: list[tuple[str, int]]) -> Iterator[bytes]:
    """Yield the chunks unchanged; after the last, append the digest and the size in bytes of all bytes to `found`."""
    hashed, size_bytes = hashlib.sha256(), 0
    for chunk in chunks:
        hashed.update(chunk)
        size_bytes += len(chunk)
        yield chunk
    found.append((digest_of_hash(hashed), size_bytes))


def _chunks(database: Database, row: Row[Any]) -> Iterator[bytes]:
    """Yield the bytes of a blob, read in short transactions; fewer if some of them are missing."""
    for start in range(0, row.size_bytes, READ_BYTES):
        yield from database.read(SYSTEM, _read, row.digest, start, min(start + READ_BYTES, row.size_bytes))


def _read(tx: Transaction, digest: str, start: int, stop: int) -> list[bytes]:
    return list(tx.blobs.read(tx.connection, digest, start, stop))


def _is_unchanged(tx: Transaction, row: Row[Any]) -> bool:
    return tx.execute(select(blob.c.digest).where(_same_place(row))).first() is not None


def _same_place(row: Row[Any]) -> ColumnElement[bool]:
    """Return the SQL condition that a blob exists and was not moved since `row` was read."""
    return and_(
        blob.c.digest == row.digest,
        blob.c.upload_id.is_not_distinct_from(row.upload_id),
        blob.c.object_id.is_not_distinct_from(row.object_id),
    )


def _name_object(tx: Transaction, row: Row[Any], one: StoredObject) -> bool:
    """Make an object the place of a blob's bytes; return false if the blob was deleted or moved since `row` was read.

    Raises `ObjectStorageProblem` if the transfer of the object took too long.
    """
    if not may_be_named(one, tx.now_us):
        raise ObjectStorageProblem(
            f"The object storage is too slow: the blob {row.digest} was not stored in time. Try again later."
        )
    if not _take(tx, row):
        return False
    name_object(tx.connection, one)
    faults.point("move.before_commit")
    return True


def _name_file(tx: Transaction, row: Row[Any], target: DirectoryBlobs, copy: Path) -> bool:
    """Make the file `copy` the place of a blob's bytes; return false if the blob was deleted or moved meanwhile."""
    if not _take(tx, row):
        return False
    target.adopt(copy, row.digest)
    faults.point("move.before_commit")
    return True


def _take(tx: Transaction, row: Row[Any]) -> bool:
    """Free the old bytes of a blob that was copied; return False if the blob was deleted or moved meanwhile."""
    nowhere = update(blob).where(_same_place(row)).values(upload_id=None, object_id=None)
    if not tx.execute(nowhere).rowcount:
        return False
    tx.execute(delete(blob_chunk).where(blob_chunk.c.digest == row.digest))
    return True
