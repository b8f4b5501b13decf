"""Fork server: a process that loads modules once, and then forks children in which the modules are already loaded.

Loading numeric modules and compiled kernels takes two seconds of processor time and 200 MB for each process. A forked
child is ready in milliseconds and shares this memory. The fork server has only one thread, since locks that other
threads hold would stay locked in its children for ever. It never reads the messages from the parent to a child.

The parent sends `FORK`, followed by a socket for the new child. The fork server answers with the process id of the
child and `STARTED`. When the child has ended, the fork server sends the process id with the exit status. When the
parent will not signal the child any more, it sends the process id back; until then, no other process gets this id.
"""

from __future__ import annotations

import gc
import os
import signal
import socket
import struct
import sys
import threading
import time
import traceback
from collections.abc import Callable, Sequence
from contextlib import suppress
from multiprocessing.connection import Connection, wait
from multiprocessing.reduction import recv_handle
from queue import SimpleQueue

from marey_schemas.processes.child_process import (
    READY,
    TERMINATE_S,
    ChildBroken,
    ChildProcess,
    ConnectedChild,
    exit_status,
)
from marey_schemas.processes.limits import die_with_parent

FORKS = sys.platform == "linux"
"""Whether a process may be forked after it has loaded numeric libraries.

On systems other than Linux, the libraries may have started threads by then.
"""
FORK = b"fork"
STARTED = 1 << 16
"""Value that is sent instead of an exit status when a child has been started; exit statuses are smaller."""
LOST = 1 << 17
"""Value that is used as the exit status of a child whose fork server has ended."""
THREADS_END_S = 2.0
"""Longest wait in seconds for the end of the threads that a fork server uses while it loads modules.

`Thread.join` returns a moment before the system has removed the thread.
"""
NO_CHILD = -1
"""Value that is sent instead of a process id if a child could not be started."""
_NUMBER, _NUMBER_AND_STATUS = struct.Struct("<q"), struct.Struct("<qq")


class ForkServer:
    """Parent's side of a fork server, which runs `python -m module <file descriptor> <arguments>`.

    A thread of its own starts and watches the fork server, which therefore lives until it is closed or this process
    ends. Any thread may fork children.
    """

    def __init__(self, module: str, arguments: Sequence[str] = ()) -> None:
        self._command = (module, arguments)
        self._launched: SimpleQueue[Exception | None] = SimpleQueue()
        self._process: ChildProcess | None = None
        self._aborted = False
        self._forking = threading.Lock()
        self._started: SimpleQueue[int | None] = SimpleQueue()
        self._changed = threading.Condition()
        self._statuses: dict[int, int] = {}
        """Exit statuses of children that have ended and may still be signalled."""
        self._ended = False
        self._watching = threading.Thread(target=self._watch, name="marey-fork-server", daemon=True)

    def wait_until_ready(self) -> None:
        """Start the fork server, and wait until it has loaded its modules.

        Raises `ChildBroken` if the fork server ends before that, and `OSError` if the system cannot start it.
        """
        self._watching.start()
        if (error := self._launched.get()) is not None:
            raise error

    @property
    def alive(self) -> bool:
        """Whether the fork server runs, so that children can be forked."""
        return not self._ended and self._process is not None and self._process.alive

    def fork(self) -> ForkedChild:
        """Start a child, and wait until it is ready.

        Raises `ChildBroken` if the child or the fork server ends, and `OSError` if this process has no descriptor left.
        """
        assert self._process is not None, "wait_until_ready comes first"
        ours, theirs = socket.socketpair()
        try:
            with theirs, self._forking:
                self._process.send_socket(FORK, theirs)
                pid = None if self._ended else self._started.get()
            if pid is None or pid == NO_CHILD:
                raise ChildBroken(self._process.wait() if pid is None else 1)
            child = ForkedChild(self, pid, ours)
        except BaseException:
            ours.close()
            raise
        try:
            child.wait_until_ready()
        except ChildBroken:
            child.kill(grace_s=0.0)
            raise
        return child

    def status_of(self, pid: int, timeout_s: float | None = None) -> int | None:
        """Return the exit status of a child; None if the child still runs after `timeout_s` (None: without limit)."""
        with self._changed:
            self._changed.wait_for(lambda: self._ended or pid in self._statuses, timeout_s)
            return self._statuses.get(pid, LOST if self._ended else None)

    @property
    def has_ended(self) -> bool:
        """Whether the fork server has ended, so that the system may use the process ids of its children again."""
        return self._ended

    def release(self, pid: int) -> None:
        """Let the system use the process id of an ended child again."""
        with self._changed:
            known = self._statuses.pop(pid, None) is not None
        if known and self._process is not None:
            self._process.send(_NUMBER.pack(pid))

    def abort(self) -> None:
        """Kill the fork server and all its children at once."""
        self._aborted = True
        if self._process is not None:
            self._process.abort()

    def close(self) -> None:
        """Kill the fork server, and with it all its children."""
        self.abort()
        if self._watching.ident is not None:
            self._watching.join()

    def _watch(self) -> None:
        """Start the fork server, receive process ids and exit statuses of children, and finally reap the server."""
        module, arguments = self._command
        try:
            process = self._process = ChildProcess(module, arguments, threads=1, at_most=True)
            if self._aborted:
                process.abort()
            process.wait_until_ready()
        except (ChildBroken, OSError) as error:
            self._end()
            self._launched.put(error)
            return
        self._launched.put(None)
        self._read(process)
        self._end()
        process.kill(grace_s=0.0)

    def _end(self) -> None:
        with self._changed:
            self._ended = True
            self._changed.notify_all()
        self._started.put(None)

    def _read(self, process: ChildProcess) -> None:
        """Receive the process ids and exit statuses of children until the fork server ends."""
        with suppress(EOFError, OSError):
            while (message := process.receive()) is not None:
                pid, status = _NUMBER_AND_STATUS.unpack(message)
                if status == STARTED:
                    self._started.put(pid)
                    continue
                with self._changed:
                    self._statuses[pid] = status
                    self._changed.notify_all()


