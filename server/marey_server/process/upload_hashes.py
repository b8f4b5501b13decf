"""Hashes of uploads, computed outside transactions while the uploads arrive."""

from __future__ import annotations

import hashlib
import os
import threading
from pathlib import Path

from marey_schemas.encoding.digests import digest_of_hash
from marey_schemas.lru import LruCache
from marey_server.access.principal import Principal
from marey_server.store import uploads
from marey_server.store.database.connections import Database

MOST_UPLOADS = 1024
"""Number of uploads whose hashes are in memory; other uploads are hashed again after their last byte has arrived."""
STEP_BYTES = 32 * 2**20
"""Number of bytes that are read and hashed at a time."""
READ_BYTES = 4 * 2**20
"""Number of bytes that one transaction reads."""


class _RunningHash:
    """Hash of the first `offset` bytes of an upload, and the file to which these bytes are copied, if any."""

    def __init__(self, copy: Path | None) -> None:
        self.lock = threading.Lock()
        self.offset = 0
        self.copy = copy
        self._hash = hashlib.sha256()

    def add(self, data: bytes) -> None:
        """Add the next bytes to the hash, and to the copy if there is one."""
        if self.copy is not None:
            with open(self.copy, "r+b") as file:
                file.seek(self.offset)  # writing may have failed half-way
                file.write(data)
        self._hash.update(data)
        self.offset += len(data)

    def digest(self) -> str:
        """Sync the copy, if any, to disk; return the digest of the bytes."""
        if self.copy is not None:
            with open(self.copy, "rb") as file:
                os.fsync(file.fileno())
        return digest_of_hash(self._hash)


class UploadHashes:
    """Hashes of the uploads that this process receives. Methods block, and may be called by several threads.

    If the database stores blobs as files, each upload is also copied to a file, which becomes the blob when the upload
    is complete.

    After a restart, or if another server process received some of the pieces, the hash is computed again from the
    stored pieces.
    """

    def __init__(self, database: Database) -> None:
        self._database = database
        self._hashes: LruCache[str, _RunningHash] = LruCache(max_entries=MOST_UPLOADS)
        self._lock = threading.Lock()

    def add(self, upload_id: str, offset: int, data: bytes) -> None:
        """Hash a stored piece if it directly follows the bytes hashed so far; otherwise `finish` hashes it."""
        running = self._running(upload_id)
        with running.lock:
            if running.offset == offset:
                running.add(data)

    def finish(self, principal: Principal, upload: uploads.StoredUpload) -> tuple[str, Path | None] | None:
        """Return the digest of an upload and the path of its copy, which is None if there is no copy.

        All bytes of the upload must be stored. Each call hashes at most `STEP_BYTES` of them; if bytes remain, return
        None: call again.
        """
        running = self._running(upload.id)
        with running.lock:
            target = min(upload.length, running.offset + STEP_BYTES)
            while running.offset < target:
                size_bytes = min(READ_BYTES, target - running.offset)
                pieces = self._database.read(principal, uploads.read_pieces, upload.id, running.offset, size_bytes)
                for piece in pieces:
                    running.add(piece)
            return (running.digest(), running.copy) if running.offset == upload.length else None

    def forget(self, upload_id: str) -> None:
        """Remove the hash of an upload that has ended, and delete its copy unless it became a blob."""
        running = self._hashes.pop(upload_id)
        if running is not None and running.copy is not None:
            running.copy.unlink(missing_ok=True)

    def _running(self, upload_id: str) -> _RunningHash:
        with self._lock:
            running = self._hashes.get(upload_id)
            if running is None or (running.copy is not None and not running.copy.exists()):
                running = _RunningHash(self._database.blobs.new_copy())
                self._hashes.put(upload_id, running)
            return running
