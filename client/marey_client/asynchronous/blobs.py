"""Counterparts of `marey_client.blobs` for async programs.

Written by `make docs` from that module; change it there.
"""

from __future__ import annotations

from collections.abc import Iterable
from io import BufferedRandom
from pathlib import Path

from marey_client.asynchronous.counterparts import Counterpart, counterpart_of
from marey_client.blobs import Blobs


@counterpart_of(Blobs)
class AsyncBlobs(Counterpart):
    """Blobs (bytes identified by their digest) that the user of the token may read or has uploaded."""

    _sync: Blobs

    async def missing(self, digests: str | Iterable[str]) -> set[str]:
        """Return the digests whose blobs the server does not have."""
        return await self._run(self._sync.missing, digests)

    async def put(self, data: bytes, *, digest: str | None = None) -> str:
        """Upload bytes, even if the server already has them; return their digest."""
        return await self._run(self._sync.put, data, digest=digest)

    async def put_file(self, path: str | Path, *, digest: str | None = None) -> str:
        """Stream a file to the server and return its digest; a large file is sent as a resumable upload.

        Raises `FileChanged` if a large file becomes shorter while it is sent, or if the length of another file changes.
        """
        return await self._run(self._sync.put_file, path, digest=digest)

    async def fetch(self, digest: str, *, most_bytes: int | None = None) -> bytes:
        """Return the bytes of a blob. Raises `DigestMismatch` if the received bytes have another digest.

        Raises `BlobTooLarge` before the download if the blob has more than `most_bytes`.
        """
        return await self._run(self._sync.fetch, digest, most_bytes=most_bytes)

    async def fetch_to(self, digest: str, target: Path) -> Path:
        """Download a blob to `target`, which is created only when complete; an interrupted download is resumed."""
        return await self._run(self._sync.fetch_to, digest, target)

    async def fetch_into(self, digest: str, file: BufferedRandom) -> None:
        """Download a blob into an empty file that is open for reading and writing; its position is then at the end.

        Raises `DigestMismatch` if the received bytes have another digest.
        """
        await self._run(self._sync.fetch_into, digest, file)
