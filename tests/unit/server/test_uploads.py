"""Resumable uploads."""

import os
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import event, func, select
from tests.support.database_fixtures import AdjustableClock
from tests.support.store_fixtures import Lab

from marey_schemas.encoding.digests import digest_of
from marey_server import faults
from marey_server.access.principal import SYSTEM
from marey_server.errors import (
    ConflictProblem,
    InvalidProblem,
    NotFoundProblem,
    TooLargeProblem,
    UnauthenticatedProblem,
)
from marey_server.process.upload_hashes import UploadHashes
from marey_server.store import blobs, garbage, uploads
from marey_server.store.blob_backings import DirectoryBlobs
from marey_server.store.fsck import check_store
from marey_server.store.tables import upload as upload_table
from marey_server.store.tables import upload_chunk

DATA = os.urandom(3_000_001)


def send(lab: Lab, upload_id: str, pieces: tuple[Any, ...], data: bytes = DATA) -> int:
    offset = 0
    for size in pieces:
        lab.write(uploads.append, upload_id, offset, data[offset : offset + size])
        offset += size
    return offset


def finish(lab: Lab, upload_id: str) -> uploads.StoredUpload:
    """Finish an upload, and return its state.

    The bytes are hashed again, as if another server process had received them.
    """
    hashes = UploadHashes(lab.database)
    upload = lab.read(uploads.read_upload, upload_id)
    if upload.is_received:
        while (content := hashes.finish(lab.owner, upload)) is None:
            pass
        upload = lab.write(uploads.finish, upload_id, *content)
    uploads.require_intact(upload)
    return upload


@pytest.mark.parametrize(
    "pieces", [(3_000_001,), (1, 2_999_999, 1), (1_048_576, 1_048_576, 902_849), (700_000,) * 4 + (200_001,)]
)
def test_pieces_of_any_size_become_the_bytes(lab: Lab, pieces: tuple[Any, ...]) -> None:
    upload = lab.write(uploads.create_upload, len(DATA), digest=digest_of(DATA))
    send(lab, upload.id, pieces)
    assert finish(lab, upload.id).digest == digest_of(DATA)
    assert lab.read(blobs.read_blob, digest_of(DATA)) == DATA
    assert lab.read(blobs.read_range, digest_of(DATA), 1_048_570, 1_048_580) == DATA[1_048_570:1_048_580]
    assert finish(lab, upload.id).digest == digest_of(DATA)
    assert lab.read(uploads.read_upload, upload.id).digest == digest_of(DATA)


def test_a_piece_at_the_wrong_place_is_told_the_right_one(lab: Lab) -> None:
    upload = lab.write(uploads.create_upload, len(DATA))
    send(lab, upload.id, (1000,))
    for offset in (0, 999, 1001):
        with pytest.raises(ConflictProblem) as refused:
            lab.write(uploads.append, upload.id, offset, b"x")
        assert refused.value.context == {"offset": 1000}
    with pytest.raises(ConflictProblem):
        lab.write(uploads.finish, upload.id, digest_of(DATA), None)


def test_the_same_piece_sent_twice_at_once_counts_once(lab: Lab) -> None:
    upload = lab.write(uploads.create_upload, len(DATA))
    futures = [lab.database.submit_write(lab.owner, uploads.append, upload.id, 0, DATA) for _ in range(4)]
    outcomes = [future.exception(60) for future in futures]
    assert sum(outcome is None for outcome in outcomes) == 1
    refused = [outcome for outcome in outcomes if isinstance(outcome, ConflictProblem)]
    assert [problem.context for problem in refused] == 3 * [{"offset": len(DATA)}]
    assert finish(lab, upload.id).digest == digest_of(DATA)


def test_more_than_was_announced_is_refused(lab: Lab) -> None:
    upload = lab.write(uploads.create_upload, 10)
    with pytest.raises(TooLargeProblem):
        lab.write(uploads.append, upload.id, 0, b"x" * 11)
    for length in (0, -1, uploads.MAX_UPLOAD_BYTES + 1):
        with pytest.raises(TooLargeProblem):
            lab.write(uploads.create_upload, length)


def test_other_bytes_than_announced_become_no_blob(lab: Lab) -> None:
    upload = lab.write(uploads.create_upload, 5, digest=digest_of(b"right"))
    lab.write(uploads.append, upload.id, 0, b"wrong")
    for _ in range(2):
        with pytest.raises(InvalidProblem):
            finish(lab, upload.id)
    assert lab.read(blobs.readable, [digest_of(b"wrong"), digest_of(b"right")]) == set()


def test_an_upload_is_its_senders_alone(lab: Lab) -> None:
    upload = lab.write(uploads.create_upload, 5)
    with pytest.raises(NotFoundProblem):
        lab.read(uploads.read_upload, upload.id, who=lab.reader)
    with pytest.raises(NotFoundProblem):
        lab.write(uploads.append, upload.id, 0, b"x", who=lab.reader)
    with pytest.raises(UnauthenticatedProblem):
        lab.read(uploads.read_upload, upload.id, who=lab.anonymous)


def test_uploads_that_nobody_continues_are_dropped(lab: Lab, clock: AdjustableClock) -> None:
    forgotten = lab.write(uploads.create_upload, len(DATA))
    send(lab, forgotten.id, (1000,))
    clock.advance(uploads.LIFETIME_US / 1e6 - 10)
    alive = lab.write(uploads.create_upload, 5)
    clock.advance(20)
    assert garbage.collect_garbage(lab.database).uploads == 1
    with pytest.raises(NotFoundProblem):
        lab.read(uploads.read_upload, forgotten.id)
    assert lab.read(uploads.read_upload, alive.id).offset == 0
    lab.write(uploads.abandon, alive.id)
    with pytest.raises(NotFoundProblem):
        lab.read(uploads.read_upload, alive.id)


