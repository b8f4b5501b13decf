"""Launcher `local`: worker processes on the machine of the server.

A worker gets its token through a pipe to its standard input, which stays open: when the server ends, even by a crash,
the pipe closes and the worker stops. Secrets are never passed in argument lists or environment variables. A worker gets
only those environment variables of the server that it needs. A worker that ends by itself is started again.
"""

from __future__ import annotations

import asyncio
import logging
import time
from asyncio.subprocess import Process
from collections.abc import Mapping
from datetime import UTC, datetime

from pydantic import BaseModel, ConfigDict

from marey_schemas.backoff import Backoff
from marey_schemas.processes.environment import clean_environment
from marey_server.launchers.launcher import (
    HEALTHY_AFTER_S,
    LaunchContext,
    LaunchedWorker,
    WorkerEnd,
    WorkerRequest,
    WorkerState,
    read_options,
    worker_arguments,
)
from marey_server.process import programs
from marey_server.process.data_folder import WORKER_CACHE

log = logging.getLogger(__name__)

PAUSES = Backoff(first_s=0.5, longest_s=30.0, jitter=0.25)
STOP_S = 20.0


class LocalOptions(BaseModel):
    """Options of the launcher `local`, which has none."""

    model_config = ConfigDict(extra="forbid")


class LocalLauncher:
    """Launcher of worker processes on this machine. Limits of memory, processors and time do not apply to them."""

    outlives_server = False

    def __init__(self, context: LaunchContext) -> None:
        read_options(LocalOptions, context.options, "local")
        self._context = context
        self._workers: dict[str, _LocalWorker] = {}
        self._keeping: dict[str, asyncio.Task[None]] = {}

    async def start(self, request: WorkerRequest, count: int, *, key: str) -> tuple[str, ...]:
        """Start worker processes, which are restarted, with growing pauses, whenever they end by themselves."""
        names = tuple(f"{self._context.pool}-{key}-{number}" for number in range(count))
        for name in names:
            if name not in self._keeping:
                worker = self._workers[name] = _LocalWorker(name, request, self._context)
                self._keeping[name] = asyncio.create_task(worker.keep_running())
        return names

    async def list(self) -> tuple[LaunchedWorker, ...]:
        """Return the workers that were not stopped; a worker that waits for its restart is `starting`."""
        return tuple(worker.shown for name, worker in self._workers.items() if not self._keeping[name].done())

    async def stop(self, names: tuple[str, ...]) -> None:
        """Send SIGTERM to workers; one that does not end in time is killed."""
        for name in names:
            if worker := self._workers.get(name):
                worker.stop()

    async def why_ended(self, name: str) -> WorkerEnd | None:
        """Return why a worker last ended, before a restart or when it was stopped; None if it has never ended."""
        worker = self._workers.get(name)
        return None if worker is None else worker.end

    async def close(self) -> None:
        """Stop all workers, and wait until they have ended."""
        await self.stop(tuple(self._workers))
        await asyncio.gather(*self._keeping.values())


class _LocalWorker:
    """Worker process that is restarted, with growing pauses, whenever it ends by itself."""

    def __init__(self, name: str, request: WorkerRequest, context: LaunchContext) -> None:
        self.name = name
        self.end: WorkerEnd | None = None
        self._labels: Mapping[str, str] = request.labels
        self._token = context.token
        log = {"MAREY_LOG_FORM": context.log_form, "MAREY_LOG_LEVEL": context.log_level}
        self._environment = {**context.variables, **log}
        self._arguments = (
            *worker_arguments(request, context.url), "--attached", "--name", name,
            "--cache", str(context.data / WORKER_CACHE),
        )  # fmt: skip
        self._started_at: datetime | None = None
        self._stopping = asyncio.Event()

    @property
    def shown(self) -> LaunchedWorker:
        """The worker as `Launcher.list` returns it."""
        state: WorkerState = "starting" if self._started_at is None else "running"
        return LaunchedWorker(self.name, state, self._labels, self._started_at)

    async def keep_running(self) -> None:
        """Start the worker and wait for its end, repeatedly, until `stop` is called."""
        quick_ends = 0
        while not self._stopping.is_set():
            begun = time.monotonic()
            failure = await self._run()
            self._started_at = None
            if self._stopping.is_set():
                return
            quick_ends = 0 if time.monotonic() - begun > HEALTHY_AFTER_S else quick_ends + 1
            pause_s = PAUSES.delay_s(quick_ends + 1)
            log.warning("worker %s %s; starting it again in %.1f s", self.name, failure, pause_s)
            await self._wait_for_stop(pause_s)

    def stop(self) -> None:
        """Let the worker return its jobs to the queue and end; kill it if it does not end in time."""
        self._stopping.set()

    async def _run(self) -> str:
        """Run the worker once; return a text that says how it ended."""
        try:
            process = await self._start()
        except OSError as error:
            self.end = WorkerEnd("failed", None, f"the process could not be started: {error}")
            return f"could not be started: {error}"
        ending = asyncio.create_task(process.wait())
        stopping = asyncio.create_task(self._stopping.wait())
        try:
            await asyncio.wait((ending, stopping), return_when=asyncio.FIRST_COMPLETED)
        finally:
            stopping.cancel()
        if not ending.done():
            await self._terminate(process)
        status = await ending
        self.end = _end_of(status, stopped=self._stopping.is_set())
        return f"ended with status {status}"

    async def _start(self) -> Process:
        environment = clean_environment() | self._environment
        process = await programs.start_program(*self._arguments, environment=environment, stdin=asyncio.subprocess.PIPE)
        assert process.stdin is not None
        process.stdin.write(self._token.encode() + b"\n")
        self._started_at = datetime.now(UTC)
        log.info("worker %s is process %d", self.name, process.pid)
        return process

    async def _terminate(self, process: Process) -> None:
        process.terminate()
        try:
            async with asyncio.timeout(STOP_S):
                await process.wait()
        except TimeoutError:
            log.warning("worker %s does not stop; killing it", self.name)
            process.kill()

    async def _wait_for_stop(self, seconds: float) -> None:
        try:
            async with asyncio.timeout(seconds):
                await self._stopping.wait()
        except TimeoutError:
            return


def _end_of(status: int, *, stopped: bool) -> WorkerEnd:
    if stopped:
        return WorkerEnd("stopped", status)
    if status < 0:
        return WorkerEnd("killed", status, f"signal {-status}")
    return WorkerEnd("finished" if status == 0 else "failed", status)
