"""Resumable uploads: bytes sent in pieces, over several connections if necessary, that become a blob at the end.

Pieces are stored in rows until then. The offset is updated by compare-and-swap, so that two senders cannot interleave.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from sqlalchemy import Row, delete, insert, select, update

from marey_server.errors import (
    ConflictProblem,
    ForbiddenProblem,
    InvalidProblem,
    NotFoundProblem,
    TooLargeProblem,
    UnauthenticatedProblem,
)
from marey_server.store import blobs
from marey_server.store.blob_backings import CHUNK_BYTES
from marey_server.store.ids import new_id
from marey_server.store.tables import upload, upload_chunk
from marey_server.store.transaction import Transaction

MAX_UPLOAD_BYTES = 16 * 2**30
LIFETIME_US = 7 * 86400 * 1_000_000
"""Time without a new piece after which an upload is deleted."""


@dataclass(frozen=True, slots=True)
class StoredUpload:
    """State of an upload; `digest` is set once it is complete."""

    id: str
    length: int
    offset: int
    digest: str | None


def create_upload(tx: Transaction, length: int, *, digest: str | None = None) -> StoredUpload:
    """Create an upload of `length` bytes; if `digest` is given, the bytes must have it."""
    user_id = _sender(tx)
    if not 0 < length <= MAX_UPLOAD_BYTES:
        raise TooLargeProblem(f"An upload must have 1 to {MAX_UPLOAD_BYTES} bytes.")
    upload_id = new_id("upload")
    row = {
        "id": upload_id, "user_id": user_id, "length": length, "offset": 0, "digest": digest,
        "created_us": tx.now_us, "updated_us": tx.now_us,
    }  # fmt: skip
    tx.execute(insert(upload), row)
    return StoredUpload(upload_id, length, 0, None)


def read_upload(tx: Transaction, upload_id: str) -> StoredUpload:
    """Return the state of an upload of the caller. Raises `NotFoundProblem`."""
    return _shown(_find(tx, upload_id))


def append(tx: Transaction, upload_id: str, offset: int, data: bytes) -> StoredUpload:
    """Append a piece of at most a few MiB at `offset`.

    Raises `ConflictProblem` with the current offset in `context.offset` if the upload is at another offset.
    """
    found = _find(tx, upload_id)
    if found.finished_digest is not None or found.offset != offset:
        raise _elsewhere(found.offset)
    if offset + len(data) > found.length:
        raise TooLargeProblem(
            f"The upload was announced with {found.length} bytes; this would make {offset + len(data)}."
        )
    if not data:
        return _shown(found)
    moved = (
        update(upload)
        .where(upload.c.id == upload_id, upload.c.offset == offset, upload.c.finished_digest.is_(None))
        .values(offset=offset + len(data), updated_us=tx.now_us)
    )
    if tx.execute(moved).rowcount == 0:
        raise _elsewhere(_find(tx, upload_id).offset)
    for start in range(0, len(data), CHUNK_BYTES):
        piece = {"upload_id": upload_id, "offset": offset + start, "data": data[start : start + CHUNK_BYTES]}
        tx.execute(insert(upload_chunk), piece)
    return StoredUpload(upload_id, found.length, offset + len(data), None)


def finish(tx: Transaction, upload_id: str) -> str:
    """Store a complete upload as a blob and return its digest; a repeated call returns the same.

    Raises `ConflictProblem` if bytes are missing, and `InvalidProblem` if the bytes do not have the announced digest;
    they are kept until the upload is deleted or expires.
    """
    found = _find(tx, upload_id)
    if found.finished_digest is not None:
        return str(found.finished_digest)
    if found.offset != found.length:
        raise _elsewhere(found.offset)
    hashed = hashlib.sha256()
    for piece in _pieces(tx, upload_id):
        hashed.update(piece)
    digest = f"sha256:{hashed.hexdigest()}"
    if found.digest not in (None, digest):
        detail = f"The bytes are {digest}, not {found.digest}. Upload them again."
        raise InvalidProblem(detail, code="digest-mismatch")
    claimed = update(upload).where(upload.c.id == upload_id, upload.c.finished_digest.is_(None))
    if tx.execute(claimed.values(finished_digest=digest, updated_us=tx.now_us)).rowcount == 0:
        return digest
    blobs.store_blobs(tx, {digest: blobs.Pieces(found.length, lambda: _even(_pieces(tx, upload_id)))})
    blobs.add_holder(tx, digest)
    tx.execute(delete(upload_chunk).where(upload_chunk.c.upload_id == upload_id))
    return digest


def abandon(tx: Transaction, upload_id: str) -> None:
    """Delete an upload; a blob made from it is kept."""
    found = _find(tx, upload_id)
    drop(tx, [found.id])


def drop(tx: Transaction, upload_ids: list[str]) -> None:
    """Delete uploads and the bytes received so far."""
    tx.execute(delete(upload_chunk).where(upload_chunk.c.upload_id.in_(upload_ids)))
    tx.execute(delete(upload).where(upload.c.id.in_(upload_ids)))


def _pieces(tx: Transaction, upload_id: str) -> Iterator[bytes]:
    """Yield the pieces in order, with one in memory at a time."""
    offset = 0
    one = select(upload_chunk.c.data)
    while data := tx.execute(
        one.where(upload_chunk.c.upload_id == upload_id, upload_chunk.c.offset == offset)
    ).scalar():
        offset += len(data)
        yield data


def _even(pieces: Iterator[bytes]) -> Iterator[bytes]:
    """Yield the same bytes in pieces of `CHUNK_BYTES`; the last one may be shorter."""
    held = bytearray()
    for piece in pieces:
        held += piece
        while len(held) >= CHUNK_BYTES:
            yield bytes(held[:CHUNK_BYTES])
            del held[:CHUNK_BYTES]
    if held:
        yield bytes(held)


def _sender(tx: Transaction) -> str:
    blobs.require_sender(tx.principal)
    if tx.principal.user_id is None:
        raise ForbiddenProblem("Only users and their jobs can upload.", code="users-only")
    return tx.principal.user_id


def _find(tx: Transaction, upload_id: str) -> Row[Any]:
    if tx.principal.kind == "anonymous":
        raise UnauthenticatedProblem("Sign in to upload.")
    statement = select(upload).where(upload.c.id == upload_id, upload.c.user_id == (tx.principal.user_id or ""))
    row = tx.execute(statement).first()
    if row is None:
        raise NotFoundProblem(f"You have no upload {upload_id!r}.", code="no-upload")
    return row


def _elsewhere(offset: int) -> ConflictProblem:
    return ConflictProblem(
        f"The upload is at byte {offset}; go on from there.", code="wrong-offset", context={"offset": offset}
    )


def _shown(row: Row[Any]) -> StoredUpload:
    return StoredUpload(row.id, row.length, row.offset, row.finished_digest)
