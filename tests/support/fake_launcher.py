"""Launcher without an engine, for tests of the task that starts and stops the workers of pools."""

from __future__ import annotations

import asyncio

from marey_server.launchers.launcher import EngineError, LaunchedWorker, WorkerEnd, WorkerRequest, WorkerState


class FakeLauncher:
    """Engine whose workers run and end when a test says so.

    With `lose_answers`, the engine starts the workers, but raises an error instead of answering.
    """

    def __init__(self, *, outlives_server: bool = True) -> None:
        self.outlives_server = outlives_server
        self.states: dict[str, WorkerState] = {}
        self.ends: dict[str, WorkerEnd] = {}
        self.requests: list[WorkerRequest] = []
        self.keys: list[str] = []
        self.stopped: list[str] = []
        self.lose_answers = False
        self.silent = False
        self.closed = False

    async def start(self, request: WorkerRequest, count: int, *, key: str) -> tuple[str, ...]:
        self.requests.append(request)
        self.keys.append(key)
        names = tuple(f"gpu-{key}-{number}" for number in range(count))
        for name in names:
            self.states.setdefault(name, "starting")
        if self.lose_answers:
            raise EngineError("the answer was lost")
        return names

    async def list(self) -> tuple[LaunchedWorker, ...]:
        if self.silent:
            await asyncio.sleep(60)
        return tuple(LaunchedWorker(name, state) for name, state in self.states.items())

    async def stop(self, names: tuple[str, ...]) -> None:
        self.stopped += names

    async def why_ended(self, name: str) -> WorkerEnd | None:
        return self.ends.get(name)

    async def close(self) -> None:
        self.closed = True

    def run_all(self) -> None:
        """Let all workers that are starting run."""
        self.states = {name: "running" if state == "starting" else state for name, state in self.states.items()}

    def end(self, name: str, end: WorkerEnd) -> None:
        """Let a worker end."""
        self.states[name], self.ends[name] = "ended", end