@pytest.fixture(params=["database", "directory"])
def backed(request: pytest.FixtureRequest, lab: Lab, tmp_path: Path) -> Lab:
    """A project whose blobs are in the database, or in files."""
    if request.param == "directory":
        lab.database.blobs = DirectoryBlobs(tmp_path / "blobs")
    return lab


def sent(lab: Lab, data: bytes, digest: str | None = None) -> str:
    """Upload bytes in pieces of one MiB without finishing the upload; return its id."""
    upload = lab.write(uploads.create_upload, len(data), digest=digest)
    for start in range(0, len(data), 2**20):
        lab.write(uploads.append, upload.id, start, data[start : start + 2**20])
    return upload.id


def pieces(lab: Lab) -> int:
    return lab.database.read(SYSTEM, lambda tx: tx.execute(select(func.count()).select_from(upload_chunk)).scalar_one())


def test_a_hash_goes_on_where_pieces_arrived_and_is_made_again_where_they_did_not(backed: Lab) -> None:
    upload = backed.read(uploads.read_upload, sent(backed, DATA))
    for heard in ((), (0,), (0, 1), (1, 2), (2,), (0, 1, 2)):
        hashes = UploadHashes(backed.database)
        for number in heard:
            hashes.add(upload.id, number * 2**20, DATA[number * 2**20 : (number + 1) * 2**20])
        content = hashes.finish(backed.owner, upload)
        assert content is not None
        assert content[0] == digest_of(DATA)
        assert content[1] is None or content[1].read_bytes() == DATA
        hashes.forget(upload.id)
        assert content[1] is None or not content[1].exists()


def test_finishing_takes_as_many_statements_for_many_bytes_as_for_few(backed: Lab) -> None:
    counts = []
    statements: list[str] = []
    event.listen(backed.database.engine, "before_cursor_execute", lambda *args: statements.append(args[2]))
    for data in (b"few", os.urandom(5 * 2**20)):
        upload_id = sent(backed, data)
        content = UploadHashes(backed.database).finish(backed.owner, backed.read(uploads.read_upload, upload_id))
        assert content is not None
        statements.clear()
        backed.write(uploads.finish, upload_id, *content)
        # SQLite stores its clock about once a second.
        counts.append(sum("server_state" not in statement for statement in statements))
        assert backed.read(blobs.read_blob, digest_of(data)) == data
    assert counts[0] == counts[1] < 20


@pytest.mark.parametrize("point", ["upload.finish.before_commit", "upload.finish.after_commit"])
def test_a_death_while_finishing_leaves_no_half_blob_and_another_try_makes_it(
    backed: Lab, monkeypatch: pytest.MonkeyPatch, point: str
) -> None:
    def die(name: str) -> None:
        if name == point:
            raise RuntimeError("dead")

    upload_id = sent(backed, DATA, digest_of(DATA))
    with monkeypatch.context() as patch:
        patch.setattr(faults, "point", die)
        with pytest.raises(RuntimeError):
            finish(backed, upload_id)
    committed = point.endswith("after_commit")
    assert backed.read(blobs.readable, [digest_of(DATA)]) == ({digest_of(DATA)} if committed else set())
    assert finish(backed, upload_id).digest == digest_of(DATA)
    assert backed.read(blobs.read_blob, digest_of(DATA)) == DATA
    assert list(check_store(backed.database)) == []


def test_a_wrong_digest_is_found_once(backed: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    upload_id = sent(backed, DATA, digest_of(b"other"))
    with pytest.raises(InvalidProblem):
        finish(backed, upload_id)
    monkeypatch.setattr(UploadHashes, "finish", None)
    with pytest.raises(InvalidProblem, match=digest_of(DATA)):
        finish(backed, upload_id)


def test_pieces_are_deleted_a_few_at_a_time_once_nothing_needs_them(
    backed: Lab, clock: AdjustableClock, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(uploads, "PIECES_AT_ONCE", 2)
    data = os.urandom(3 * 2**20)
    finish(backed, sent(backed, data))
    again = sent(backed, data)
    finish(backed, again)  # the same bytes: these pieces are not needed
    abandoned = sent(backed, data)
    backed.write(uploads.abandon, abandoned)
    with pytest.raises(NotFoundProblem):
        backed.read(uploads.read_upload, abandoned)
    assert 0 < backed.database.write(SYSTEM, uploads.delete_pieces) <= 2
    garbage.collect_garbage(backed.database)
    of_blob = 0 if isinstance(backed.database.blobs, DirectoryBlobs) else 3
    assert pieces(backed) == of_blob
    assert backed.read(blobs.read_range, digest_of(data), 2**20 - 5, 2**20 + 5) == data[2**20 - 5 : 2**20 + 5]
    clock.advance(uploads.LIFETIME_US / 1e6 + 20)
    for _ in range(2):  # pieces are freed after their blob
        garbage.collect_garbage(backed.database)
    assert pieces(backed) == 0
    rows = backed.database.read(SYSTEM, lambda tx: tx.execute(select(func.count()).select_from(upload_table)).scalar())
    assert rows == 0
