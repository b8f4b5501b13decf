"""Child process: its start in an environment without secrets, its messages, and its termination.

A message consists of its length and a sequence of bytes, whose meaning parent and child define. `pickle` is not used,
because a child that reads untrusted files may have been taken over by an attacker and could send anything.
"""

from __future__ import annotations

import faulthandler
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Sequence
from contextlib import suppress
from multiprocessing.connection import Connection

from marey_schemas.processes.environment import clean_environment, thread_limits
from marey_schemas.processes.limits import die_with_parent, resident_bytes

READY = b"ready"
"""First message of a child, after it has loaded its modules."""
READY_S = 300.0
"""Longest wait in seconds for `READY`; after an installation, the child may have to compile its modules first."""
TERMINATE_S = 10.0
WAIT_EVERY_S = 0.005
"""Seconds between two checks whether the child process has ended, while the parent waits for its end."""
MOST_MESSAGE_BYTES = 1 << 30
ONE_DESCRIPTOR = b"\x01"
"""Message that accompanies a file descriptor sent to a child, as `multiprocessing.reduction.recv_handle` expects it."""


class ChildBroken(Exception):
    """A child process ended before it was ready; `status` is its exit status, a negative number for a signal."""

    def __init__(self, status: int) -> None:
        super().__init__(f"a child process ended with status {status} before it was ready; its log says why")
        self.status = status


class BadMessage(Exception):
    """The received bytes are not a valid message."""


class ConnectedChild(ABC):
    """Child process in a session of its own; parent and child exchange messages through a socket.

    Only one thread may receive messages, kill the process and close it; other threads may send messages and abort it.
    """

    def __init__(self, connected: socket.socket) -> None:
        self._socket = connected
        self._pipe = Connection(os.dup(connected.fileno()))
        self._sending = threading.Lock()

    @property
    @abstractmethod
    def pid(self) -> int:
        """The process id."""

    @property
    @abstractmethod
    def alive(self) -> bool:
        """Whether the process is running."""

    @abstractmethod
    def wait(self) -> int:
        """Return the exit status of the process; a negative number is a signal."""

    def wait_until_ready(self) -> None:
        """Wait until the child has loaded its modules.

        Raises `ChildBroken` if the child ends before that, or is killed because it takes longer than `READY_S`.
        """
        deadline = time.monotonic() + READY_S
        try:
            while self.receive(max(0.0, deadline - time.monotonic())) != READY:
                if time.monotonic() > deadline:
                    self.kill(grace_s=0.0)
                    raise EOFError
        except (EOFError, OSError) as error:
            raise ChildBroken(self.wait()) from error

    @property
    def resident_bytes(self) -> int:
        """The resident memory of the process and its descendants, in bytes."""
        return resident_bytes(self.pid)

    def send(self, message: bytes) -> None:
        """Send a message; no effect if the child has died: `receive` then raises an error after its last message."""
        with self._sending:
            if self._pipe.closed:
                return
            try:
                self._pipe.send_bytes(message)
            except (BrokenPipeError, ConnectionResetError):
                return

    def send_socket(self, message: bytes, passed: socket.socket) -> None:
        """Send a message and then a socket, which the child receives by `recv_handle`.

        If sending fails, the child is killed, because it would wait for the socket. `receive` then raises an error
        after the last message of the child.
        """
        with self._sending:
            try:
                self._pipe.send_bytes(message)
                socket.send_fds(self._socket, [ONE_DESCRIPTOR], [passed.fileno()])
            except OSError:
                self.abort()

    def receive(self, timeout_s: float | None = None) -> bytes | None:
        """Return the next message, or None if there is none within `timeout_s`; without a timeout, wait for it.

        Raises `EOFError` if the child has died, and `OSError` if the message is too long.
        """
        try:
            return self._pipe.recv_bytes(MOST_MESSAGE_BYTES) if self._pipe.poll(timeout_s) else None
        except ConnectionResetError as error:
            raise EOFError from error

    def kill(self, *, grace_s: float = TERMINATE_S) -> None:
        """End the process and its descendants, by SIGTERM and after `grace_s` seconds by SIGKILL; close its pipe."""
        if self.alive and grace_s > 0:
            self._signal(signal.SIGTERM)
            deadline = time.monotonic() + grace_s
            while self.alive and time.monotonic() < deadline:
                time.sleep(0.02)
        self._signal(signal.SIGKILL)
        self.wait()
        self._close()

    def _close(self) -> None:
        """Close the pipe and the socket, once no other thread is sending a message.

        Otherwise, the system could give the descriptor of the pipe to a new file while another thread still writes to
        the descriptor.
        """
        with suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)  # ends a `send` that waits for room
        with self._sending:
            self._pipe.close()
            self._socket.close()

    def abort(self) -> None:
        """Kill the process at once, from any thread; `receive` raises an error after the last message of the child."""
        if self.alive:
            self._signal(signal.SIGKILL)

    def _signal(self, number: signal.Signals) -> None:
        try:
            os.killpg(self.pid, number)
        except ProcessLookupError:
            return


