"""Blobs (bytes identified by their digest): upload, download, and search for blobs that the server lacks."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from io import BufferedRandom
from pathlib import Path
from typing import BinaryIO

import httpx

from marey_client.arguments import checks_arguments, several
from marey_client.downloads import saved_atomically
from marey_client.errors import BlobTooLarge, Conflict, DigestMismatch, FileChanged, Unreachable
from marey_client.transport import Transport, as_json, read_model
from marey_schemas.encoding.digests import digest_of, digest_of_file, digest_of_hash
from marey_schemas.formats import OCTETS
from marey_schemas.items import BlobsMissing, BlobsQuery, Upload, UploadCreate
from marey_schemas.sizes import MIB, batched

DIGESTS_PER_QUESTION = 10_000
RESUMABLE_FROM_BYTES = 64 << 20
PIECE_BYTES = 16 << 20
TRIES_PER_PIECE = 5


@checks_arguments
@dataclass(frozen=True)
class Blobs:
    """Blobs (bytes identified by their digest) that the user of the token may read or has uploaded."""

    transport: Transport

    def missing(self, digests: str | Iterable[str]) -> set[str]:
        """Return the digests whose blobs the server does not have."""
        wanted = list(dict.fromkeys(several(digests)))
        lacking: set[str] = set()
        for some in batched(wanted, DIGESTS_PER_QUESTION):
            question = BlobsQuery(digests=tuple(some))
            answer = self.transport.post(BlobsMissing, "/blobs/missing", question)
            lacking.update(answer.missing)
        return lacking

    def put(self, data: bytes, *, digest: str | None = None) -> str:
        """Upload bytes, even if the server already has them; return their digest."""
        name = digest or digest_of(data)
        self.transport.send("PUT", f"/blobs/{name}", content=data, media_type=OCTETS)
        return name

    def put_file(self, path: str | Path, *, digest: str | None = None) -> str:
        """Stream a file to the server and return its digest; a large file is sent as a resumable upload.

        Raises `FileChanged` if a large file becomes shorter while it is sent, or if the length of another file changes.
        """
        path = Path(path)
        name = digest or digest_of_file(path)
        size_bytes = path.stat().st_size
        if size_bytes > RESUMABLE_FROM_BYTES:
            return send_in_pieces(self.transport, path, name)
        self.transport.send(
            "PUT",
            f"/blobs/{name}",
            content=lambda: _chunks(path, size_bytes),
            media_type=OCTETS,
            headers={"Content-Length": str(size_bytes)},
        )
        return name

    def fetch(self, digest: str, *, most_bytes: int | None = None) -> bytes:
        """Return the bytes of a blob. Raises `DigestMismatch` if the received bytes have another digest.

        Raises `BlobTooLarge` before the download if the blob has more than `most_bytes`.
        """

        def once() -> bytes:
            with self.transport.stream(f"/blobs/{digest}", headers={"Accept-Encoding": "identity"}) as response:
                size_bytes = int(response.headers.get("Content-Length", 0))
                if most_bytes is not None and size_bytes > most_bytes:
                    raise BlobTooLarge(digest, size_bytes, most_bytes)
                return response.read()

        data = self.transport.repeat(once, repeatable=True, what=f"GET /blobs/{digest}")
        if digest_of(data) != digest:
            raise DigestMismatch(
                f"the downloaded blob has the digest {digest_of(data)} instead of {digest}: it was "
                "damaged on the way or on the server"
            )
        return data

    def fetch_to(self, digest: str, target: Path) -> Path:
        """Download a blob to `target`, which is created only when complete; an interrupted download is resumed."""
        with saved_atomically(target) as file:
            self.fetch_into(digest, file)
        return target

    def fetch_into(self, digest: str, file: BufferedRandom) -> None:
        """Download a blob into an empty file that is open for reading and writing; its position is then at the end.

        Raises `DigestMismatch` if the received bytes have another digest.
        """

        def once() -> None:
            start = file.tell()
            ranged = {"Accept-Encoding": "identity", **({"Range": f"bytes={start}-"} if start else {})}
            with self.transport.stream(f"/blobs/{digest}", headers=ranged) as response:
                if start and response.status_code != httpx.codes.PARTIAL_CONTENT:
                    file.seek(0)
                    file.truncate()
                for chunk in response.iter_bytes():
                    file.write(chunk)

        self.transport.repeat(once, repeatable=True, what=f"GET /blobs/{digest}")
        file.seek(0)
        arrived = digest_of_hash(hashlib.file_digest(file, "sha256"))
        if arrived != digest:
            raise DigestMismatch(
                f"the downloaded blob has the digest {arrived} instead of {digest}: it was damaged on "
                "the way or on the server"
            )


def _chunks(path: Path, size_bytes: int) -> Iterator[bytes]:
    left = size_bytes
    with path.open("rb") as file:
        while chunk := file.read(MIB):
            left -= len(chunk)
            if left < 0:
                raise FileChanged(f"the file {path} grew while it was being uploaded; upload it again")
            yield chunk
    if left > 0:
        raise FileChanged(f"the file {path} was shortened while it was being uploaded; upload it again")


def send_in_pieces(transport: Transport, path: Path, digest: str) -> str:
    """Send a file as a resumable upload; return the digest of its blob.

    Raises `Unreachable` if all retries fail, `FileChanged` if the file becomes shorter while it is sent, and `Invalid`
    if the bytes that arrived do not have the digest `digest`.
    """
    announced = UploadCreate(length=path.stat().st_size, digest=digest)
    upload = read_model(Upload, transport.send("POST", "/uploads", content=as_json(announced)))
    tries = 0
    with path.open("rb") as file:
        while upload.digest is None:
            try:
                upload, tries = _send_piece(transport, upload, file), 0
            except (Unreachable, Conflict):
                tries += 1
                now = transport.get(Upload, f"/uploads/{upload.id}")
                if now == upload and tries == TRIES_PER_PIECE:
                    raise
                upload = now
    return digest


def _send_piece(transport: Transport, upload: Upload, file: BinaryIO) -> Upload:
    """Send the next piece and return the state of the upload; the last piece, which may be empty, ends the upload."""
    file.seek(upload.offset)
    piece = file.read(min(PIECE_BYTES, upload.length - upload.offset))
    if not piece and upload.offset < upload.length:
        raise FileChanged(f"the file {file.name} was shortened while it was being uploaded; upload it again")
    response = transport.send(
        "PATCH",
        f"/uploads/{upload.id}",
        content=piece,
        media_type=OCTETS,
        headers={"Upload-Offset": str(upload.offset)},
        repeatable=False,
    )
    return read_model(Upload, response)
