"""Child processes of forked programs, which are forked, too.

A child that computes needs two seconds of processor time to import its modules and to load compiled kernels, and tests
that kill servers and workers start hundreds of such children. So each program of the nursery (see `forked_programs`)
has a forker: a copy of the nursery with one thread, which forks the children of the program. A child has the arguments,
the environment, the session and the descriptor that a new process would have, and its parent is the program.
"""

from __future__ import annotations

import ctypes
import importlib
import json
import os
import signal
import socket
import struct
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from typing import NoReturn

from marey_schemas.processes import child_process
from marey_schemas.processes.child_process import exit_status
from marey_schemas.processes.limits import die_with_parent

FORKS = sys.platform == "linux"
"""Whether the system has what a forker needs: a process that adopts the orphans among its descendants."""
KERNELS = "marey_server.motions.reading"
"""Module that loads the compiled kernels."""
MODULES = ("marey_worker.child", "marey_server.motions.child", KERNELS)
"""Modules that children run or load first."""
LONGEST_ORDER = 1 << 16
"""Greatest size of an order, in bytes; it contains all environment variables."""
_PR_SET_CHILD_SUBREAPER = 36
PID = struct.Struct("<q")
"""Form of a process id in answers to orders."""


class ForkedChild:
    """A child that a forker has forked, with what `ChildProcess` needs of a `subprocess.Popen`."""

    def __init__(self, pid: int) -> None:
        self.pid = pid
        self.returncode: int | None = None

    def poll(self) -> int | None:
        """Return the exit status, or None if the process still runs; a negative number is a signal."""
        if self.returncode is None and exit_status(self.pid) is not None:
            self.wait()
        return self.returncode

    def wait(self) -> int:
        """Return the exit status when the process has ended."""
        if self.returncode is None:
            self.returncode = os.waitstatus_to_exitcode(os.waitpid(self.pid, 0)[1])
        return self.returncode


class ChildForker:
    """The process that forks the children of this process, which must have only one thread when it makes the forker."""

    def __init__(self) -> None:
        self._orders, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._ordering = threading.Lock()
        parent = os.getpid()
        if os.fork() == 0:
            _keep_only(theirs.fileno())
            die_with_parent()
            signal.signal(signal.SIGTERM, signal.SIG_IGN)  # a test may send it to all descendants of its program
            _serve(theirs, parent)
        theirs.close()

    def start(
        self, module: str, arguments: Sequence[str], descriptor: int, environment: Mapping[str, str]
    ) -> ForkedChild:
        """Start a child as `child_process.start_module` does."""
        order = json.dumps({"module": module, "arguments": arguments, "environment": dict(environment)}).encode()
        assert len(order) < LONGEST_ORDER
        with self._ordering:
            _adopt_orphans(True)
            try:
                socket.send_fds(self._orders, [order], [descriptor])
                answer = self._orders.recv(PID.size)
            finally:
                _adopt_orphans(False)
        if not answer:
            raise RuntimeError("the forker has ended; the log of the program says why")
        return ForkedChild(PID.unpack(answer)[0])


def fork_children() -> None:
    """Let a forker fork the children of this process from now on."""
    child_process.start_module = ChildForker().start  # pyrefly: ignore[bad-assignment]  # does what a `Child` does here


def _adopt_orphans(adopts: bool) -> None:
    if ctypes.CDLL(None).prctl(_PR_SET_CHILD_SUBREAPER, int(adopts), 0, 0, 0) != 0:
        raise OSError("the system does not let this process adopt orphans")


def _keep_only(*descriptors: int) -> None:
    """Close all other descriptors but those of the output, and take the standard input from nowhere."""
    nothing = os.open(os.devnull, os.O_RDONLY)
    os.dup2(nothing, 0)
    kept = sorted({0, 1, 2, *descriptors})
    for after, before in zip(kept, [*kept[1:], os.sysconf("SC_OPEN_MAX")], strict=True):
        os.closerange(after + 1, before)


def _serve(orders: socket.socket, parent: int) -> NoReturn:
    """Fork the children that the parent orders, until the kernel ends this process with its parent.

    A child is forked twice: when the process between has ended, the parent adopts the child.
    """
    while True:
        order, descriptors, _, _ = socket.recv_fds(orders, LONGEST_ORDER, 1)
        if not order:
            os._exit(0)
        between = os.fork()
        if between == 0:
            between = os.getpid()
            if os.fork() != 0:
                os._exit(0)
            while os.getppid() == between:
                time.sleep(0.0002)
            if os.getppid() != parent:  # the parent was killed, and another process has adopted this one
                os._exit(1)
            os.setsid()
            signal.signal(signal.SIGTERM, signal.SIG_DFL)
            orders.send(PID.pack(os.getpid()))
            _keep_only(*descriptors)
            _run(descriptors[0], **json.loads(order))
        os.close(descriptors[0])
        os.waitpid(between, 0)


def _run(descriptor: int, module: str, arguments: list[str], environment: dict[str, str]) -> NoReturn:
    from tests.support.forked_programs import take_on

    take_on(environment)
    sys.argv = [module, str(descriptor), *arguments]
    importlib.import_module(module).main()
    sys.exit()