class ChildProcess(ConnectedChild):
    """Child that runs `python -m module <file descriptor> <arguments>`; it is killed when the thread that started it
    ends.
    """

    def __init__(self, module: str, arguments: Sequence[str] = (), *, threads: int, at_most: bool = False) -> None:
        """Start the process, with `threads` threads for numeric libraries.

        If the environment of this process sets a number of threads, such as `OMP_NUM_THREADS`, the child uses that
        number, unless `at_most` is true.
        """
        self._reaping = threading.Lock()
        ours, theirs = socket.socketpair()
        with theirs:
            environment = clean_environment(threads=threads) | (thread_limits(threads) if at_most else {})
            self._process = start_module(module, arguments, theirs.fileno(), environment)
        super().__init__(ours)

    @property
    def pid(self) -> int:
        """The process id."""
        return self._process.pid

    @property
    def alive(self) -> bool:
        """Whether the process is running."""
        return self._status() is None

    def wait(self) -> int:
        """Return the exit status of the process; a negative number is a signal."""
        while (status := self._status()) is None:
            time.sleep(WAIT_EVERY_S)
        return status

    def close(self) -> None:
        """Kill the process at once."""
        self.kill(grace_s=0.0)

    def _status(self) -> int | None:
        """Return the exit status of the process, and None while it is running.

        On Linux, an ended process keeps its process id until `_close`, so that its descendants can still be killed.
        """
        with self._reaping:
            if sys.platform == "linux" and self._process.returncode is None:
                return exit_status(self.pid)
            return self._process.poll()

    def _signal(self, number: signal.Signals) -> None:
        """Send a signal to the session of the process, unless its process id may belong to another process by now."""
        with self._reaping:
            if self._process.returncode is None:
                super()._signal(number)

    def _close(self) -> None:
        super()._close()
        with self._reaping:
            self._process.wait()


def start_module(
    module: str, arguments: Sequence[str], descriptor: int, environment: dict[str, str]
) -> subprocess.Popen[bytes]:
    """Start `python -m module <descriptor> <arguments>` in a session of its own; it inherits the descriptor."""
    return subprocess.Popen(  # noqa: S603 - our own interpreter and module
        [sys.executable, "-m", module, str(descriptor), *arguments],
        pass_fds=[descriptor],
        stdin=subprocess.DEVNULL,
        start_new_session=True,
        env=environment,
    )


def exit_status(pid: int) -> int | None:
    """Return the exit status of a child process, or None if it has not ended; a negative number is a signal.

    The system does not give the process id to another process until the caller waits for the child.
    """
    ended = os.waitid(os.P_PID, pid, os.WEXITED | os.WNOHANG | os.WNOWAIT)
    if ended is None:
        return None
    return ended.si_status if ended.si_code == os.CLD_EXITED else -ended.si_status


def connect_to_parent() -> Connection:
    """Return the pipe to the parent; the first argument of this process is the pipe's file descriptor.

    From then on, this process ends with its parent, ignores SIGINT, and prints a traceback if it crashes.
    """
    die_with_parent()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C at a terminal reaches the parent, which decides
    faulthandler.enable()
    return Connection(int(sys.argv[1]))
