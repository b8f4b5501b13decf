"""The parent of the server processes: it holds the listening sockets, and starts, watches and replaces the processes.

All processes inherit the same listening socket. So a connection that waits to be accepted is not lost when a process
ends: another process accepts it. With a socket for each process (SO_REUSEPORT), it would be lost.
"""

from __future__ import annotations

import asyncio
import logging
import signal
import socket
from collections.abc import Sequence
from typing import Any

from marey_schemas.backoff import Backoff
from marey_server.http.accepting import address_of, listen
from marey_server.process.notices import note_ready, note_reloading, note_stopping
from marey_server.process.observe import configure_logging
from marey_server.process.settings import Settings
from marey_server.shared_port.handles import ProcessHandle
from marey_server.shared_port.orders import StartOrder

log = logging.getLogger(__name__)

HEALTHY_AFTER_S = 10.0
"""Run time in seconds after which the end of a process does not count as a failed start."""
MOST_FAILURES = 5
"""Number of failed starts in a row after which the parent gives up, if no other process is healthy."""
PAUSES = Backoff(first_s=0.5, longest_s=30.0, jitter=0.25)


async def serve_in_processes(settings: Settings, given: dict[str, Any]) -> None:
    """Run the processes of a server until SIGTERM or SIGINT; SIGHUP replaces all of them, one after another.

    The processes get the settings `given`. They read all other settings themselves, so that new processes use changed
    settings. Raises `CannotListen` if the address cannot be used, and `ProcessesFailed` if the processes cannot be
    started or end repeatedly.
    """
    configure_logging(settings.log_form, settings.log_level)
    sockets = listen(settings.host, settings.port)
    metrics_sockets = []
    if settings.metrics_port is None:
        log.warning(
            "/metrics shows the numbers of the process that answers, which may be any; set metrics_port to give "
            "each process a port of its own for its numbers"
        )
    else:
        ports = range(settings.metrics_port, settings.metrics_port + settings.processes)
        metrics_sockets = [listen(settings.host, port) for port in ports]
    log.info("%d server processes will listen on %s", settings.processes, address_of(sockets))
    fixed = {"host": settings.host, "port": settings.port, "metrics_port": settings.metrics_port}
    await Parent(settings, {**given, **fixed}, sockets, metrics_sockets).run()


class ProcessesFailed(Exception):
    """Error of a server whose processes cannot be started or end repeatedly; the text gives the reason."""


