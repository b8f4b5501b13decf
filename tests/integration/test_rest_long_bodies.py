"""Long request bodies: stored as blobs in short transactions, so that writes of other clients do not wait."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from sqlalchemy import func, select
from tests.support.rest_server import running

from marey_schemas.encoding.digests import digest_of
from marey_server.access.principal import SYSTEM
from marey_server.handlers.uploads import LONG_BODY_BYTES
from marey_server.store import garbage
from marey_server.store.database.connections import Database
from marey_server.store.fsck import check_store
from marey_server.store.tables import blob, blob_chunk, upload, upload_chunk
from marey_server.store.transaction import Quotas, Transaction

BODY = os.urandom(LONG_BODY_BYTES + 1_000_000)


def counts(database: Database) -> list[int]:
    """Return the number of rows of four tables: blobs, chunks of blobs, uploads, and chunks of uploads."""

    def count(tx: Transaction) -> list[int]:
        tables = (blob, blob_chunk, upload, upload_chunk)
        return [tx.execute(select(func.count()).select_from(table)).scalar_one() for table in tables]

    return database.read(SYSTEM, count)


@pytest.mark.parametrize("size_bytes", [LONG_BODY_BYTES, len(BODY)])
def test_a_body_becomes_a_blob_once(database: Database, tmp_path: Path, size_bytes: int) -> None:
    body = BODY[:size_bytes]
    pieces = -(-size_bytes // 2**20)
    with running(database, tmp_path) as server:
        client = server.client(server.make_project())
        for _ in range(2):
            assert client.put(f"/blobs/{digest_of(body)}", content=body).status_code == 204
            assert counts(database) == ([1, pieces, 0, 0] if size_bytes <= LONG_BODY_BYTES else [1, 0, 1, pieces])
        assert list(check_store(database)) == []


def test_a_long_body_with_another_digest_is_not_stored(database: Database, tmp_path: Path) -> None:
    with running(database, tmp_path) as server:
        refused = server.client(server.make_project()).put(f"/blobs/{digest_of(b'other')}", content=BODY)
        assert (refused.status_code, refused.json()["code"]) == (422, "digest-mismatch")
        assert counts(database) == [0, 0, 0, 0]


def test_a_long_body_that_may_not_be_stored_leaves_nothing(database: Database, tmp_path: Path) -> None:
    database.quotas = Quotas(user_upload_bytes=LONG_BODY_BYTES)
    with running(database, tmp_path) as server:
        refused = server.client(server.make_project()).put(f"/blobs/{digest_of(BODY)}", content=BODY)
        assert refused.status_code == 409, refused.text
        assert counts(database) == [0, 0, 0, 0]


def test_bytes_of_deleted_blobs_are_deleted_a_few_at_a_time(
    database: Database, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(garbage, "BATCH_BYTES", 3_000_000)
    with running(database, tmp_path) as server:
        client = server.client(server.make_project())
        for body in (BODY, *(bytes([number]) * 2_000_000 for number in range(3))):
            assert client.put(f"/blobs/{digest_of(body)}", content=body).status_code == 204
    batches: list[int] = []
    delete_blobs = garbage.delete_blobs

    def noted(tx: Transaction, digests: list[str], grace_us: int) -> int:
        batches.append(len(digests))
        return delete_blobs(tx, digests, grace_us)

    monkeypatch.setattr(garbage, "delete_blobs", noted)
    garbage.collect_garbage(database, grace_us=-1)
    assert batches == [1, 1, 1, 1]
    assert counts(database) == [0, 0, 1, 0]
