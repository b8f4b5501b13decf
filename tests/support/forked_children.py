"""Child processes of forked programs, which are forked, too.

A child that computes needs two seconds of processor time to import its modules and to load compiled kernels, and tests
that kill servers and workers start hundreds of such children. So each program of the nursery (see `forked_programs`)
has a forker: a copy of the nursery with one thread, which forks the children of the program, and the programs that it
starts: the workers of a server, and the processes that share a port. A child has the arguments, the environment, the
session and the descriptors that a new process would have, and its parent is the program.
"""

from __future__ import annotations

import asyncio
import ctypes
import fcntl
import importlib
import json
import os
import runpy
import signal
import socket
import struct
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from io import FileIO
from typing import NoReturn

from tests.support.awaited_programs import AwaitedProgram

from marey_schemas.processes import child_process
from marey_schemas.processes.child_process import exit_status
from marey_schemas.processes.limits import die_with_parent
from marey_schemas.queue.worker_protocol import FAULT_VARIABLE
from marey_server import faults
from marey_server.process import programs

FORKS = sys.platform == "linux"
"""Whether a process of this system can adopt the orphans among its descendants, as a forker needs it."""
KERNELS = "marey_server.motions.reading"
"""Module that loads the compiled kernels."""
MODULES = ("marey_worker.child", "marey_server.motions.child", KERNELS)
"""Modules that children run or load first."""
LONGEST_ORDER = 1 << 16
"""Greatest size of an order, in bytes; it contains all environment variables."""
_PR_SET_CHILD_SUBREAPER = 36
PID = struct.Struct("<q")
"""Form of a process id in answers to orders."""
MOST_DESCRIPTORS = 8
LONGEST_NAME = 4096
"""Number of bytes in which the arguments of a forked process must fit."""
FORKER = "forker"
"""Text that `/proc` shows as the only argument of a forker."""


class ForkedChild:
    """A child that a forker has forked, with those methods of `subprocess.Popen` that `ChildProcess` uses."""

    def __init__(self, pid: int) -> None:
        self.pid = pid
        self.returncode: int | None = None
        self._descriptor: int | None = None

    def poll(self) -> int | None:
        """Return the exit status, or None if the process still runs; a negative number is a signal."""
        if self.returncode is None and exit_status(self.pid) is not None:
            self.wait()
        return self.returncode

    def wait(self) -> int:
        """Return the exit status when the process has ended."""
        if self.returncode is None:
            self.returncode = os.waitstatus_to_exitcode(os.waitpid(self.pid, 0)[1])
            if self._descriptor is not None:
                os.close(self._descriptor)
        return self.returncode

    def fileno(self) -> int:
        """Return a descriptor that can be read from when the process has ended."""
        if self._descriptor is None:
            self._descriptor = os.pidfd_open(self.pid)
        return self._descriptor


class ChildForker:
    """The process that forks the children of this process, which must have only one thread when it makes the forker."""

    def __init__(self) -> None:
        self._orders, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._ordering = threading.Lock()
        parent = os.getpid()
        if os.fork() == 0:
            _keep_only(theirs.fileno())
            die_with_parent()
            take_name([FORKER])
            signal.signal(signal.SIGTERM, signal.SIG_IGN)  # a test may send it to all descendants of its program
            _serve(theirs, parent)
        theirs.close()

    def start(
        self, module: str, arguments: Sequence[str], descriptor: int, environment: Mapping[str, str]
    ) -> ForkedChild:
        """Start a child as `child_process.start_module` does."""
        return self._order(module, [str(descriptor), *arguments], environment, {descriptor: descriptor}, program=False)

    async def start_program(
        self, *arguments: str, environment: Mapping[str, str], stdin: int | None = None, inherited: Sequence[int] = ()
    ) -> AwaitedProgram:
        """Start a program as `programs.start_program` does."""
        assert arguments[0] == "-m"
        given: FileIO | None = None
        places = {one: one for one in inherited}
        if stdin == asyncio.subprocess.PIPE:
            stdin, giving = os.pipe()
            given = FileIO(giving, "wb")
        if stdin is not None:
            places[0] = stdin
        forked = self._order(arguments[1], arguments[2:], environment, places, program=True)
        if given is not None:
            os.close(places[0])
        return AwaitedProgram(forked, given)

    def _order(
        self,
        module: str,
        arguments: Sequence[str],
        environment: Mapping[str, str],
        places: Mapping[int, int],
        *,
        program: bool,
    ) -> ForkedChild:
        """Start a module with the descriptors in `places`, by the numbers that they get in the new process.

        A program is started as `python -m` does, and has a forker of its own; a child has a session of its own.
        """
        order = json.dumps(
            {
                "module": module,
                "arguments": arguments,
                "environment": dict(environment),
                "places": [*places],
                "program": program,
            }
        ).encode()
        assert len(order) < LONGEST_ORDER
        with self._ordering:
            _adopt_orphans(True)
            try:
                socket.send_fds(self._orders, [order], [*places.values()])
                answer = self._orders.recv(PID.size)
            finally:
                _adopt_orphans(False)
        if not answer:
            raise RuntimeError("the forker has ended; the log of the program says why")
        return ForkedChild(PID.unpack(answer)[0])