class Parent:
    """Parent of the processes of one server.

    Parameters
    ----------
    settings : settings of the server
    given : the settings that were given as options, which the processes get
    sockets : listening sockets that all processes share
    metrics_sockets : for each process, the listening sockets of its own port for metrics
    """

    def __init__(
        self,
        settings: Settings,
        given: dict[str, Any],
        sockets: Sequence[socket.socket],
        metrics_sockets: Sequence[Sequence[socket.socket]],
    ) -> None:
        self._settings = settings
        self._given = given
        self._sockets = sockets
        self._metrics_sockets = metrics_sockets
        self._current: dict[int, ProcessHandle] = {}
        """The current process of each number; a process that was replaced is not here, even while it is stopping."""
        self._living: set[ProcessHandle] = set()
        self._changing = {number: asyncio.Lock() for number in range(1, settings.processes + 1)}
        self._has_workers = settings.starts_workers
        self._worker_keeper: ProcessHandle | None = None
        self._failures = 0
        self._announced = False
        self._wanted = asyncio.Event()
        """Event that is set when the processes must be replaced."""
        self.stopping = asyncio.Event()

    async def run(self) -> None:
        """Run the processes until `stopping` is set.

        Raises `ProcessesFailed` if they cannot be started or end repeatedly.
        """
        loop = asyncio.get_running_loop()
        for number in (signal.SIGTERM, signal.SIGINT):
            loop.add_signal_handler(number, self.stopping.set)
        loop.add_signal_handler(signal.SIGHUP, self._wanted.set)
        serving, stopped = asyncio.create_task(self._serve()), asyncio.create_task(self.stopping.wait())
        try:
            await asyncio.wait((serving, stopped), return_when=asyncio.FIRST_COMPLETED)
        finally:
            for task in (serving, stopped):
                task.cancel()
            note_stopping()
            await asyncio.gather(serving, stopped, return_exceptions=True)
            await asyncio.gather(*(one.stop(self._settings.drain_s) for one in self._living))
        if not serving.cancelled() and (error := serving.exception()) is not None:
            raise error

    # -- start --

    async def _serve(self) -> None:
        await self._start_all()
        tasks = [asyncio.create_task(self._keep(number)) for number in self._changing]
        tasks.append(asyncio.create_task(self._replace_when_wanted()))
        try:
            await asyncio.gather(*tasks)
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)

    async def _start_all(self) -> None:
        """Start all processes: first one process, which upgrades the database, and then the others.

        Raises `ProcessesFailed` if the first process ends, or a process cannot be started.
        """
        numbers = iter(self._changing)
        first = self._current[next(numbers)] = await self._start(1, first=True)
        self._worker_keeper = first if self._has_workers else None
        if not await first.until_ready():
            status = await first.until_ended()
            raise ProcessesFailed(f"the first server process ended with status {status}; its message is above")
        for number in numbers:
            self._current[number] = await self._start(number)
        await asyncio.gather(*(one.until_ready() for one in self._current.values()))
        self._announce()

    def _announce(self) -> None:
        """Report that the server is ready, as soon as all processes are ready for the first time."""
        if not self._announced and all(one.is_ready and one.runs for one in self._current.values()):
            self._announced = True
            log.info("all %d server processes are ready", self._settings.processes)
            note_ready()

    async def _start(self, number: int, *, first: bool = False) -> ProcessHandle:
        own = self._metrics_sockets[number - 1] if self._metrics_sockets else ()
        order = StartOrder(
            self._given, tuple(one.fileno() for one in self._sockets), tuple(one.fileno() for one in own), first
        )
        try:
            started = await ProcessHandle.start(number, order)
        except OSError as error:
            raise ProcessesFailed(f"the server process {number} cannot be started: {error}") from error
        self._living.add(started)
        return started

    # -- processes that end by themselves --

    async def _keep(self, number: int) -> None:
        """Start the process with this number again whenever it ends by itself, with growing pauses."""
        quick_ends = 0
        while True:
            process = self._current[number]
            status = await process.until_ended()
            self._living.discard(process)
            if self._current[number] is not process:
                continue  # it was replaced
            quick_ends = quick_ends + 1 if process.age_s < HEALTHY_AFTER_S else 0
            self._note_end(process, status)
            pause_s = PAUSES.delay_s(quick_ends + 1)
            log.error(
                "server process %d (%d) ended with status %d; starting it again in %.1f s",
                number, process.pid, status, pause_s,
            )  # fmt: skip
            self._give_workers()
            await asyncio.sleep(pause_s)
            async with self._changing[number]:
                if self._current[number] is process:
                    await self._start_again(number)
            if await self._current[number].until_ready():
                self._give_workers()
                self._announce()

    async def _start_again(self, number: int) -> None:
        """Replace the ended process with this number by a new process.

        If the operating system cannot start it, only log this; the caller tries again after a pause.
        """
        try:
            self._current[number] = await self._start(number)
        except ProcessesFailed as error:
            log.error("%s", error)

    def _note_end(self, process: ProcessHandle, status: int) -> None:
        """Count an ended process as failed if it ran for less than `HEALTHY_AFTER_S` seconds.

        Raises `ProcessesFailed` after `MOST_FAILURES` failures in a row, unless another process is healthy.
        """
        self._failures = self._failures + 1 if process.age_s < HEALTHY_AFTER_S else 0
        healthy = any(one.is_ready and one.runs and one.age_s >= HEALTHY_AFTER_S for one in self._current.values())
        if self._failures >= MOST_FAILURES and not healthy:
            raise ProcessesFailed(
                f"the server processes end soon after their start: {self._failures} times in a row, the last time with "
                f"status {status}; their messages are above"
            )

    def _give_workers(self) -> None:
        """Let a process that is ready run the workers if the process that ran them has ended or is stopping."""
        if not self._has_workers or (self._worker_keeper is not None and self._worker_keeper.runs):
            return
        ready = [one for one in self._current.values() if one.is_ready and one.runs]
        self._worker_keeper = ready[0] if ready else None
        if self._worker_keeper is not None:
            self._worker_keeper.keep_workers()

    # -- replacement --

    async def _replace_when_wanted(self) -> None:
        """Replace all processes, one after another, whenever a replacement is requested (SIGHUP)."""
        while True:
            await self._wanted.wait()
            self._wanted.clear()
            note_reloading()
            log.info("replacing the server processes one by one")
            if await self._replace_all():
                log.info("all server processes are replaced")
            note_ready()

    async def _replace_all(self) -> bool:
        """Replace all processes one after another; stop and return False if a new process does not become ready."""
        for number in self._changing:
            async with self._changing[number]:
                try:
                    new = await self._start(number)
                except ProcessesFailed as error:
                    log.error("%s; the earlier processes keep running", error)
                    return False
                if not await new.until_ready():
                    self._living.discard(new)
                    log.error(
                        "the new server process %d ended with status %d before it was ready; the earlier processes "
                        "keep running", number, await new.until_ended(),
                    )  # fmt: skip
                    return False
                old, self._current[number] = self._current[number], new
            await old.stop(self._settings.drain_s)
            self._living.discard(old)
            self._give_workers()
        return True
