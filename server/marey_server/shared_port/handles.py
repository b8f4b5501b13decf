"""Handle with which the parent starts, watches and stops a server process."""

from __future__ import annotations

import asyncio
import logging
import os
import signal
import socket
import time
from asyncio.subprocess import Process
from contextlib import suppress
from typing import Self

from marey_server.process import programs
from marey_server.process.notices import NOTIFY_VARIABLE
from marey_server.shared_port.orders import KEEP_WORKERS, PROGRAM, READY, StartOrder

log = logging.getLogger(__name__)

STOPPING_S = 45.0
"""Seconds that a process may take to end, in addition to `drain_s`: workers end first, and then transactions."""


class ProcessHandle:
    """Server process that the parent has started. `number` is its place among the processes of the server, from 1."""

    def __init__(
        self, number: int, process: Process, reader: asyncio.StreamReader, writer: asyncio.StreamWriter
    ) -> None:
        self.number = number
        self.is_ready = False
        self.stopping = False
        self._process = process
        self._writer = writer
        self._started_s = time.monotonic()
        self._ready = asyncio.create_task(self._await_ready(reader))
        self._ended = asyncio.create_task(self._await_end())

    @classmethod
    async def start(cls, number: int, order: StartOrder) -> Self:
        """Start a process, which inherits the sockets that `order` names. Raises `OSError` if it cannot be started."""
        ours, theirs = socket.socketpair()
        with theirs:
            process = await programs.start_program(
                "-m",
                PROGRAM,
                environment={name: text for name, text in os.environ.items() if name != NOTIFY_VARIABLE},
                stdin=theirs.fileno(),
                inherited=(*order.sockets, *order.metrics_sockets),
            )
        reader, writer = await asyncio.open_connection(sock=ours)
        writer.write(order.to_line())
        log.info("server process %d has the process id %d", number, process.pid)
        return cls(number, process, reader, writer)

    @property
    def pid(self) -> int:
        """The process id."""
        return self._process.pid

    @property
    def age_s(self) -> float:
        """Seconds since the start."""
        return time.monotonic() - self._started_s

    @property
    def runs(self) -> bool:
        """True if the process is running and the parent has not asked it to end."""
        return not self.stopping and not self._ended.done()

    async def until_ready(self) -> bool:
        """Wait until the process accepts connections, and return True; return False if it ends before this."""
        await asyncio.wait((self._ready, self._ended), return_when=asyncio.FIRST_COMPLETED)
        return self.is_ready and not self._ended.done()

    async def until_ended(self) -> int:
        """Wait until the process has ended; return its exit status."""
        return await asyncio.shield(self._ended)

    def keep_workers(self) -> None:
        """Ask the process to run the workers of the server from now on."""
        self._writer.write(KEEP_WORKERS)

    async def stop(self, drain_s: float) -> None:
        """Ask the process to finish its running requests and end; kill it if it takes too long.

        Wait until it has ended.
        """
        self.stopping = True
        self._send(signal.SIGTERM)
        try:
            async with asyncio.timeout(drain_s + STOPPING_S):
                await self.until_ended()
        except TimeoutError:
            log.warning("server process %d (%d) does not stop; killing it", self.number, self.pid)
            self._send(signal.SIGKILL)
            await self.until_ended()

    def _send(self, number: signal.Signals) -> None:
        with suppress(ProcessLookupError):
            self._process.send_signal(number)

    async def _await_ready(self, reader: asyncio.StreamReader) -> None:
        with suppress(OSError):
            self.is_ready = await reader.readline() == READY

    async def _await_end(self) -> int:
        status = await self._process.wait()
        self._writer.close()
        return status
