"""Execution of an attempt while the server answers some requests late."""

import threading
import time
from pathlib import Path
from typing import Any, cast

import pytest

from marey_schemas.processes.child_process import ChildProcess
from marey_schemas.queue.jobs import Progress, Resources
from marey_schemas.queue.worker_protocol import (
    CompleteRequest,
    FailRequest,
    HeartbeatAnswer,
    Lease,
    LogAnswer,
)
from marey_worker import attempt
from marey_worker.attempt import RunningAttempt
from marey_worker.attempt_api import AttemptApi
from marey_worker.job_io.input_cache import InputCache
from marey_worker.messages import ChildReply, Done, ReadBlob, Run, pack, unpack

LEASE = Lease(
    job="job_1", project="lab", kind="import", params={}, inputs={}, into="", seed=0, resources=Resources(), fence=1,
    attempt=1, attempt_token="t", lease_ttl_s=60.0, heartbeat_s=15.0,
)  # fmt: skip
PATIENCE_S = 30.0


class Api:
    """Simulated server that answers the upload of a log only after `logs` is set."""

    def __init__(self) -> None:
        self.logs = threading.Event()
        self.asked = threading.Event()
        self.log = b""
        self.uploads = 0
        self.completed: list[CompleteRequest] = []

    def heartbeat(self, progress: Progress | None, *, patiently: bool = False) -> HeartbeatAnswer:
        return HeartbeatAnswer(lease_ttl_s=60.0, cancel_requested=False)

    def append_log(self, offset: int, piece: bytes) -> LogAnswer:
        self.uploads += 1
        self.asked.set()
        assert self.logs.wait(2 * PATIENCE_S)
        self.log = self.log[:offset] + piece
        return LogAnswer(offset=len(self.log))

    def read_blob(self, digest: str, most_bytes: int) -> bytes:
        return b"bytes of the blob"

    def complete(self, request: CompleteRequest) -> None:
        self.completed.append(request)

    def fail(self, request: FailRequest) -> None:
        raise AssertionError(request)


class Child:
    """Simulated child that prints until its log is being uploaded, then reads a blob, and then ends."""

    def __init__(self, rounds: int, uploading: threading.Event) -> None:
        self.rounds = rounds
        self.uploading = uploading
        self.asked = 0.0
        self.replies: list[Any] = []
        self.log: Path | None = None
        self.resident_bytes = 0

    def send(self, data: bytes) -> None:
        message = unpack(data)
        if isinstance(message, Run):
            self.log = message.log_path
        else:
            self.replies.append(message)

    def receive(self, timeout_s: float) -> bytes | None:
        assert self.log is not None
        if self.rounds:
            self.rounds -= 1
            with self.log.open("ab") as file:
                file.write(b"a line\n")
            return None
        if not self.asked:
            assert self.uploading.wait(PATIENCE_S)
            self.asked = time.monotonic()
            return pack(ReadBlob(1, "sha256:0"))
        if self.replies or time.monotonic() - self.asked > PATIENCE_S:
            return pack(Done({}))
        time.sleep(0.01)
        return None


def test_inputs_are_read_while_the_server_does_not_take_the_log(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(attempt, "LOG_EVERY_S", 0.0)
    api = Api()
    child = Child(20, api.asked)
    cache = InputCache(tmp_path, 1 << 20)
    running = RunningAttempt(cast(AttemptApi, api), LEASE, cache, "here", threading.Event(), threads=1)
    end = running.run(cast(ChildProcess, child))
    assert child.replies == [ChildReply(1, b"bytes of the blob")]
    assert api.uploads == 1
    api.logs.set()
    assert running.finish(end) == Done({})
    assert len(api.completed) == 1
    assert api.log == b"a line\n" * 20
