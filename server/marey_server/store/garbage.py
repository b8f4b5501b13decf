"""Garbage collection: deletes unreferenced documents and blobs, abandoned uploads and streams, and expired rows.

Expired rows are old idempotency keys, expired tokens and expired invitations.

A read finds the candidates. Each batch is then deleted in a transaction of its own that locks the rows and checks them
again. A write that adds a reference to a document or blob first updates the time in the row of the document or blob. So
the write either sees that the row is gone, or prevents its deletion.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from sqlalchemy import ColumnElement, Table, delete, exists, literal, select, tuple_

from marey_schemas.sizes import MIB
from marey_server import faults
from marey_server.access.principal import SYSTEM
from marey_server.store import uploads
from marey_server.store.blobs import GRACE_US
from marey_server.store.coverage_streams import is_old
from marey_server.store.credentials.tokens import expired_long_ago
from marey_server.store.database.connections import Database
from marey_server.store.idempotency import LIFETIME_US as KEY_LIFETIME_US
from marey_server.store.invitations import validity
from marey_server.store.jobs.fencing import RUNNING
from marey_server.store.object_upkeep.sweeping import sweep_objects
from marey_server.store.tables import (
    attempt_blob,
    blob,
    blob_holder,
    coverage_stream,
    document,
    document_blob,
    document_item,
    idempotency_key,
    job,
    job_blob,
    revision_part,
    staged_output,
    token,
)
from marey_server.store.transaction import Transaction

BATCH = 200
"""Number of rows, or of jobs, that are deleted in one transaction."""
BATCH_BYTES = 16 * MIB
"""Number of bytes that are deleted in one transaction, so that other writes do not wait long for this transaction."""
MOST_UPLOADS = 10_000
"""Greatest number of uploads that are deleted in one round; databases limit the parameters of a statement."""


@dataclass(frozen=True, slots=True)
class Collected:
    """Numbers of deleted rows and files.

    `keys` are idempotency keys. `ended_holdings` are records of blobs that were uploaded by attempts of jobs which have
    ended since.
    """

    documents: int
    blobs: int
    stray_files: int
    uploads: int
    keys: int
    coverage_streams: int = 0
    tokens: int = 0
    ended_holdings: int = 0
    invitations: int = 0
    stray_objects: int = 0


def collect_garbage(database: Database, *, grace_us: int = GRACE_US) -> Collected:
    """Delete unreferenced documents and blobs, and expired rows of other tables.

    A document or blob is deleted only if it was neither stored nor renewed in the last `grace_us` microseconds. May run
    at any time, and in several processes at once.
    """
    return Collected(
        documents=_collect(database, document, delete_documents, grace_us),
        blobs=_collect(database, blob, delete_blobs, grace_us),
        stray_files=_sweep_strays(database, grace_us),
        stray_objects=sweep_objects(database, grace_us),
        uploads=_delete_uploads(database),
        keys=_delete_expired(database, idempotency_key, _is_old_key),
        coverage_streams=_delete_expired(database, coverage_stream, is_old),
        tokens=_delete_expired(database, token, expired_long_ago),
        ended_holdings=_delete_expired(database, attempt_blob, _attempt_has_ended),
        invitations=database.write(SYSTEM, validity.delete_expired),
    )


def _collect(
    database: Database, table: Table, delete_some: Callable[[Transaction, Sequence[str], int], int], grace_us: int
) -> int:
    deleted, behind = 0, ""
    while found := database.read(SYSTEM, _candidates, table, grace_us, behind):
        deleted += database.write(SYSTEM, delete_some, found, grace_us)
        behind = found[-1]
    return deleted


def _candidates(tx: Transaction, table: Table, grace_us: int, behind: str) -> list[str]:
    """Return the next digests of documents or blobs, after the digest `behind`, that may be deleted (see `_garbage`).

    There are at most `BATCH` of them, with at most `BATCH_BYTES` together. A larger document or blob is returned alone.
    """
    rows = select(table.c.digest, table.c.size_bytes).where(table.c.digest > behind, *_garbage(tx, table, grace_us))
    chosen: list[str] = []
    left_bytes = BATCH_BYTES
    for row in tx.execute(rows.order_by(table.c.digest).limit(BATCH)):
        left_bytes -= row.size_bytes
        if chosen and left_bytes < 0:
            break
        chosen.append(row.digest)
    return chosen


def _garbage(tx: Transaction, table: Table, grace_us: int) -> tuple[ColumnElement[bool], ...]:
    """Return the SQL conditions for unreferenced documents or blobs, stored or renewed more than `grace_us` ago.

    Staged documents meet the conditions, too; the caller must exclude them.
    """
    old = table.c.created_us < tx.now_us - grace_us
    if table is document:
        return old, ~exists().where(revision_part.c.document_digest == document.c.digest)
    named = exists().where(document_blob.c.blob_digest == blob.c.digest)
    return old, ~named, ~exists().where(job_blob.c.blob_digest == blob.c.digest)


def _still_garbage(tx: Transaction, table: Table, digests: Sequence[str], grace_us: int) -> list[str]:
    """Lock the rows with the given digests; return the digests of those that are still old and without references."""
    chosen = table.c.digest.in_(digests)
    tx.execute(select(table.c.digest).where(chosen).order_by(table.c.digest).with_for_update()).all()
    return list(tx.execute(select(table.c.digest).where(chosen, *_garbage(tx, table, grace_us))).scalars())


def delete_documents(tx: Transaction, digests: Sequence[str], grace_us: int = GRACE_US) -> int:
    """Delete those of the given documents that are garbage (see `_garbage`) and not staged; return their number."""
    going = set(_still_garbage(tx, document, digests, grace_us)) - _staged_documents(tx)
    for references in (document_blob, document_item):
        tx.execute(delete(references).where(references.c.document_digest.in_(going)))
    tx.execute(delete(document).where(document.c.digest.in_(going)))
    faults.point("garbage.before_commit")
    return len(going)


def _staged_documents(tx: Transaction) -> set[str]:
    """Return the digests of the documents of staged outputs: results that a running job has not published yet.

    Documents that are staged after this read are not deleted either, because staging updates the time of their rows.
    After an attempt has completed, its staged documents are kept only while something else refers to them.
    """
    running = select(job.c.id).where(job.c.state == RUNNING)
    staged = select(staged_output.c.draft).where(staged_output.c.job_id.in_(running))
    drafts = tx.execute(staged.execution_options(yield_per=1000)).scalars()
    return {digest for draft in drafts for digest in draft["parts"].values()}


def delete_blobs(tx: Transaction, digests: Sequence[str], grace_us: int = GRACE_US) -> int:
    """Delete those of the given blobs that are garbage (see `_garbage`); return their number."""
    going = _still_garbage(tx, blob, digests, grace_us)
    for digest in going:
        tx.blobs.release(tx.connection, digest)
    for holder in (blob_holder, attempt_blob):
        tx.execute(delete(holder).where(holder.c.digest.in_(going)))
    tx.execute(delete(blob).where(blob.c.digest.in_(going)))
    faults.point("garbage.before_commit")
    return len(going)


def _sweep_strays(database: Database, grace_us: int) -> int:
    """Delete files that are older than `grace_us` and belong to no blob, or to a blob that is now in object storage.

    Rollbacks and deletions leave such files. Return the number of deleted files.
    """
    return sum(
        database.write(SYSTEM, _remove_stray, digest)
        for digest in database.blobs.stray_digests(older_than_s=grace_us / 1_000_000)
    )


def _remove_stray(tx: Transaction, digest: str) -> int:
    """Remove the file of a blob if the blob has no row or is in object storage; return how many files were removed.

    A lock on the row or its key keeps other writes from storing the bytes at the same time.
    """
    row = {"digest": digest, "size_bytes": 0, "created_us": tx.now_us}
    if tx.execute(tx.insert_or_ignore(blob, row).returning(blob.c.digest)).first() is None:
        moved = select(blob.c.digest).where(blob.c.digest == digest, blob.c.object_id.is_not(None))
        if tx.execute(moved.with_for_update()).first() is not None:
            tx.blobs.remove_stray(digest)
            return 1
        return 0
    tx.blobs.remove_stray(digest)
    tx.execute(delete(blob).where(blob.c.digest == digest))
    return 1


def _delete_uploads(database: Database) -> int:
    """Delete abandoned uploads, and pieces that no upload and no blob needs; return the number of deleted uploads.

    Uses several short transactions.
    """
    dropped = database.write(SYSTEM, uploads.drop_old, MOST_UPLOADS)
    while database.write(SYSTEM, uploads.delete_pieces):
        pass
    database.write(SYSTEM, uploads.delete_dropped, MOST_UPLOADS)
    return dropped


Condition = Callable[[Transaction], ColumnElement[bool]]
"""Function that returns the SQL condition for rows that may be deleted."""


def _delete_expired(database: Database, table: Table, condition: Condition) -> int:
    """Delete the rows that meet a condition, `BATCH` rows in each transaction; return their number."""
    deleted, behind = 0, None
    while found := database.read(SYSTEM, _expired_keys, table, condition, behind):
        deleted += database.write(SYSTEM, _delete_rows, table, condition, found)
        behind = found[-1]
    return deleted


def _expired_keys(
    tx: Transaction, table: Table, condition: Condition, behind: tuple[Any, ...] | None
) -> list[tuple[Any, ...]]:
    """Return at most `BATCH` primary keys, the next after `behind`, of rows that meet a condition."""
    key = list(table.primary_key.columns)
    rows = select(*key).where(condition(tx)).order_by(*key).limit(BATCH)
    if behind is not None:
        rows = rows.where(tuple_(*key) > tuple_(*map(literal, behind)))
    return [tuple(row) for row in tx.execute(rows)]


def _delete_rows(tx: Transaction, table: Table, condition: Condition, keys: Sequence[tuple[Any, ...]]) -> int:
    """Delete those of the rows with the given primary keys that still meet a condition; return their number."""
    chosen = tuple_(*table.primary_key.columns).in_(keys)
    return tx.execute(delete(table).where(chosen, condition(tx))).rowcount


def _is_old_key(tx: Transaction) -> ColumnElement[bool]:
    return idempotency_key.c.created_us < tx.now_us - KEY_LIFETIME_US


def _attempt_has_ended(_tx: Transaction) -> ColumnElement[bool]:
    """Return the SQL condition for records of blobs uploaded by attempts that have ended or lost their jobs."""
    same_attempt = (job.c.id == attempt_blob.c.job_id, job.c.fence == attempt_blob.c.fence)
    return ~exists().where(*same_attempt, job.c.state == RUNNING)
