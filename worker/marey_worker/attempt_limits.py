"""Limits of an attempt (lease, time, memory and size of the log), and the upload of its log."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass
from enum import Enum
from pathlib import Path

from marey_schemas.processes.child_process import ChildProcess
from marey_schemas.queue.worker_protocol import Lease
from marey_schemas.sizes import MIB
from marey_worker.attempt_api import AttemptApi
from marey_worker.heartbeats import LeaseKeeper

LOG_PIECE_BYTES = 256 << 10
LOG_LIMIT_BYTES = 64 * MIB
WEIGH_EVERY_S = 0.5


class LogUploader:
    """Upload of the file that contains the output of a job.

    The attempt's log on the server is a prefix of this file. The server returns the length of the log, which is the
    offset of the next bytes to send, even if earlier answers were lost.
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
        """The number of bytes that the job has printed so far."""
        return self.path.stat().st_size

    def send(self) -> None:
        """Send new output unless the log on the server is full. Raises `OSError`, and errors of the client library."""
        with self._sending, self.path.open("rb") as file:
            while not self._full:
                file.seek(self._sent)
                piece = file.read(LOG_PIECE_BYTES)
                if not piece:
                    return
                answer = self._api.append_log(self._sent, piece)
                self._sent, self._full = answer.offset, answer.capped


class Stop(Enum):
    """Reason to stop an attempt."""

    LEASE_LOST = "lease-lost"
    CANCELLED = "cancelled"
    INTERRUPTED = "interrupted"
    TIME = "time-limit"
    MEMORY = "memory-limit"
    LOG = "log-limit"


@dataclass
class Watch:
    """Watch over the limits of one attempt: lease, time, memory, and size of the log."""

    lease: Lease
    keeper: LeaseKeeper
    stopping: threading.Event
    job_log: LogUploader
    started: float
    weighed: float = 0.0

    def reason_to_stop(self, child: ChildProcess | None) -> Stop | None:
        """Return the reason to stop the attempt now, or None if there is none.

        `child` is the child process that computes, or None after it has computed all results.
        """
        if self.keeper.lost.is_set():
            return Stop.LEASE_LOST
        if self.keeper.cancelled.is_set():
            return Stop.CANCELLED
        if self.stopping.is_set():
            return Stop.INTERRUPTED
        if time.monotonic() - self.started > self.lease.resources.time_limit_s:
            return Stop.TIME
        if child is not None and time.monotonic() - self.weighed > WEIGH_EVERY_S:
            self.weighed = time.monotonic()
            if child.resident_bytes > self.lease.resources.memory_limit_mb * MIB:
                return Stop.MEMORY
        if self.job_log.size_bytes > LOG_LIMIT_BYTES:
            return Stop.LOG
        return None

    def explain(self, stop: Stop) -> str:
        """Return a text that gives the reason for stopping, with the limit that was exceeded."""
        resources = self.lease.resources
        return {
            Stop.LEASE_LOST: "the lease was lost",
            Stop.CANCELLED: "the job was cancelled",
            Stop.INTERRUPTED: "the worker is being stopped",
            Stop.TIME: f"the job ran longer than its time limit of {resources.time_limit_s} s",
            Stop.MEMORY: f"the job needs more memory than its limit of {resources.memory_limit_mb} MiB",
            Stop.LOG: f"the job's log grew beyond its limit of {LOG_LIMIT_BYTES // MIB} MiB",
        }[stop]
