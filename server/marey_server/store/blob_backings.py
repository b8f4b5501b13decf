"""Backings: places that store the bytes of blobs, such as the database or a folder of files.

The rows of the table `blob` say which blobs exist. A backing is called inside the transaction that inserts or deletes
the row of a blob. This row is the lock: no other transaction can write or remove the same bytes before this transaction
ends. Bytes that are being received are in a `Spool`. The package `object_storage` contains a further backing, for S3.
"""

from __future__ import annotations

import hashlib
import os
import tempfile
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any, Protocol, Self

from sqlalchemy import Connection, bindparam, delete, insert, select

from marey_schemas.encoding.digests import digest_of_hash
from marey_schemas.sizes import KIB
from marey_server.store.database.prepared import Prepared
from marey_server.store.tables import blob, blob_chunk, upload_chunk

CHUNK_BYTES = 2**20
BYTES_PER_STATEMENT = 4 * CHUNK_BYTES
"""Total size in bytes of the rows that are inserted with one statement."""


SPOOLED_BYTES = 64 * KIB
"""Greatest number of bytes that a spool keeps in memory."""


class Spool:
    """Temporary storage of bytes that are being received, with their running hash.

    Up to `SPOOLED_BYTES` are kept in memory; a longer body is written to an unnamed file.
    """

    def __init__(self, directory: str | None = None) -> None:
        self._file = tempfile.SpooledTemporaryFile(max_size=SPOOLED_BYTES, dir=directory)  # noqa: SIM115
        self._hash = hashlib.sha256()
        self.size_bytes = 0

    def write(self, data: bytes) -> None:
        """Append bytes, and add them to the hash."""
        self._file.write(data)
        self._hash.update(data)
        self.size_bytes += len(data)

    @property
    def digest(self) -> str:
        """Return the digest of the bytes written so far."""
        return digest_of_hash(self._hash)

    def chunks(self) -> Iterator[bytes]:
        """Yield all bytes written so far in pieces of 1 MiB."""
        self._file.seek(0)
        while chunk := self._file.read(CHUNK_BYTES):
            yield chunk

    def close(self) -> None:
        """Close the spool, which discards its bytes."""
        self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, _type: type[BaseException] | None, _error: BaseException | None, _at: TracebackType | None
    ) -> None:
        self.close()


class BlobBacking(Protocol):
    """Interface of a backing, a place that stores the bytes of blobs."""

    def write(self, connection: Connection, contents: Mapping[str, Iterable[bytes]]) -> None:
        """Store the bytes of blobs.

        `contents` maps the digest of each blob to its pieces of `CHUNK_BYTES`; the last piece may be shorter.
        """
        ...

    def read(self, connection: Connection, digest: str, start: int, stop: int) -> Iterator[bytes]:
        """Yield the bytes `start` to `stop - 1` of a blob in pieces of at most `CHUNK_BYTES`.

        If the backing has lost some of the bytes, fewer bytes are yielded.
        """
        ...

    def expect(self, connection: Connection, digests: Iterable[str]) -> None:
        """Announce that all bytes of several blobs will be read, so that the backing can read them together."""
        ...

    def release(self, connection: Connection, digest: str) -> None:
        """Free the bytes of a blob whose row this transaction deletes.

        If the transaction is rolled back, the bytes must still exist. So files and objects are only deleted later, by
        garbage collection.
        """
        ...

    def stray_digests(self, *, older_than_s: float) -> Iterator[str]:
        """Yield digests of bytes that may have no row in `blob` and were stored over `older_than_s` seconds ago."""
        ...

    def remove_stray(self, digest: str) -> None:
        """Remove the stored bytes of a digest that has no row in `blob`."""
        ...

    def new_copy(self) -> Path | None:
        """Return a new file to which an upload is copied as it arrives, or None if the backing needs no copy."""
        ...

    def adopt(self, copy: Path, digest: str) -> None:
        """Turn the complete copy of an upload into the stored bytes of a blob.

        This is called in the transaction that inserts the blob's row.
        """
        ...

    def check_writable(self) -> None:
        """Raise `OSError` if the backing cannot write bytes."""
        ...


