"""Worker processes that a server starts on its own machine.

A worker gets its token through a pipe to its standard input, which stays open: when the server ends, even by a crash,
the pipe closes and the worker stops. Secrets are never passed in argument lists or environment variables. A worker gets
only those environment variables of the server that it needs.
"""

from __future__ import annotations

import asyncio
import logging
import sys
import time
from asyncio.subprocess import Process
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

from marey_schemas.backoff import Backoff
from marey_schemas.processes.environment import clean_environment
from marey_schemas.queue.log_lines import LogForm

log = logging.getLogger(__name__)

PAUSES = Backoff(first_s=0.5, longest_s=30.0, jitter=0.25)
HEALTHY_AFTER_S = 30.0
"""Run time in seconds after which a worker counts as healthy, so that it is restarted after a short pause."""

STOP_S = 20.0


@asynccontextmanager
async def local_workers(
    count: int, *, url: str, token: str, cache: Path, log_form: LogForm, log_level: str
) -> AsyncIterator[None]:
    """Keep `count` workers running while the `async with` block runs; then stop the workers.

    Parameters
    ----------
    url : address of this server
    token : token of a user who may run jobs, with the scope `work`
    cache : folder where the workers keep inputs
    log_form, log_level : form and level of the workers' logs, which go to the same place as this server's log
    """
    logging_as_here = {"MAREY_LOG_FORM": log_form, "MAREY_LOG_LEVEL": log_level}
    workers = [_LocalWorker(f"local-{number}", url, token, cache, logging_as_here) for number in range(1, count + 1)]
    keeping = [asyncio.create_task(worker.keep_running()) for worker in workers]
    try:
        yield
    finally:
        await asyncio.gather(*(worker.stop() for worker in workers))
        await asyncio.gather(*keeping)


class _LocalWorker:
    """Worker process that is restarted, with growing pauses, whenever it ends by itself."""

    def __init__(self, name: str, url: str, token: str, cache: Path, environment: dict[str, str]) -> None:
        self._name = name
        self._environment = environment
        self._token = token
        self._command = [
            sys.executable, "-m", "marey_worker", "--attached", "--server", url, "--name", name, "--cache", str(cache),
        ]  # fmt: skip
        self._process: Process | None = None
        self._stopping = asyncio.Event()

    async def keep_running(self) -> None:
        """Start the worker and wait for its end, repeatedly."""
        quick_ends = 0
        while not self._stopping.is_set():
            started = time.monotonic()
            self._process = await self._start()
            status = await self._process.wait()
            if self._stopping.is_set():
                return
            quick_ends = 0 if time.monotonic() - started > HEALTHY_AFTER_S else quick_ends + 1
            pause_s = PAUSES.delay_s(quick_ends + 1)
            log.warning("worker %s ended with status %d; starting it again in %.1f s", self._name, status, pause_s)
            await self._pause(pause_s)

    async def stop(self) -> None:
        """Ask the worker to return its jobs and end; kill it if it does not end in time."""
        self._stopping.set()
        process = self._process
        if process is None or process.returncode is not None:
            return
        process.terminate()
        try:
            await asyncio.wait_for(process.wait(), STOP_S)
        except TimeoutError:
            log.warning("worker %s does not stop; killing it", self._name)
            process.kill()
            await process.wait()

    async def _start(self) -> Process:
        process = await asyncio.create_subprocess_exec(
            *self._command, stdin=asyncio.subprocess.PIPE, env=clean_environment() | self._environment
        )
        assert process.stdin is not None
        process.stdin.write(self._token.encode() + b"\n")
        log.info("worker %s is process %d", self._name, process.pid)
        return process

    async def _pause(self, seconds: float) -> None:
        try:
            await asyncio.wait_for(self._stopping.wait(), seconds)
        except TimeoutError:
            return
