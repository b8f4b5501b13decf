"""What a job prints arrives once and in order, whatever happens on the way."""

import pytest

from marey_client.errors import Unreachable
from marey_schemas.worker_protocol import LogAnswer
from marey_worker import attempt
from marey_worker.attempt import LogUploader

ARRIVES, NEVER_ARRIVES, ANSWER_IS_LOST = "arrives", "never arrives", "answer is lost"


class Api:
    """Keeps a log as the server does; `fates` says what becomes of the next pieces."""

    def __init__(self, limit=1000):
        self.log = b""
        self.fates = []
        self.pieces = 0
        self.limit = limit

    def append_log(self, offset, piece):
        self.pieces += 1
        fate = self.fates.pop(0) if self.fates else ARRIVES
        if fate == NEVER_ARRIVES:
            raise Unreachable("away")
        if offset == len(self.log):
            self.log += piece
        if fate == ANSWER_IS_LOST:
            raise Unreachable("away")
        return LogAnswer(offset=len(self.log), capped=len(self.log) >= self.limit)


@pytest.fixture
def api(monkeypatch):
    monkeypatch.setattr(attempt, "LOG_PIECE_BYTES", 10)
    return Api()


@pytest.fixture
def printed(api, tmp_path):
    return LogUploader(api, tmp_path / "log")


@pytest.mark.parametrize("fate", [NEVER_ARRIVES, ANSWER_IS_LOST])
@pytest.mark.parametrize("before", [0, 1])
def test_a_log_that_was_cut_off_goes_on_where_the_server_has_it(api, printed, fate, before):
    printed.path.write_bytes(b"0123456789abcdefghij")
    api.fates = [ARRIVES] * before + [fate]
    with pytest.raises(Unreachable):
        printed.send()
    with printed.path.open("ab") as file:
        file.write(b"and the end")
    printed.send()
    assert api.log == b"0123456789abcdefghijand the end" == printed.path.read_bytes()


def test_nothing_is_sent_to_a_log_that_is_full(api, printed):
    api.limit = 15
    printed.path.write_bytes(b"x" * 100)
    for _ in range(3):
        printed.send()
    assert api.pieces == 2