_CHUNK = Prepared(
    select(blob_chunk.c.data).where(
        blob_chunk.c.digest == bindparam("digest"), blob_chunk.c.position == bindparam("position")
    )
)


_INSERT_CHUNK = Prepared(insert(blob_chunk))
_UPLOAD = Prepared(select(blob.c.upload_id).where(blob.c.digest == bindparam("digest")))
_PIECE = Prepared(
    select(upload_chunk.c.offset, upload_chunk.c.data)
    .where(upload_chunk.c.upload_id == bindparam("upload_id"), upload_chunk.c.offset <= bindparam("at"))
    .order_by(upload_chunk.c.offset.desc())
    .limit(1)
)


def read_pieces(connection: Connection, upload_id: str, start: int, stop: int) -> Iterator[bytes]:
    """Yield the received bytes `start` to `stop - 1` of an upload in pieces of at most `CHUNK_BYTES`."""
    while start < stop and (rows := _PIECE.run(connection, {"upload_id": upload_id, "at": start})):
        base, piece = rows[0].offset, rows[0].data
        part: bytes = piece[start - base : stop - base]
        if not part:
            return
        yield part
        start += len(part)


class DatabaseBlobs:
    """Blobs stored in the database in rows of 1 MiB; an upload that becomes a blob stays in the rows of its pieces."""

    def write(self, connection: Connection, contents: Mapping[str, Iterable[bytes]]) -> None:
        """Store the bytes of blobs in rows of 1 MiB, several rows with one statement."""
        rows: list[dict[str, Any]] = []
        size_bytes = 0
        for digest, chunks in contents.items():
            for position, chunk in enumerate(chunks):
                rows.append({"digest": digest, "position": position, "data": chunk})
                size_bytes += len(chunk)
                if size_bytes >= BYTES_PER_STATEMENT:
                    _INSERT_CHUNK.run_each(connection, rows)
                    rows, size_bytes = [], 0
        _INSERT_CHUNK.run_each(connection, rows)

    def read(self, connection: Connection, digest: str, start: int, stop: int) -> Iterator[bytes]:
        """Yield the bytes `start` to `stop - 1` of a blob."""
        for position in range(start // CHUNK_BYTES, -(-stop // CHUNK_BYTES)):
            rows = _CHUNK.run(connection, {"digest": digest, "position": position})
            if not rows:
                if position == start // CHUNK_BYTES and (upload_id := self._upload_of(connection, digest)):
                    yield from read_pieces(connection, upload_id, start, stop)
                return
            data: bytes = rows[0].data
            base = position * CHUNK_BYTES
            yield data if start <= base and base + len(data) <= stop else data[max(start - base, 0) : stop - base]

    def expect(self, connection: Connection, digests: Iterable[str]) -> None:
        """Do nothing: reading blobs together is not faster."""

    def _upload_of(self, connection: Connection, digest: str) -> str | None:
        rows = _UPLOAD.run(connection, {"digest": digest})
        return rows[0].upload_id if rows else None

    def release(self, connection: Connection, digest: str) -> None:
        """Delete the rows of a blob's bytes, in the transaction that deletes the blob's row.

        If the blob was an upload, its pieces are deleted later, a few at a time, because there may be many.
        """
        connection.execute(delete(blob_chunk).where(blob_chunk.c.digest == digest))

    def stray_digests(self, *, older_than_s: float) -> Iterator[str]:  # noqa: ARG002
        """Yield no digests, because a foreign key prevents bytes without a row in `blob`."""
        return iter(())

    def remove_stray(self, digest: str) -> None:
        """Do nothing, because there are no bytes without a row in `blob`."""

    def new_copy(self) -> None:
        """Return None: no copy is needed, because the stored pieces of an upload become the blob."""

    def adopt(self, copy: Path, digest: str) -> None:
        """Raise `AssertionError`: this backing makes no copies."""
        raise AssertionError(f"blobs in a database use no files, but the server made the file {copy} for {digest}")

    def check_writable(self) -> None:
        """Do nothing: the server checks the database separately."""


class DirectoryBlobs:
    """Blobs stored in files that are named by the digest: the blob `abcdef...` is the file `<root>/ab/cdef...`.

    Each file is written under a temporary name, synced to the disk, and then renamed.
    """

    def __init__(self, root: Path) -> None:
        self.root = root
        self._incoming = root / "incoming"
        root.mkdir(parents=True, exist_ok=True, mode=0o700)
        self._incoming.mkdir(exist_ok=True, mode=0o700)

    def _path(self, digest: str) -> Path:
        digits = digest.removeprefix("sha256:")
        return self.root / digits[:2] / digits[2:]

    def _new_path(self, digest: str) -> Path:
        """Return the path of a blob's file, and create its folder if necessary."""
        path = self._path(digest)
        path.parent.mkdir(exist_ok=True, mode=0o700)
        return path

    def write(self, connection: Connection, contents: Mapping[str, Iterable[bytes]]) -> None:  # noqa: ARG002
        """Write the file of each blob; replace a file of this name, which a rolled-back transaction may have left."""
        for digest, chunks in contents.items():
            self._write(digest, chunks)

    def _write(self, digest: str, chunks: Iterable[bytes]) -> None:
        path = self._new_path(digest)
        handle, name = tempfile.mkstemp(dir=self._incoming)
        try:
            with os.fdopen(handle, "wb") as file:
                for chunk in chunks:
                    file.write(chunk)
                file.flush()
                os.fsync(file.fileno())
            os.replace(name, path)
        except BaseException:
            with suppress(FileNotFoundError):
                os.unlink(name)
            raise
        _sync_directory(path.parent)
        _sync_directory(self.root)

    def read(self, connection: Connection, digest: str, start: int, stop: int) -> Iterator[bytes]:
        """Yield the bytes `start` to `stop - 1` of a blob from its file, or from the database if there is no file."""
        try:
            file = self._path(digest).open("rb")
        except FileNotFoundError:
            yield from DatabaseBlobs().read(connection, digest, start, stop)
            return
        with file:
            file.seek(start)
            while start < stop and (chunk := file.read(min(CHUNK_BYTES, stop - start))):
                start += len(chunk)
                yield chunk

    def expect(self, connection: Connection, digests: Iterable[str]) -> None:
        """Do nothing: reading blobs together is not faster."""

    def release(self, connection: Connection, digest: str) -> None:
        """Delete rows of bytes, if the blob is in the database.

        A file is not removed, because the transaction may still be rolled back; garbage collection removes it later.
        """
        DatabaseBlobs().release(connection, digest)

    def stray_digests(self, *, older_than_s: float) -> Iterator[str]:
        """Yield the digests of the files that are older than `older_than_s` seconds.

        Also remove unfinished files of this age: they belong to processes that ended while they were writing.
        """
        newest = time.time() - older_than_s
        for folder in sorted(path for path in self.root.iterdir() if path.is_dir()):
            for path in folder.iterdir():
                with suppress(FileNotFoundError):
                    if path.stat().st_mtime <= newest:
                        if folder == self._incoming:
                            path.unlink()
                        else:
                            yield f"sha256:{folder.name}{path.name}"

    def new_copy(self) -> Path:
        """Create an empty file for the copy of an upload, and return its path.

        If a process dies before it adopts or removes the file, garbage collection removes the file after a day.
        """
        handle, name = tempfile.mkstemp(dir=self._incoming)
        os.close(handle)
        return Path(name)

    def adopt(self, copy: Path, digest: str) -> None:
        """Rename a copy, whose bytes are synced already, to the file of the blob.

        Does nothing if an earlier try of the same transaction has renamed the copy already.
        """
        path = self._new_path(digest)
        try:
            os.replace(copy, path)
        except FileNotFoundError:
            if not path.exists():
                raise
        _sync_directory(path.parent)
        _sync_directory(self.root)

    def remove_stray(self, digest: str) -> None:
        """Remove the file of a blob."""
        self._path(digest).unlink(missing_ok=True)

    def check_writable(self) -> None:
        """Raise `OSError` if files cannot be written to the directory."""
        with tempfile.TemporaryFile(dir=self._incoming) as file:
            file.write(b"writable")


def _sync_directory(path: Path) -> None:
    handle = os.open(path, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
