"""Programs in processes of their own, which tests can stop, kill and start again.

Importing the modules of a server takes 2 s of processor, and tests of faults start hundreds of servers and workers. So
they are forked from a process that has imported these modules. In the tier `soak`, and where a program needs another
PYTHONPATH, they start as users start them.
"""

from __future__ import annotations

import multiprocessing
import os
import runpy
import signal
import subprocess
import sys
from collections.abc import Mapping, Sequence
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Protocol

from tests.support.tiers import is_soak

_IMPORTED = [
    "marey_client.cli.app",
    "marey_client.embedded",
    "marey_server.commands",
    "marey_server.app",
    "marey_worker.commands",
    "marey_worker.supervisor",
    "uvloop",
]


class Program(Protocol):
    """Running program, with the methods of `subprocess.Popen`."""

    @property
    def pid(self) -> int:
        """The process id."""

    def poll(self) -> int | None:
        """Return the exit status, or None while the program runs."""

    def wait(self, timeout: float | None = None) -> int:
        """Return the exit status once the program has ended. Raises `subprocess.TimeoutExpired`."""

    def send_signal(self, sig: int) -> None:
        """Send a signal, unless the program has ended."""

    def terminate(self) -> None:
        """Send SIGTERM."""

    def kill(self) -> None:
        """Send SIGKILL."""


def start_program(
    arguments: Sequence[str], environment: Mapping[str, str], log: Path, stdin: bytes | None = None
) -> Program:
    """Start `python -m` with the given arguments and environment, which appends its output to a log.

    `stdin` is written to the program's standard input, which stays open until the program object is deleted.
    """
    if is_soak() or sys.platform != "linux" or environment.get("PYTHONPATH") != os.environ.get("PYTHONPATH"):
        return _start(arguments, environment, log, stdin)
    return _Forked(arguments, environment, log, stdin)


def _start(
    arguments: Sequence[str], environment: Mapping[str, str], log: Path, stdin: bytes | None
) -> subprocess.Popen[bytes]:
    with log.open("ab") as output:
        program = subprocess.Popen(
            [sys.executable, "-m", *arguments],
            env=environment,
            stdin=subprocess.DEVNULL if stdin is None else subprocess.PIPE,
            stdout=output,
            stderr=output,
        )
    if stdin is not None:
        assert program.stdin is not None
        program.stdin.write(stdin)
        program.stdin.flush()
    return program


class _Forked:
    """Program in a process that was forked."""

    def __init__(
        self, arguments: Sequence[str], environment: Mapping[str, str], log: Path, stdin: bytes | None
    ) -> None:
        context = multiprocessing.get_context("forkserver")
        context.set_forkserver_preload(_IMPORTED)
        theirs, self._stdin = context.Pipe(duplex=False)
        given = None if stdin is None else theirs
        self._process = context.Process(target=_run, args=(arguments, dict(environment), log, given), daemon=True)
        self._process.start()
        theirs.close()
        if stdin is not None:
            os.write(self._stdin.fileno(), stdin)

    @property
    def pid(self) -> int:
        assert self._process.pid is not None
        return self._process.pid

    def poll(self) -> int | None:
        return self._process.exitcode

    def wait(self, timeout: float | None = None) -> int:
        self._process.join(timeout)
        if (status := self._process.exitcode) is None:
            raise subprocess.TimeoutExpired(str(self.pid), timeout or 0.0)
        return status

    def send_signal(self, sig: int) -> None:
        if self.poll() is None:
            os.kill(self.pid, sig)

    def terminate(self) -> None:
        self.send_signal(signal.SIGTERM)

    def kill(self) -> None:
        self.send_signal(signal.SIGKILL)


def _run(arguments: Sequence[str], environment: dict[str, str], log: Path, stdin: Connection | None) -> None:
    """Run a program in this process as `python -m` does."""
    os.environ.clear()
    os.environ.update(environment)
    output = os.open(log, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o600)
    for number in (1, 2):
        os.dup2(output, number)
    os.close(output)
    if stdin is not None:
        os.dup2(stdin.fileno(), 0)
        stdin.close()
        sys.stdin = open(0, closefd=False)  # noqa: SIM115 - open to the end
    sys.argv = list(arguments)
    runpy.run_module(arguments[0], run_name="__main__", alter_sys=True)
