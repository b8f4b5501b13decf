"""Resumable uploads."""

import os
from typing import Any

import pytest
from tests.support.database_fixtures import AdjustableClock
from tests.support.store_fixtures import Lab

from marey_server.errors import (
    ConflictProblem,
    InvalidProblem,
    NotFoundProblem,
    TooLargeProblem,
    UnauthenticatedProblem,
)
from marey_server.store import blobs, garbage, uploads
from marey_server.store.blobs import digest_of

DATA = os.urandom(3_000_001)


def send(lab: Lab, upload_id: str, pieces: tuple[Any, ...], data: bytes = DATA) -> int:
    offset = 0
    for size in pieces:
        lab.write(uploads.append, upload_id, offset, data[offset : offset + size])
        offset += size
    return offset


@pytest.mark.parametrize(
    "pieces", [(3_000_001,), (1, 2_999_999, 1), (1_048_576, 1_048_576, 902_849), (700_000,) * 4 + (200_001,)]
)
def test_pieces_of_any_size_become_the_bytes(lab: Lab, pieces: tuple[Any, ...]) -> None:
    upload = lab.write(uploads.create_upload, len(DATA), digest=digest_of(DATA))
    send(lab, upload.id, pieces)
    assert lab.write(uploads.finish, upload.id) == digest_of(DATA)
    assert lab.read(blobs.read_blob, digest_of(DATA)) == DATA
    assert lab.read(blobs.read_range, digest_of(DATA), 1_048_570, 1_048_580) == DATA[1_048_570:1_048_580]
    assert lab.write(uploads.finish, upload.id) == digest_of(DATA)
    assert lab.read(uploads.read_upload, upload.id).digest == digest_of(DATA)


def test_a_piece_at_the_wrong_place_is_told_the_right_one(lab: Lab) -> None:
    upload = lab.write(uploads.create_upload, len(DATA))
    send(lab, upload.id, (1000,))
    for offset in (0, 999, 1001):
        with pytest.raises(ConflictProblem) as refused:
            lab.write(uploads.append, upload.id, offset, b"x")
        assert refused.value.context == {"offset": 1000}
    with pytest.raises(ConflictProblem):
        lab.write(uploads.finish, upload.id)


def test_the_same_piece_sent_twice_at_once_counts_once(lab: Lab) -> None:
    upload = lab.write(uploads.create_upload, len(DATA))
    futures = [lab.database.submit_write(lab.owner, uploads.append, upload.id, 0, DATA) for _ in range(4)]
    outcomes = [future.exception(60) for future in futures]
    assert sum(outcome is None for outcome in outcomes) == 1
    refused = [outcome for outcome in outcomes if isinstance(outcome, ConflictProblem)]
    assert [problem.context for problem in refused] == 3 * [{"offset": len(DATA)}]
    assert lab.write(uploads.finish, upload.id) == digest_of(DATA)


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
    with pytest.raises(InvalidProblem):
        lab.write(uploads.finish, upload.id)
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
