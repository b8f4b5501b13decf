"""Backing that stores the bytes of blobs as objects; see docs/decisions/0051-object-storage.md.

The row of a blob names the object with its bytes. If it names none, the bytes are in the database or in the data
folder: uploads arrive there, and blobs were there before the setting `blobs` was changed.
"""

from __future__ import annotations

import errno
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from sqlalchemy import Connection, bindparam, select, update

from marey_server.store.blob_backings import CHUNK_BYTES, BlobBacking
from marey_server.store.object_storage.awaiting import (
    Carried,
    LookAgain,
    ObjectsToRead,
    ObjectsToStore,
    ProbeAwaited,
    WantedBytes,
)
from marey_server.store.object_storage.client import ObjectStorage, StoredObject
from marey_server.store.tables import blob

COMMIT_WITHIN_US = 12 * 3600 * 1_000_000
"""Time in microseconds from the beginning of a transfer, in which the row of the blob must name the object.

Objects that no row names are deleted a day after their transfer began, or later. So no object is deleted that a row
could still name.
"""

_PLACES = select(blob.c.digest, blob.c.object_id, blob.c.size_bytes).where(
    blob.c.digest.in_(bindparam("digests", expanding=True))
)


@dataclass(frozen=True)
class ObjectBlobs:
    """Backing whose blobs are objects in `storage`; blobs whose rows name no object are in `local`.

    If `stores_objects` is false, new blobs are stored in `local`, and objects are only read.
    """

    storage: ObjectStorage
    local: BlobBacking
    stores_objects: bool = True

    def within(self, carried: Carried, now_us: Callable[[], int]) -> BlobBacking:
        """Return the backing for one transaction, which can use the bytes in `carried`.

        `now_us` returns the time of the transaction.
        """
        return _InTransaction(self, carried, now_us)

    def new_copy(self) -> Path | None:
        """Return a new file for the copy of an upload; None if `local` needs no copy, or if new blobs become objects.

        If new blobs become objects, uploads stay in the database until they are moved.
        """
        return None if self.stores_objects else self.local.new_copy()

    def stray_digests(self, *, older_than_s: float) -> Iterator[str]:
        """Yield the digests of local files that may have no row; objects without a row are found by `sweep_objects`."""
        return self.local.stray_digests(older_than_s=older_than_s)


@dataclass(frozen=True)
class _InTransaction:
    """Backing for one transaction: uses bytes that were moved before, and raises `BytesAwaited` for other bytes."""

    backing: ObjectBlobs
    carried: Carried
    now_us: Callable[[], int]

    def write(self, connection: Connection, contents: Mapping[str, Iterable[bytes]]) -> None:
        """Record in the rows of new blobs which objects contain their bytes.

        If new blobs do not become objects, store the bytes in `local` instead. The rows must exist. Raises
        `ObjectsToStore` if the objects are not stored yet, or were stored too long ago.
        """
        if not self.backing.stores_objects:
            self.backing.local.write(connection, contents)
            return
        stored, now_us = self.carried.stored, self.now_us()
        late = {one for one in contents if one not in stored or not may_be_named(stored[one], now_us)}
        if late:
            raise ObjectsToStore(self.backing.storage, {one: contents[one] for one in late}, now_us)
        for digest in contents:
            name_object(connection, stored[digest])

    def read(self, connection: Connection, digest: str, start: int, stop: int) -> Iterator[bytes]:
        """Yield the bytes `start` to `stop - 1` of a blob, fewer if some are missing.

        Raises `ObjectsToRead` if the bytes are in an object and were not read yet. Raises `LookAgain` if local bytes
        are missing, unless the transaction was already repeated because of `LookAgain`.
        """
        places = self._places(connection, {digest: (start, stop)})
        wanted, one = places[0] if places else (None, None)
        if wanted is None or one is None:
            yield from self._read_local(connection, digest, start, stop)
        elif one not in self.carried.absent:
            if wanted not in self.carried.pieces:
                raise ObjectsToRead(self.backing.storage, [(wanted, one)])
            data = self.carried.pieces[wanted]
            for at in range(0, len(data), CHUNK_BYTES):
                yield data if len(data) <= CHUNK_BYTES else data[at : at + CHUNK_BYTES]

    def _read_local(self, connection: Connection, digest: str, start: int, stop: int) -> Iterator[bytes]:
        for piece in self.backing.local.read(connection, digest, start, stop):
            start += len(piece)
            yield piece
        if start < stop and not self.carried.looked_again:
            raise LookAgain

    def expect(self, connection: Connection, digests: Iterable[str]) -> None:
        """Prepare to read all bytes of several blobs: raise `ObjectsToRead` once for all that were not read yet."""
        places = self._places(connection, dict.fromkeys(digests))
        lacking = [
            (wanted, one)
            for wanted, one in places
            if one is not None and wanted not in self.carried.pieces and one not in self.carried.absent
        ]
        if lacking:
            raise ObjectsToRead(self.backing.storage, lacking)

    def _places(
        self, connection: Connection, ranges: Mapping[str, tuple[int, int] | None]
    ) -> list[tuple[WantedBytes, StoredObject | None]]:
        """Return the wanted ranges of blobs, each with the object that contains it, or None if the bytes are local.

        `ranges` maps digests to start and stop; None stands for the whole blob. Blobs without a row are left out.
        """
        places = []
        for row in connection.execute(_PLACES, {"digests": list(ranges)}).all() if ranges else ():
            start, stop = ranges[row.digest] or (0, row.size_bytes)
            wanted = WantedBytes(row.digest, start, stop, start == 0 and stop >= row.size_bytes)
            places.append((wanted, StoredObject(row.digest, row.object_id) if row.object_id else None))
        return places

    def release(self, connection: Connection, digest: str) -> None:
        """Free the local bytes of a blob; if an object has the bytes, `sweep_objects` deletes it later."""
        self.backing.local.release(connection, digest)

    def new_copy(self) -> Path | None:
        """Return a new file for the copy of an upload, or None if no copy is needed (`ObjectBlobs.new_copy`)."""
        return self.backing.new_copy()

    def adopt(self, copy: Path, digest: str) -> None:
        """Turn the complete copy of an upload into the local bytes of a blob."""
        self.backing.local.adopt(copy, digest)

    def stray_digests(self, *, older_than_s: float) -> Iterator[str]:
        """Yield the digests of local files that may have no row; objects without a row are found by `sweep_objects`."""
        return self.backing.stray_digests(older_than_s=older_than_s)

    def remove_stray(self, digest: str) -> None:
        """Remove the local bytes of a blob that has no row."""
        self.backing.local.remove_stray(digest)

    def check_writable(self) -> None:
        """Raise `OSError` if bytes cannot be stored. Raises `ProbeAwaited` if the bucket was not checked yet."""
        self.backing.local.check_writable()
        if self.backing.stores_objects and not self.carried.probed:
            raise ProbeAwaited(self.backing.storage)
        if self.carried.fault is not None:
            raise OSError(errno.EIO, self.carried.fault)


def may_be_named(one: StoredObject, now_us: int) -> bool:
    """Return whether a transaction at `now_us` may name an object: its transfer began within `COMMIT_WITHIN_US`."""
    return now_us - one.began_us <= COMMIT_WITHIN_US


def name_object(connection: Connection, one: StoredObject) -> None:
    """Record in the row of a blob that an object contains its bytes; `may_be_named` must be true."""
    connection.execute(update(blob).where(blob.c.digest == one.digest).values(object_id=one.id))
