"""Programs that tests start in processes of their own: forked from a process that has imported their modules.

A server needs two seconds of processor time to import its modules, and hardly any to start. The tests start hundreds of
servers and workers, so each test process starts one *nursery* (`python -m tests.support.forked_programs`), which
imports the modules once and forks a process for each program. A forked program has the arguments, the environment, the
folder and the descriptors that a new process would have, runs the module as `python -m` does, and is a process that
tests can signal, kill and wait for. `tests/unit/server/test_app.py` starts `marey serve` without a nursery.
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
import importlib
import json
import os
import runpy
import select
import signal
import socket
import struct
import subprocess
import sys
import threading
from collections.abc import Mapping, Sequence
from io import FileIO
from pathlib import Path

from tests.support.awaited_programs import AwaitedProgram
from tests.support.forked_children import (
    FORKS,
    KERNELS,
    LONGEST_NAME,
    LONGEST_ORDER,
    PID,
    fork_children,
    take_name,
    take_on,
)
from tests.support.forked_children import MODULES as CHILDREN_RUN

MODULES = (
    "marey_client.cli.app", "marey_client.embedded", "marey_server.app", "marey_server.commands",
    "marey_worker.commands", *CHILDREN_RUN, "psycopg", "sqlalchemy.dialects.postgresql", "sqlalchemy.dialects.sqlite",
    "uvloop", "matplotlib.backends.backend_agg", "matplotlib.backends.backend_svg", "matplotlib.figure",
    "scipy.interpolate", "scipy.ndimage", "scipy.optimize", "scipy.signal",
)  # fmt: skip
"""Modules of servers, workers and their children, and further modules that they import at their start or for jobs."""
STANDARD_ERROR = 2
_STATUS = struct.Struct("<i")


class ForkedProgram:
    """Process that the nursery has forked. It can be used like `subprocess.Popen`."""

    def __init__(self, pid: int, ended: int, stdin: FileIO | None) -> None:
        self.pid = pid
        self.stdin = stdin
        self.returncode: int | None = None
        self._ended = ended

    def __del__(self) -> None:
        if self.returncode is None:
            os.close(self._ended)

    def poll(self) -> int | None:
        """Return the exit status, or None if the process still runs; a negative number is a signal."""
        return self._status_within(0)

    def wait(self, timeout: float | None = None) -> int:
        """Return the exit status when the process has ended. Raises `subprocess.TimeoutExpired`."""
        status = self._status_within(timeout)
        if status is None:
            assert timeout is not None
            raise subprocess.TimeoutExpired(f"forked program {self.pid}", timeout)
        return status

    def fileno(self) -> int:
        """Return a descriptor that can be read from when the process has ended."""
        return self._ended

    def send_signal(self, number: int) -> None:
        """Send a signal to the process, unless it has ended."""
        if self.poll() is None:
            with contextlib.suppress(ProcessLookupError):
                os.kill(self.pid, number)

    def terminate(self) -> None:
        """Send SIGTERM."""
        self.send_signal(signal.SIGTERM)

    def kill(self) -> None:
        """Send SIGKILL."""
        self.send_signal(signal.SIGKILL)

    def _status_within(self, seconds: float | None) -> int | None:
        if self.returncode is None and select.select([self._ended], [], [], seconds)[0]:
            told = os.read(self._ended, _STATUS.size)
            if not told:
                raise RuntimeError(f"the nursery ended before its program {self.pid}")
            (self.returncode,) = _STATUS.unpack(told)
            os.close(self._ended)
        return self.returncode


class Nursery:
    """The process that forks programs."""

    def __init__(self) -> None:
        self._orders, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        surroundings = {name: text for name, text in os.environ.items() if not name.startswith("MAREY_")}
        with theirs:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "tests.support.forked_programs", str(theirs.fileno()), " " * LONGEST_NAME],
                env=surroundings | {"OPENBLAS_NUM_THREADS": "1"},
                cwd=Path(__file__).parents[2],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                pass_fds=[theirs.fileno()],
            )
        self._ordering = threading.Lock()

    @property
    def pid(self) -> int:
        """The id of the process."""
        return self._process.pid

    def start(
        self,
        arguments: Sequence[str],
        environment: Mapping[str, str],
        *,
        output: int,
        with_stdin: bool,
        errors: int | None = None,
        own_children: bool = False,
        own_group: bool = False,
    ) -> ForkedProgram:
        """Start `python -m` with `arguments`; the output is written to the descriptor `output`.

        The error output is written to the descriptor `errors` if it is given, otherwise to `output`, too. With
        `own_children`, the program starts its child processes as new processes, instead of forking them. With
        `own_group`, it is the first process of a process group.
        """
        order = json.dumps(
            {
                "arguments": arguments,
                "environment": dict(environment),
                "folder": os.getcwd(),
                "own_children": own_children,
                "own_group": own_group,
            }
        ).encode()
        assert len(order) < LONGEST_ORDER
        ended, ending = os.pipe()
        taken, given = os.pipe() if with_stdin else (os.open(os.devnull, os.O_RDONLY), None)
        try:
            with self._ordering:
                socket.send_fds(self._orders, [order], [taken, output, output if errors is None else errors, ending])
                answer = self._orders.recv(PID.size)
        finally:
            os.close(ending)
            os.close(taken)
        if not answer:
            raise RuntimeError(f"the nursery has ended with status {self._process.wait()}; its error output says why")
        return ForkedProgram(PID.unpack(answer)[0], ended, None if given is None else FileIO(given, "wb"))


@functools.cache
def nursery() -> Nursery:
    """Return the nursery of this test process, which ends with the process."""
    return Nursery()


async def start_program(
    *arguments: str,
    environment: Mapping[str, str],
    stdin: int | None = None,
    output: int = STANDARD_ERROR,
    own_group: bool = False,
) -> AwaitedProgram:
    """Let the nursery start a program, as `marey_server.process.programs.start_program` does."""
    assert arguments[0] == "-m"
    with_stdin = stdin == asyncio.subprocess.PIPE
    forked = nursery().start(arguments[1:], environment, output=output, with_stdin=with_stdin, own_group=own_group)
    return AwaitedProgram(forked, forked.stdin)


def load_modules() -> None:
    """Import the modules of a server, of a worker, and of all kinds of jobs."""
    from marey_schemas.processes.forking import require_one_thread
    from marey_schemas.processes.memory import loading_modules
    from marey_schemas.queue.job_kinds import BUILT_IN

    with loading_modules():
        for name in (*MODULES, *(kind.implementation.partition(":")[0] for kind in BUILT_IN)):
            importlib.import_module(name)
        importlib.import_module(KERNELS).load_kernels()
    require_one_thread()


def main() -> list[str]:
    """Carry out orders until the test process ends; in a forked process, return the arguments of the program."""
    load_modules()
    orders = socket.socket(fileno=int(sys.argv[1]))
    woken, wake = socket.socketpair()
    woken.setblocking(False)
    wake.setblocking(False)
    signal.signal(signal.SIGCHLD, lambda *_: None)
    signal.set_wakeup_fd(wake.fileno(), warn_on_full_buffer=False)
    running: dict[int, int] = {}
    while True:
        ready, _, _ = select.select([orders, woken], [], [])
        if woken in ready:
            woken.recv(4096)
            tell_statuses(running)
        if orders in ready:
            order, descriptors, _, _ = socket.recv_fds(orders, LONGEST_ORDER, 4)
            if not order:  # the test process has ended
                sys.exit()
            *streams, ending = descriptors
            ordered = json.loads(order)
            pid = os.fork()
            if pid == 0:
                signal.set_wakeup_fd(-1)
                signal.signal(signal.SIGCHLD, signal.SIG_DFL)
                for to, source in enumerate(streams):
                    os.dup2(source, to)
                # They may be pipes from now on. As in a new process, no character makes a message of an error fail.
                sys.stdout, sys.stderr = os.fdopen(1, "w"), os.fdopen(2, "w", buffering=1, errors="backslashreplace")
                for unused in (orders, woken, wake):
                    unused.close()
                for descriptor in (*descriptors, *running.values()):
                    os.close(descriptor)
                return adopt(**ordered)
            if ordered["own_group"]:  # the caller may send a signal to the group before the process has run
                os.setpgid(pid, pid)
            running[pid] = ending
            for descriptor in streams:
                os.close(descriptor)
            orders.send(PID.pack(pid))


def tell_statuses(running: dict[int, int]) -> None:
    """Reap the processes that have ended, and write their exit statuses to their descriptors in `running`."""
    for pid in [*running]:
        ended, status = os.waitpid(pid, os.WNOHANG)
        if ended:
            descriptor = running.pop(pid)
            with contextlib.suppress(BrokenPipeError):  # no test waits for this process any more
                os.write(descriptor, _STATUS.pack(os.waitstatus_to_exitcode(status)))
            os.close(descriptor)


def adopt(
    arguments: list[str], environment: dict[str, str], folder: str, own_children: bool, own_group: bool
) -> list[str]:
    """Adopt the name, the environment and the folder of a program.

    Unless `own_children` is set, start a forker for the children of the program.
    """
    if own_group:
        os.setpgid(0, 0)
    if FORKS:
        take_name([sys.executable, "-m", *arguments])
    os.chdir(folder)
    take_on(environment)
    if FORKS and not own_children:
        fork_children()
    return arguments


if __name__ == "__main__":
    module, *sys.argv[1:] = main()
    runpy.run_module(module, run_name="__main__", alter_sys=True)
