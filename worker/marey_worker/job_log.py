"""What a job prints, carried to the server while it runs."""

from __future__ import annotations

import threading
from pathlib import Path

from marey_worker.attempt_api import AttemptApi

PIECE_BYTES = 256 << 10


class JobLog:
    """The file a job prints to, and how much of it the server has.

    The log of the attempt is this file from its start, so that the server's word how long it is tells where to go on,
    whatever became of earlier answers.
    """

    def __init__(self, api: AttemptApi, path: Path) -> None:
        self.path = path
        self.path.touch(mode=0o600)
        self._api = api
        self._sent = 0
        self._full = False
        self._sending = threading.Lock()

    @property
    def size_bytes(self) -> int:
        """How much was printed so far."""
        return self.path.stat().st_size

    def send(self) -> None:
        """Send what is new, unless the server keeps no more. Raises what the server answers, and `OSError`."""
        with self._sending, self.path.open("rb") as file:
            while not self._full:
                file.seek(self._sent)
                piece = file.read(PIECE_BYTES)
                if not piece:
                    return
                answer = self._api.append_log(self._sent, piece)
                self._sent, self._full = answer.offset, answer.capped
