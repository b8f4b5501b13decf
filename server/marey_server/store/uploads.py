"""Resumable uploads: bytes that are sent in pieces, over several connections if necessary, and form a blob at the end.

Pieces are stored in rows. The offset is updated by compare-and-swap, so that two senders cannot interleave. No
transaction reads, hashes or copies all bytes: `UploadHashes` does this outside of transactions, and the pieces of a
finished upload are kept as the pieces of its blob (docs/decisions/0029-large-blobs.md).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sqlalchemy import Row, and_, delete, exists, insert, or_, select, update

from marey_server import faults
from marey_server.errors import (
    ConflictProblem,
    ForbiddenProblem,
    InvalidProblem,
    NotFoundProblem,
    TooLargeProblem,
    UnauthenticatedProblem,
)
from marey_server.store import blob_backings, blobs
from marey_server.store.blob_backings import CHUNK_BYTES
from marey_server.store.database.clock import DAY_US
from marey_server.store.ids import new_id
from marey_server.store.quotas.counting import require_room
from marey_server.store.quotas.daily import count_sent, uncount_sent
from marey_server.store.tables import blob, job, upload, upload_chunk
from marey_server.store.transaction import Transaction

MAX_UPLOAD_BYTES = 16 * 2**30
LIFETIME_US = 7 * DAY_US
"""Time in microseconds without a new piece after which an upload is deleted."""
PIECES_AT_ONCE = 8
"""Number of pieces, each of at most 1 MiB, that one transaction deletes, so that other writes do not wait long."""

_HAS_BLOB = exists().where(blob.c.upload_id == upload.c.id)


@dataclass(frozen=True, slots=True)
class StoredUpload:
    """State of an upload.

    `digest` is set once the upload is a blob; `actual_digest` is set if its bytes do not have the announced digest.
    """

    id: str
    length: int
    offset: int
    digest: str | None
    announced: str | None = None
    actual_digest: str | None = None

    @property
    def is_received(self) -> bool:
        """Whether all bytes were received, and `finish` was not called yet."""
        return self.offset == self.length and self.digest is None and self.actual_digest is None


def create_upload(tx: Transaction, length: int, *, digest: str | None = None) -> StoredUpload:
    """Create an upload of `length` bytes; if `digest` is given, the bytes must have this digest.

    Raises `TooLargeProblem` if `length` is not between 1 and `MAX_UPLOAD_BYTES`, `QuotaExceededProblem` if a quota
    would be exceeded, and `ForbiddenProblem` if the caller may not upload data.
    """
    sender = _sender(tx)
    if not 0 < length <= MAX_UPLOAD_BYTES:
        raise TooLargeProblem(f"The size of an upload must be 1 to {MAX_UPLOAD_BYTES} bytes.")
    require_room(tx, "user_uploads")
    require_room(tx, "user_upload_bytes", length)
    upload_id = new_id("upload")
    row = {
        "id": upload_id, **sender, "length": length, "offset": 0, "digest": digest,
        "created_us": tx.now_us, "updated_us": tx.now_us,
    }  # fmt: skip
    tx.execute(insert(upload), row)
    count_sent(tx, length)
    return StoredUpload(upload_id, length, 0, None)


def read_upload(tx: Transaction, upload_id: str) -> StoredUpload:
    """Return the state of an upload of the caller. Raises `NotFoundProblem` if it does not exist."""
    return _shown(_find(tx, upload_id))


def append(tx: Transaction, upload_id: str, offset: int, data: bytes) -> StoredUpload:
    """Append a piece of at most a few MiB at `offset`, and return the state of the upload.

    Raises `ConflictProblem` with the current offset in `context.offset` if the upload is at another offset, and
    `TooLargeProblem` if the piece goes past the announced length.
    """
    found = _find(tx, upload_id)
    if found.finished_digest is not None or found.offset != offset:
        raise _elsewhere(found.offset)
    if offset + len(data) > found.length:
        raise TooLargeProblem(
            f"The upload was created for {found.length} bytes, but would have {offset + len(data)} after this piece; "
            f"send at most {found.length - offset} bytes."
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


def read_pieces(tx: Transaction, upload_id: str, start: int, size_bytes: int) -> list[bytes]:
    """Return at most `size_bytes` of the received bytes of an upload of the caller, from `start`."""
    found = _find(tx, upload_id)
    stop = min(start + size_bytes, found.offset)
    return list(blob_backings.read_pieces(tx.connection, upload_id, start, stop))


def finish(tx: Transaction, upload_id: str, digest: str, copy: Path | None) -> StoredUpload:
    """Store a complete upload, whose bytes have the given digest, as a blob; a repeated call changes nothing.

    The bytes are not read. The blob uses either the stored pieces, or `copy`, a file to which the storage of blobs has
    copied them. If another digest was announced, no blob is made, and `digest` is recorded as the actual digest (see
    `require_intact`).

    Raises `ConflictProblem` if bytes are missing.
    """
    found = _find(tx, upload_id)
    if found.finished_digest is not None or found.actual_digest is not None:
        return _shown(found)
    if found.offset != found.length:
        raise _elsewhere(found.offset)
    if found.digest not in (None, digest):
        tx.execute(update(upload).where(upload.c.id == upload_id).values(actual_digest=digest))
        return _shown(_find(tx, upload_id))
    claimed = update(upload).where(upload.c.id == upload_id, upload.c.finished_digest.is_(None))
    if tx.execute(claimed.values(finished_digest=digest, updated_us=tx.now_us)).rowcount:
        row = {"digest": digest, "size_bytes": found.length, "created_us": tx.now_us}
        row["upload_id"] = upload_id if copy is None else None
        is_new = bool(blobs.insert_new(tx, blob, [row]))
        if is_new and copy is not None:
            tx.blobs.adopt(copy, digest)
        blobs.add_holder(tx, digest, _places(found))
        if not is_new:
            uncount_sent(tx, found.length)
    faults.point("upload.finish.before_commit")
    tx.after_commit(lambda: faults.point("upload.finish.after_commit"))
    return _shown(_find(tx, upload_id))


def require_intact(found: StoredUpload) -> None:
    """Raise `InvalidProblem` if the bytes of a finished upload do not have the announced digest."""
    if found.actual_digest is not None:
        detail = (
            f"The bytes have the digest {found.actual_digest}, not {found.announced}. Delete this upload and "
            "create another."
        )
        raise InvalidProblem(detail, code="digest-mismatch")


def abandon(tx: Transaction, upload_id: str) -> None:
    """Mark an upload as dropped, so that it is deleted later; a blob made from it is kept."""
    found = _find(tx, upload_id)
    dropped = update(upload).where(upload.c.id == found.id, upload.c.dropped.is_(False)).values(dropped=True)
    for row in tx.execute(dropped.returning(upload.c.length, upload.c.offset)).all():
        uncount_sent(tx, row.length - row.offset)


# -- garbage ----------------------------------------------------------------------------------------------------------


def drop_old(tx: Transaction, limit: int) -> int:
    """Mark uploads that received no piece for `LIFETIME_US` as dropped; return their number."""
    old = select(upload.c.id).where(upload.c.updated_us < tx.now_us - LIFETIME_US, upload.c.dropped.is_(False))
    found = list(tx.execute(old.limit(limit).with_for_update(skip_locked=True)).scalars())
    tx.execute(update(upload).where(upload.c.id.in_(found)).values(dropped=True))
    return len(found)


def delete_pieces(tx: Transaction) -> int:
    """Delete a few pieces that no upload and no blob needs any more; return their number, 0 if there are none left."""
    over = or_(upload.c.dropped, upload.c.finished_digest.is_not(None))
    useless = select(upload_chunk.c.upload_id, upload_chunk.c.offset).join(upload).where(over, ~_HAS_BLOB)
    found = tx.execute(useless.limit(PIECES_AT_ONCE)).all()
    for piece in found:
        chosen = and_(upload_chunk.c.upload_id == piece.upload_id, upload_chunk.c.offset == piece.offset)
        tx.execute(delete(upload_chunk).where(chosen))
    faults.point("upload.pieces.before_commit")
    return len(found)


def delete_dropped(tx: Transaction, limit: int) -> int:
    """Delete the rows of dropped uploads whose pieces were deleted; return the number of rows."""
    has_pieces = exists().where(upload_chunk.c.upload_id == upload.c.id)
    empty = select(upload.c.id).where(upload.c.dropped, ~_HAS_BLOB, ~has_pieces).limit(limit)
    return tx.execute(delete(upload).where(upload.c.id.in_(list(tx.execute(empty).scalars())))).rowcount


def _sender(tx: Transaction) -> dict[str, Any]:
    """Return the columns of a new upload that name the sender, and the projects in which the bytes can be used.

    Raises `ForbiddenProblem` if the caller may not upload data.
    """
    caller = tx.principal
    blobs.require_sender(caller)
    if caller.kind == "attempt":
        author_id = tx.execute(select(job.c.author_id).where(job.c.id == caller.job_id)).scalar()
        columns = {"user_id": author_id, "job_id": caller.job_id, "fence": caller.fence}
    else:
        places = blobs.places_of_sender(tx)
        columns = {"user_id": caller.user_id, "project_ids": None if blobs.EVERY_PROJECT in places else list(places)}
    if columns["user_id"] is None:
        raise ForbiddenProblem("Only users and their running jobs can upload data.", code="users-only")
    return columns


def _places(row: Row[Any]) -> list[str]:
    return [blobs.EVERY_PROJECT] if row.project_ids is None else list(row.project_ids)


def _find(tx: Transaction, upload_id: str) -> Row[Any]:
    caller = tx.principal
    if caller.kind == "anonymous":
        raise UnauthenticatedProblem("Sign in to upload data.")
    if caller.kind == "attempt":
        mine = and_(upload.c.job_id == caller.job_id, upload.c.fence == caller.fence)
    else:
        mine = and_(upload.c.user_id == (caller.user_id or ""), upload.c.job_id.is_(None))
    statement = select(upload).where(upload.c.id == upload_id, mine, upload.c.dropped.is_(False))
    row = tx.execute(statement).first()
    if row is None or (caller.kind == "user" and not blobs.reaches(tx, _places(row))):
        raise NotFoundProblem(f"You have no upload {upload_id!r}.", code="no-upload")
    return row


def _elsewhere(offset: int) -> ConflictProblem:
    return ConflictProblem(
        f"The server has received {offset} bytes; continue from there.", code="wrong-offset", context={"offset": offset}
    )


def _shown(row: Row[Any]) -> StoredUpload:
    return StoredUpload(row.id, row.length, row.offset, row.finished_digest, row.digest, row.actual_digest)
