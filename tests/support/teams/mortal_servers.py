"""Process that forks servers which die at a chosen step: `mortal_servers.py`, with orders as JSON lines on its input.

A step of a server is an SQL statement, a commit, or a point of `marey_server.faults`. An order names a file with a
counter of eight bytes, which the server shares with the test. Each step decreases a positive counter by one. Before the
step that would decrease it to zero, the server sets it to `FIRED`, and kills itself (SIGKILL).

An order for a server that already runs kills this server first, and then starts it again. When the input ends, all
servers are killed. Forking takes a hundredth of the time that starting a new process takes.
"""

from __future__ import annotations

import asyncio
import fcntl
import gc
import json
import mmap
import os
import signal
import struct
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from sqlalchemy import Engine, event

from marey_server import faults
from marey_server.app import connect_database, create_app, listening
from marey_server.process.settings import Settings

COUNTER = struct.Struct("<q")
FIRED = -1


class Countdown:
    """The counter of a server."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("r+b")
        self._shared = mmap.mmap(self._file.fileno(), COUNTER.size)
        self._lock = threading.Lock()

    @property
    def left(self) -> int:
        """Number of steps until the server dies; 0 if it must not die, `FIRED` after it has died."""
        return int(COUNTER.unpack(self._shared)[0])

    @left.setter
    def left(self, steps: int) -> None:
        COUNTER.pack_into(self._shared, 0, steps)

    def step(self, *_args: Any, **_options: Any) -> None:
        """Count a step of this process, and kill this process if the step is the last one."""
        with self._locked():
            left = self.left
            if left <= 0:
                return
            self.left = left - 1 if left > 1 else FIRED
            if left == 1:
                os.kill(os.getpid(), signal.SIGKILL)

    def cancel(self) -> None:
        """Let the server live, unless it has died already."""
        with self._locked():
            if self.left != FIRED:
                self.left = 0

    @contextmanager
    def _locked(self) -> Iterator[None]:
        """Keep other threads, and the other process that uses the counter, from changing it."""
        with self._lock:
            fcntl.flock(self._file, fcntl.LOCK_EX)
            try:
                yield
            finally:
                fcntl.flock(self._file, fcntl.LOCK_UN)


def run_server(order: dict[str, Any], ready: int) -> None:
    """Run a server until it is killed; write a byte to the descriptor `ready` when it accepts requests."""
    countdown = Countdown(Path(order["counter"]))
    event.listen(Engine, "before_cursor_execute", countdown.step)
    event.listen(Engine, "commit", countdown.step)
    faults.point = countdown.step

    async def main() -> None:
        settings = Settings(
            data=Path(order["data"]), port=order["port"], database_url=order["database_url"], drain_s=1.0
        )
        async with listening(create_app(settings, connect_database(settings))):
            os.write(ready, b".")
            await asyncio.Event().wait()

    asyncio.run(main())


def start(order: dict[str, Any], log: int) -> int:
    """Fork a server, wait until it accepts requests, and return its process id."""
    waiting, ready = os.pipe()
    pid = os.fork()
    if pid == 0:
        try:
            os.close(waiting)
            nothing = os.open(os.devnull, os.O_RDWR)
            for descriptor, to in ((0, nothing), (1, log), (2, log)):
                os.dup2(to, descriptor)
            run_server(order, ready)
        finally:
            os._exit(1)
    os.close(ready)
    started = os.read(waiting, 1)
    os.close(waiting)
    if not started:
        os.waitpid(pid, 0)
        raise RuntimeError("the server ended before it was ready; see the log")
    return pid


def kill(pid: int) -> None:
    """Kill a server if it still runs, and wait for its end."""
    os.kill(pid, signal.SIGKILL)
    os.waitpid(pid, 0)


def main() -> None:
    """Carry out orders; each is answered by a line with the process id of the server."""
    log = os.dup(2)
    gc.freeze()
    running: dict[str, int] = {}
    try:
        for line in sys.stdin:
            order = json.loads(line)
            if order["counter"] in running:
                kill(running.pop(order["counter"]))
            running[order["counter"]] = start(order, log)
            print(running[order["counter"]], flush=True)
    finally:
        for pid in running.values():
            kill(pid)


if __name__ == "__main__":
    main()
