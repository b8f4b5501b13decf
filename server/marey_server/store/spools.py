"""Temporary storage of bytes that a client sends, until they are stored as a blob."""

from __future__ import annotations

import hashlib
import tempfile
from collections.abc import Iterator
from types import TracebackType
from typing import Self

from marey_schemas.sizes import KIB
from marey_server.store.blob_backings import CHUNK_BYTES

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
        return f"sha256:{self._hash.hexdigest()}"

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
