"""Checks of the bytes of blobs: in the database, in files, and in object storage."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

from sqlalchemy import Row, select

from marey_server.access.principal import SYSTEM
from marey_server.store.database.connections import Database
from marey_server.store.object_storage.awaiting import digest_of_chunks
from marey_server.store.object_storage.backing import ObjectBlobs
from marey_server.store.object_storage.client import StoredObject
from marey_server.store.tables import blob
from marey_server.store.transaction import Transaction

PAGE = 100
"""Number of rows that one transaction reads."""


@dataclass(frozen=True, slots=True)
class StoreDefect:
    """Defect of the store: a stable code, the place, and a description."""

    code: str
    subject: str
    detail: str


def check_blob(tx: Transaction, row: Row[Any]) -> list[StoreDefect]:
    """Return a list with the defect of a blob whose bytes are damaged; it is empty for an intact blob.

    It is also empty for a blob in object storage, because `check_objects` checks such blobs.
    """
    if row.object_id is not None:
        return []
    return _compare(row, tx.blobs.read(tx.connection, row.digest, 0, row.size_bytes))


def _compare(row: Row[Any], pieces: Iterable[bytes]) -> list[StoreDefect]:
    """Return a list with the defect of bytes that do not have the size and the digest of a blob; else an empty list."""
    digest, size = digest_of_chunks(pieces)
    if size != row.size_bytes:
        detail = f"{size} bytes are stored, but the row of the blob states {row.size_bytes}"
        return [StoreDefect("blob-incomplete", row.digest, detail)]
    intact = digest == row.digest
    return [] if intact else [StoreDefect("blob-corrupt", row.digest, "the bytes do not have this digest")]


def check_objects(database: Database) -> Iterator[list[StoreDefect]]:
    """Read the objects of all blobs, outside of transactions; yield the defects of each blob, often an empty list."""
    behind = ""
    while rows := database.read(SYSTEM, _in_objects, behind):
        for row in rows:
            if isinstance(database.blobs, ObjectBlobs):
                findings = _compare(row, database.blobs.storage.chunks(StoredObject(row.digest, row.object_id).name))
                yield findings if findings and row in database.read(SYSTEM, _in_objects, row.digest, same=True) else []
            else:
                detail = "it is in object storage, but the settings name no bucket (s3_bucket)"
                yield [StoreDefect("blob-unreachable", row.digest, detail)]
        behind = rows[-1].digest


def _in_objects(tx: Transaction, behind: str, *, same: bool = False) -> list[Row[Any]]:
    """Return the next rows of blobs in object storage after the digest `behind`; with `same`, only the row `behind`."""
    rows = select(blob.c.digest, blob.c.size_bytes, blob.c.object_id).where(blob.c.object_id.is_not(None))
    chosen = blob.c.digest == behind if same else blob.c.digest > behind
    return list(tx.execute(rows.where(chosen).order_by(blob.c.digest).limit(PAGE)))
