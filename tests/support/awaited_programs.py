"""Forked processes that an event loop watches, in place of those of `asyncio.create_subprocess_exec`."""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
from io import FileIO
from typing import Protocol


class Forked(Protocol):
    """A process that a forker or the nursery has forked for this process."""

    pid: int

    def wait(self) -> int: ...

    def fileno(self) -> int:
        """Return a descriptor that can be read from when the process has ended."""
        ...


class AwaitedProgram:
    """A forked program with those methods of `asyncio.subprocess.Process` that servers use."""

    def __init__(self, program: Forked, stdin: FileIO | None) -> None:
        self.stdin = stdin
        self._program = program
        self._ended = asyncio.create_task(self._await_end())

    @property
    def pid(self) -> int:
        """The process id."""
        return self._program.pid

    @property
    def returncode(self) -> int | None:
        """The exit status, or None if the event loop has not seen the end yet; a negative number is a signal.

        The program is not asked: to give its status, it closes the descriptor on which the event loop waits.
        """
        return self._ended.result() if self._ended.done() and not self._ended.cancelled() else None

    async def wait(self) -> int:
        """Return the exit status when the process has ended."""
        return await asyncio.shield(self._ended)

    def send_signal(self, number: int) -> None:
        """Send a signal to the process, unless it has ended."""
        if self.returncode is None:
            with contextlib.suppress(ProcessLookupError):
                os.kill(self.pid, number)

    def terminate(self) -> None:
        """Send SIGTERM."""
        self.send_signal(signal.SIGTERM)

    def kill(self) -> None:
        """Send SIGKILL."""
        self.send_signal(signal.SIGKILL)

    async def _await_end(self) -> int:
        loop, ended, descriptor = asyncio.get_running_loop(), asyncio.Event(), self._program.fileno()
        loop.add_reader(descriptor, ended.set)
        try:
            await ended.wait()
        finally:
            loop.remove_reader(descriptor)
            if self.stdin is not None:
                self.stdin.close()
        return self._program.wait()
