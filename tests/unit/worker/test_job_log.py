"""The log of a job arrives once and in order, even if requests fail."""

from pathlib import Path
from typing import cast

import pytest

from marey_client.errors import Unreachable
from marey_schemas.queue.worker_protocol import LogAnswer
from marey_worker import attempt_limits
from marey_worker.attempt_api import AttemptApi
from marey_worker.attempt_limits import LogUploader

ARRIVES, NEVER_ARRIVES, ANSWER_IS_LOST = "arrives", "never arrives", "answer is lost"


class Api:
    """Simulated server that stores a log; `fates` lists what happens to each of the next pieces of the log."""

    def __init__(self, limit: int = 1000) -> None:
        self.log = b""
        self.fates: list[str] = []
        self.pieces = 0
        self.limit = limit

    def append_log(self, offset: int, piece: bytes) -> LogAnswer:
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
def api(monkeypatch: pytest.MonkeyPatch) -> Api:
    monkeypatch.setattr(attempt_limits, "LOG_PIECE_BYTES", 10)
    return Api()


@pytest.fixture
def printed(api: Api, tmp_path: Path) -> LogUploader:
    return LogUploader(cast(AttemptApi, api), tmp_path / "log")


@pytest.mark.parametrize("fate", [NEVER_ARRIVES, ANSWER_IS_LOST])
@pytest.mark.parametrize("before", [0, 1])
def test_a_log_that_was_cut_off_goes_on_where_the_server_has_it(
    api: Api, printed: LogUploader, fate: str, before: int
) -> None:
    printed.path.write_bytes(b"0123456789abcdefghij")
    api.fates = [ARRIVES] * before + [fate]
    with pytest.raises(Unreachable):
        printed.send()
    with printed.path.open("ab") as file:
        file.write(b"and the end")
    printed.send()
    assert api.log == b"0123456789abcdefghijand the end" == printed.path.read_bytes()


def test_nothing_is_sent_to_a_log_that_is_full(api: Api, printed: LogUploader) -> None:
    api.limit = 15
    printed.path.write_bytes(b"x" * 100)
    for _ in range(3):
        printed.send()
    assert api.pieces == 2