class ForkedChild(ConnectedChild):
    """Child of a fork server."""

    def __init__(self, server: ForkServer, pid: int, connected: socket.socket) -> None:
        super().__init__(connected)
        self._server = server
        self._pid = pid
        self._status: int | None = None
        self._released = False

    @property
    def pid(self) -> int:
        """The process id."""
        return self._pid

    @property
    def alive(self) -> bool:
        """Whether the process is running."""
        if self._status is None:
            self._status = self._server.status_of(self._pid, 0.0)
        return self._status is None

    def wait(self) -> int:
        """Return the exit status of the process; a negative number is a signal."""
        if self._status is None:
            self._status = self._server.status_of(self._pid)
        assert self._status is not None
        return self._status

    def kill(self, *, grace_s: float = TERMINATE_S) -> None:
        """End the process and its descendants, by SIGTERM and after `grace_s` seconds by SIGKILL; close its pipe."""
        if not self._released:
            super().kill(grace_s=grace_s)

    def _signal(self, number: signal.Signals) -> None:
        """Send a signal to the session of the process, or to the process alone if it has no session yet."""
        if self._released or self._server.has_ended:
            return
        try:
            os.killpg(self._pid, number)
        except ProcessLookupError:
            with suppress(ProcessLookupError):
                os.kill(self._pid, number)

    def _close(self) -> None:
        super()._close()
        self._released = True
        self._server.release(self._pid)


def require_one_thread() -> None:
    """Wait until all other threads of this process have ended. Raises `RuntimeError` after `THREADS_END_S`."""
    deadline = time.monotonic() + THREADS_END_S
    while (threads := len(os.listdir("/proc/self/task"))) > 1:
        if time.monotonic() > deadline:
            raise RuntimeError(f"only a process with one thread may fork others, but this process has {threads}")
        time.sleep(0.002)


def fork_children(pipe: Connection, serve: Callable[[Connection], None]) -> None:
    """Fork a child for each socket that the parent sends, until the parent closes the pipe; `serve` runs in the child.

    Raises `RuntimeError` if this process keeps more than one thread.
    """
    require_one_thread()
    woken, wake = socket.socketpair()
    woken.setblocking(False)
    wake.setblocking(False)
    signal.signal(signal.SIGCHLD, lambda *_: None)
    signal.set_wakeup_fd(wake.fileno(), warn_on_full_buffer=False)
    gc.collect()
    gc.freeze()  # else the first collection of each child would copy the memory that it shares
    running: set[int] = set()
    while True:
        ready = wait([pipe, woken])
        if woken in ready:
            woken.recv(4096)
        if pipe in ready:
            try:
                running |= _carry_out(pipe, serve, (woken, wake))
            except EOFError:
                return
        for pid in [*running]:
            if (status := exit_status(pid)) is not None:
                running.discard(pid)
                pipe.send_bytes(_NUMBER_AND_STATUS.pack(pid, status))


def _carry_out(
    pipe: Connection, serve: Callable[[Connection], None], others: tuple[socket.socket, socket.socket]
) -> set[int]:
    """Read one message of the parent, and fork a child or release the process id of an ended child.

    Returns a set with the process id of the new child, or an empty set. A new child closes `others`, the sockets that
    only the fork server needs. Raises `EOFError` if the parent has closed the pipe.
    """
    order = pipe.recv_bytes()
    if order != FORK:
        os.waitpid(_NUMBER.unpack(order)[0], 0)
        return set()
    with socket.socket(fileno=recv_handle(pipe)) as connected:
        try:
            pid = os.fork()
        except OSError:  # the system has no memory or process left; other children go on
            with suppress(OSError, ValueError):
                traceback.print_exc()
            pid = NO_CHILD
        if pid == 0:
            _run_child(serve, connected, (pipe, *others))
    pipe.send_bytes(_NUMBER_AND_STATUS.pack(pid, STARTED))
    return {pid} - {NO_CHILD}


def _run_child(
    serve: Callable[[Connection], None], connected: socket.socket, others: Sequence[Connection | socket.socket]
) -> None:
    """Run `serve` in the forked child, then end the process; never returns."""
    status = 1
    try:
        signal.set_wakeup_fd(-1)
        signal.signal(signal.SIGCHLD, signal.SIG_DFL)
        die_with_parent()
        os.setsid()
        for other in others:
            other.close()
        pipe = Connection(connected.detach())
        pipe.send_bytes(READY)  # only now can the parent signal the session of this process
        serve(pipe)
        status = 0
    except BaseException:  # noqa: BLE001 - nothing may return into the fork server's code
        traceback.print_exc()
    finally:
        try:
            sys.stdout.flush()
            sys.stderr.flush()
        finally:
            os._exit(status)
