"""Child process from the supervisor's side: start, messages, kill."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from multiprocessing.connection import Connection
from typing import Any

from marey_worker import signatures
from marey_worker.limits import resident_bytes
from marey_worker.messages import Ready

TERMINATE_S = 10.0
READY_S = 60.0
THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")


class ChildBroken(Exception):
    """Child process that died before it was given a job."""


class ChildProcess:
    """Child process in its own session. One thread starts, uses and kills it; other threads may send replies."""

    def __init__(self, kinds: Sequence[str], *, threads: int) -> None:
        ours, theirs = socket.socketpair()
        with theirs:
            self._process = subprocess.Popen(  # noqa: S603 - our own interpreter and module
                [sys.executable, "-m", "marey_worker.child", str(theirs.fileno()), *kinds],
                pass_fds=[theirs.fileno()],
                stdin=subprocess.DEVNULL,
                start_new_session=True,
                env={**os.environ, **{name: os.environ.get(name, str(threads)) for name in THREAD_VARIABLES}},
            )
        self._pipe = Connection(ours.detach())
        self._sending = threading.Lock()

    def wait_until_ready(self) -> None:
        """Wait until the child has loaded its modules. Raises `ChildBroken` if it dies before."""
        try:
            while not isinstance(self.receive(READY_S), Ready):
                continue
        except EOFError as error:
            raise ChildBroken(signatures.told_exit(self.wait())) from error

    @property
    def pid(self) -> int:
        """The process id."""
        return self._process.pid

    @property
    def alive(self) -> bool:
        """Whether the process is running."""
        return self._process.poll() is None

    @property
    def resident_bytes(self) -> int:
        """Return the memory of the process and its descendants."""
        return resident_bytes(self.pid)

    def send(self, message: Any) -> None:
        """Send a message; if the child has died, the next `receive` reports it."""
        with self._sending:
            try:
                self._pipe.send(message)
            except (BrokenPipeError, ConnectionResetError):
                return

    def receive(self, timeout_s: float) -> Any | None:
        """Return the next message, or None if none came in time. Raises `EOFError` if the child has died."""
        try:
            return self._pipe.recv() if self._pipe.poll(timeout_s) else None
        except ConnectionResetError as error:
            raise EOFError from error

    def wait(self) -> int:
        """Return the exit status of the process; a negative number is a signal."""
        return self._process.wait()

    def kill(self, *, grace_s: float = TERMINATE_S) -> None:
        """End the process and its descendants: by SIGTERM, and after `grace_s` by SIGKILL."""
        if self.alive:
            self._signal(signal.SIGTERM)
            deadline = time.monotonic() + grace_s
            while self.alive and time.monotonic() < deadline:
                time.sleep(0.02)
        self._signal(signal.SIGKILL)
        self._process.wait()
        self._pipe.close()

    def _signal(self, number: signal.Signals) -> None:
        try:
            os.killpg(self.pid, number)
        except ProcessLookupError:
            return
