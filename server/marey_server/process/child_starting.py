"""Start of child processes: on Linux, children are forked from a process that has loaded the modules; on other systems,
each child loads the modules itself.
"""

from __future__ import annotations

import threading
from collections.abc import Sequence
from typing import TypeVar

from marey_schemas.processes.child_process import ChildBroken, ChildProcess, ConnectedChild
from marey_schemas.processes.forking import ForkServer
from marey_server.motions.child import FORK_SERVER, SINGLE

CHILD_MODULE = "marey_server.motions.child"
LOADED_FIRST = ("marey_server.motions.reading:load_kernels",)
"""Functions that load modules and kernels in advance, so that a child's first task need not wait for them."""
MODULES_FIRST = ("marey_server.motions.reading",)
"""Modules that are loaded in advance if each child loads the kernels when it needs them."""

Loading = TypeVar("Loading", ChildProcess, ForkServer)


class ChildStarter:
    """Starter of child processes, each of which may use `memory_bytes` for its tasks; any thread may start children.

    All children are killed when the starter is closed.
    """

    def __init__(self, memory_bytes: int, loaded_first: Sequence[str], *, forks: bool) -> None:
        self._arguments = [str(memory_bytes), FORK_SERVER if forks else SINGLE, *loaded_first]
        self._forks = forks
        self._launching = threading.Lock()
        self._fork_server: ForkServer | None = None
        self._changed = threading.Lock()
        self._loading: set[ChildProcess | ForkServer] = set()
        self._closed = False

    def start(self) -> ConnectedChild:
        """Return a new child that is ready. Raises `ChildBroken` or `OSError` if it cannot be started."""
        if not self._forks:
            return self._loaded(ChildProcess(CHILD_MODULE, self._arguments, threads=1))
        with self._launching:
            if self._fork_server is None or not self._fork_server.alive:
                self._fork_server = self._loaded(ForkServer(CHILD_MODULE, self._arguments))
            return self._fork_server.fork()

    def close(self) -> None:
        """Kill the processes that are loading their modules, and the fork server with its children."""
        with self._changed:
            self._closed = True
            for process in self._loading:
                process.abort()
            if self._fork_server is not None:
                self._fork_server.abort()  # a fork that is under way ends, and with it the lock below
        with self._launching:
            if self._fork_server is not None:
                self._fork_server.close()

    def _loaded(self, process: Loading) -> Loading:
        """Wait until a process has loaded its modules, and return it.

        Raises `ChildBroken` or `OSError` if the process has ended before.
        """
        with self._changed:
            self._loading.add(process)
            if self._closed:
                process.abort()
        try:
            process.wait_until_ready()
        except (ChildBroken, OSError):
            process.close()
            raise
        finally:
            with self._changed:
                self._loading.discard(process)
        return process
