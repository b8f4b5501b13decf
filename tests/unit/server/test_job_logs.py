"""Logs of attempts: appended by offset, read as one text."""

import pytest
from tests.support.queue_desk import Desk

from marey_schemas.queue.worker_protocol import Lease, LogAnswer
from marey_server.errors import LeaseLostProblem
from marey_server.store.jobs import logs, reading
from marey_server.store.jobs.logs import LogOffset, LogPage
from marey_server.store.jobs.policy import QueuePolicy


def append(desk: Desk, lease: Lease, offset: int, data: bytes) -> LogAnswer:
    return desk.database.write(
        desk._attempt_of(lease), logs.append_log, lease.job, lease.fence, offset, data, desk.policy
    )


def read(desk: Desk, job: str, offset: int = 0, limit: int = 1000) -> LogPage:
    return desk.database.read(desk.user, reading.read_job_log, job, offset, limit)


def test_pieces_are_added_one_behind_the_other(desk: Desk) -> None:
    job = desk.submit()
    lease = desk.claim()
    assert append(desk, lease, 0, b"one\n").offset == 4
    assert append(desk, lease, 4, b"two\n").offset == 8
    assert append(desk, lease, 8, b"").offset == 8
    assert read(desk, job) == LogPage(b"one\ntwo\n", 8, sealed=False)


def test_a_piece_that_comes_twice_is_kept_once(desk: Desk) -> None:
    job = desk.submit()
    lease = desk.claim()
    append(desk, lease, 0, b"one\n")
    append(desk, lease, 4, b"two\n")
    assert append(desk, lease, 0, b"one\n").offset == 8
    assert append(desk, lease, 4, b"two\n").offset == 8
    assert read(desk, job).data == b"one\ntwo\n"


@pytest.mark.parametrize(("offset", "data"), [(3, b"x"), (9, b"x"), (0, b"other")])
def test_a_piece_at_the_wrong_place_is_refused_with_the_right_one(desk: Desk, offset: int, data: bytes) -> None:
    desk.submit()
    lease = desk.claim()
    append(desk, lease, 0, b"one\n")
    with pytest.raises(LogOffset) as refused:
        append(desk, lease, offset, data)
    assert refused.value.context == {"offset": 4}


def test_the_log_of_a_job_is_that_of_its_attempts_in_order_and_sealed_at_the_end(desk: Desk) -> None:
    job = desk.submit()
    first = desk.claim()
    append(desk, first, 0, b"first\n")
    desk.fail(first)
    with pytest.raises(LeaseLostProblem):
        append(desk, first, 6, b"late")
    desk.clock.advance(11)
    second = desk.claim()
    append(desk, second, 0, b"sec")
    append(desk, second, 3, b"ond\n")
    assert read(desk, job) == LogPage(b"first\nsecond\n", 13, sealed=False)
    desk.complete(second)
    assert read(desk, job) == LogPage(b"first\nsecond\n", 13, sealed=True)
    assert read(desk, job, 4, 5) == LogPage(b"t\nsec", 9, sealed=False)
    assert read(desk, job, 9) == LogPage(b"ond\n", 13, sealed=True)
    assert read(desk, job, 99) == LogPage(b"", 13, sealed=True)


def test_a_log_that_is_full_says_so_and_stops_the_attempt_from_nothing(desk: Desk) -> None:
    desk.policy = QueuePolicy(log_limit_bytes=10)
    job = desk.submit()
    lease = desk.claim()
    append(desk, lease, 0, b"1234567")
    answer = append(desk, lease, 7, b"89abcdef")
    assert answer.capped
    assert append(desk, lease, answer.offset, b"more") == answer
    assert read(desk, job).data == b"123456789a" + logs.CAPPED
    desk.complete(lease)