def fork_children() -> None:
    """Let a forker fork the children of this process and its programs from now on."""
    forker = ChildForker()
    child_process.start_module = forker.start  # pyrefly: ignore[bad-assignment]  # does what a `Child` does here
    programs.start_program = forker.start_program  # pyrefly: ignore[bad-assignment]  # a program is used like a `Process`


def take_name(arguments: Sequence[str]) -> None:
    """Let `/proc` show `arguments` as the arguments of this process.

    In memory, they replace the arguments of the nursery, so they may have at most `LONGEST_NAME` bytes.
    """
    with open("/proc/self/stat") as file:
        fields = file.read().rpartition(")")[2].split()
    start, end = int(fields[45]), int(fields[46])
    text = b"\0".join(word.encode() for word in arguments)
    assert len(text) < end - start
    ctypes.memmove(start, text.ljust(end - start, b"\0"), end - start)


def take_on(environment: dict[str, str]) -> None:
    """Adopt the environment of a program, and read the variables again that modules read when they are imported."""
    os.environ.clear()
    os.environ.update(environment)
    sys.path[1:1] = [path for path in environment.get("PYTHONPATH", "").split(os.pathsep) if path not in sys.path]
    faults.plan(environment.get(FAULT_VARIABLE, ""))


def _adopt_orphans(adopts: bool) -> None:
    if ctypes.CDLL(None).prctl(_PR_SET_CHILD_SUBREAPER, int(adopts), 0, 0, 0) != 0:
        raise OSError("the system does not let this process adopt orphans")


def _keep_only(*descriptors: int) -> None:
    """Close all descriptors except `descriptors`, the standard input and the outputs.

    If `descriptors` lacks the standard input (0), it is `/dev/null`.
    """
    if 0 not in descriptors:
        nothing = os.open(os.devnull, os.O_RDONLY)
        os.dup2(nothing, 0)
    kept = sorted({0, 1, 2, *descriptors})
    for after, before in zip(kept, [*kept[1:], os.sysconf("SC_OPEN_MAX")], strict=True):
        os.closerange(after + 1, before)


def _serve(orders: socket.socket, parent: int) -> NoReturn:
    """Fork the children that the parent orders, until the kernel ends this process with its parent.

    A child is forked twice: when the intermediate process has ended, the parent adopts the child.
    """
    while True:
        order, descriptors, _, _ = socket.recv_fds(orders, LONGEST_ORDER, MOST_DESCRIPTORS)
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
            signal.signal(signal.SIGTERM, signal.SIG_DFL)
            ordered = json.loads(order)
            if not ordered["program"]:
                os.setsid()
            take_name([sys.executable, "-m", ordered["module"], *ordered["arguments"]])
            orders.send(PID.pack(os.getpid()))
            orders.detach()
            _place(descriptors, ordered.pop("places"))
            _run(**ordered)
        for descriptor in descriptors:
            os.close(descriptor)
        os.waitpid(between, 0)


def _place(descriptors: list[int], places: list[int]) -> None:
    """Give descriptors their numbers, and close all other descriptors except those of the output."""
    free = 1 + max((2, *descriptors, *places))
    moved = [fcntl.fcntl(descriptor, fcntl.F_DUPFD, free) for descriptor in descriptors]
    for descriptor, place in zip(moved, places, strict=True):
        os.dup2(descriptor, place)
    _keep_only(*places)


def _run(module: str, arguments: list[str], environment: dict[str, str], program: bool) -> NoReturn:
    take_on(environment)
    sys.argv = [module, *arguments]
    if program:
        fork_children()
        sys.modules.pop(module, None)  # `runpy` warns about a module that is loaded already
        runpy.run_module(module, run_name="__main__", alter_sys=True)
    else:
        importlib.import_module(module).main()
    sys.exit()
