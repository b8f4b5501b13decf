"""Cache of downloaded inputs: files with a checksum; the least recently used files are removed first."""

from __future__ import annotations

import hashlib
import logging
import os
import threading
import uuid
from collections.abc import Callable, Sequence
from pathlib import Path

log = logging.getLogger(__name__)

SEAL_BYTES = 32
KEEP_AFTER_CLEANING = 0.8
TEMPORARY = ".new-"


class InputCache:
    """Cache of bytes by key, in a folder that the workers of a machine may share.

    The bytes of a key never change, because a key is a digest, or names a part of a revision. Every file begins with
    the SHA-256 of the rest, so that a damaged or incomplete file is detected and downloaded again.
    """

    def __init__(self, folder: Path, max_bytes: int) -> None:
        self.folder = folder
        self.max_bytes = max_bytes
        self._lock = threading.Lock()
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        self._bytes = sum(size for _, size, _ in self._files())

    def get(self, key: str, fetch: Callable[[], bytes]) -> bytes:
        """Return the bytes for `key`; if they are not in the folder, call `fetch`, and store and return its result."""
        (data,) = self.get_many([key], lambda _missing: [fetch()])
        assert data is not None
        return data

    def get_many(self, keys: Sequence[str], fetch: Callable[[list[int]], Sequence[bytes | None]]) -> list[bytes | None]:
        """Return the bytes for several keys, in order; store those that were missing.

        `fetch` gets the indices of the keys that are not in the folder, and returns their bytes. It may leave out
        values at the end; the result then ends before the first key without a value. A value of None is returned, but
        not stored.
        """
        paths = [self.folder / hashlib.sha256(key.encode()).hexdigest() for key in keys]
        held = [self._read(path) for path in paths]
        missing = [index for index, data in enumerate(held) if data is None]
        fetched = fetch(missing) if missing else ()
        for index, data in zip(missing, fetched, strict=False):
            held[index] = data
            if data is not None:
                self._keep(paths[index], data)
        return held if len(fetched) == len(missing) else held[: missing[len(fetched)]]

    def _read(self, path: Path) -> bytes | None:
        """Return the stored bytes; return None if they are damaged, or missing because another worker removed them."""
        try:
            sealed = path.read_bytes()
            os.utime(path)
        except FileNotFoundError:
            return None
        seal, data = sealed[:SEAL_BYTES], sealed[SEAL_BYTES:]
        if hashlib.sha256(data).digest() != seal:
            log.warning("%s is damaged; fetching it again", path)
            path.unlink(missing_ok=True)
            return None
        return data

    def _keep(self, path: Path, data: bytes) -> None:
        """Store bytes if possible; if they cannot be stored, for example on a full disk, log this and continue."""
        size = SEAL_BYTES + len(data)
        if size > self.max_bytes:
            return
        temporary = path.with_name(f"{TEMPORARY}{uuid.uuid4().hex}")
        try:
            with open(temporary, "xb", opener=_private) as file:
                file.write(hashlib.sha256(data).digest())
                file.write(data)
            temporary.replace(path)
        except OSError as error:
            log.warning("cannot store an input in the cache %s: %s", self.folder, error)
            temporary.unlink(missing_ok=True)
            return
        with self._lock:
            self._bytes += size
            if self._bytes > self.max_bytes:
                self._clean()

    def _clean(self) -> None:
        """Remove the least recently used files until a fifth of the limit is free."""
        files = sorted(self._files())
        self._bytes = sum(size for _, size, _ in files)
        for _, size, path in files:
            if self._bytes <= KEEP_AFTER_CLEANING * self.max_bytes:
                return
            path.unlink(missing_ok=True)
            self._bytes -= size

    def _files(self) -> list[tuple[float, int, Path]]:
        """Return (time of last use, size, path) of every file; another worker may be removing some."""
        found: list[tuple[float, int, Path]] = []
        for entry in os.scandir(self.folder):
            try:
                status = entry.stat()
            except FileNotFoundError:
                continue
            found.append((status.st_mtime, status.st_size, Path(entry.path)))
        return found


def _private(path: str, flags: int) -> int:
    return os.open(path, flags, 0o600)
