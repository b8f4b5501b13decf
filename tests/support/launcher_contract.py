"""Rules that every launcher follows, checked with a real server, real workers and real jobs.

A launcher passes if a subclass of `LauncherContract` passes that defines the fixture `make_launcher`.
"""

from __future__ import annotations

import asyncio
import os
import secrets
import signal
import time
from collections.abc import Callable, Coroutine, Iterator
from pathlib import Path
from typing import Any, TypeVar

import psutil
import pytest
from tests.support.attached_worker import python_path
from tests.support.patience import PATIENCE_S
from tests.support.present import present
from tests.support.server_process import QUICK_LEASES, ServerProcess

from marey_client import Marey
from marey_schemas.access import ProjectCreate, TokenCreate
from marey_schemas.queue.jobs import Job, JobCreate
from marey_server.launchers.launcher import LaunchContext, Launcher, WorkerEnd, WorkerRequest
from marey_server.process.administrators import write_secret

T = TypeVar("T")
LABELS = {"site": "lyon"}
REQUEST = WorkerRequest(labels=LABELS, kinds=("add", "misbehave"), cpus=1, memory_bytes=512 * 2**20, deadline_s=3600)


class Engine:
    """A launcher, and short functions for tests; the event loop runs only while a test waits."""

    def __init__(self, server: ServerProcess, make: Callable[[LaunchContext], Launcher], folder: Path) -> None:
        self.server = server
        self.marey: Marey = server.client()
        self.token = self._make_token()
        pool = f"crew-{secrets.token_hex(4)}"  # another process may test another launcher on this machine
        self.context = LaunchContext(pool, server.url, self.token, folder, "text", "info", labels=LABELS)
        write_secret(self.context.token_file, self.token)
        self._runner = asyncio.Runner()
        self.launcher = make(self.context)
        self.names: tuple[str, ...] = ()

    def _make_token(self) -> str:
        wanted = TokenCreate(name="crew", scopes=("work",), labels=LABELS, expires_in_s=None)
        return self.marey.tokens.create(wanted).secret

    def do(self, call: Coroutine[Any, Any, T]) -> T:
        """Await the result of a call."""
        return self._runner.run(call)

    def start(self, count: int, *, key: str) -> tuple[str, ...]:
        """Start workers."""
        self.names = self.do(self.launcher.start(REQUEST, count, key=key))
        return self.names

    def until(self, found: Callable[[], T]) -> T:
        """Wait until `found` returns something true, and return it."""
        deadline = time.monotonic() + PATIENCE_S
        while not (value := found()):
            assert time.monotonic() < deadline, f"not within {PATIENCE_S:g} s; {self.states()}"
            self.do(asyncio.sleep(0.1))
        return value

    def states(self) -> dict[str, str]:
        """Return the states of all workers by name."""
        return {worker.name: worker.state for worker in self.do(self.launcher.list())}

    def until_running(self) -> None:
        """Wait until all workers that were started run."""
        self.until(lambda: all(self.states().get(name) == "running" and processes_of(name) for name in self.names))

    def until_ended(self, *names: str) -> None:
        """Wait until the processes of workers have ended, and the launcher no longer lists these workers as running."""
        self.until(lambda: all(self.states().get(name, "ended") == "ended" for name in names))
        self.until(lambda: not any(processes_of(name) for name in names))

    def end_of(self, name: str) -> WorkerEnd:
        """Return why a worker ended, as soon as the launcher knows it."""
        return present(self.until(lambda: self.do(self.launcher.why_ended(name))))

    def submit(self, how: str, folder: Path) -> Job:
        """Submit a job for workers of this launcher that waits until the file `go` exists in `folder`."""
        folder.mkdir()
        params = {"how": how, "folder": str(folder)}
        return self.marey.jobs.submit("lab", JobCreate(kind="misbehave", params=params, labels=LABELS))

    def close(self) -> None:
        """Stop all workers, and close the launcher."""
        try:
            alive = tuple(name for name, state in self.states().items() if state != "ended")
            self.do(self.launcher.stop(alive))
            self.until_ended(*alive)
            self.do(self.launcher.close())
        finally:
            self._runner.close()
            self.marey.close()


def processes_of(name: str) -> list[psutil.Process]:
    """Return the worker processes with this name, without their children."""
    found: dict[int, psutil.Process] = {}
    for process in psutil.process_iter(["cmdline", "ppid", "status"]):
        command = process.info["cmdline"] or []
        is_worker = bool({"marey_worker", "worker"} & set(command)) and name in command
        if is_worker and process.info["status"] != psutil.STATUS_ZOMBIE:
            found[process.pid] = process
    # A child that has not loaded its own program yet has the arguments of its parent.
    return [process for process in found.values() if process.info["ppid"] not in found]


class LauncherContract:
    """Tests that every launcher must pass; each subclass defines the fixture `make_launcher`."""

    @pytest.fixture(scope="class")
    @classmethod
    def server(cls, tmp_path_factory: pytest.TempPathFactory) -> Iterator[ServerProcess]:
        folder = tmp_path_factory.mktemp("launching")
        server = ServerProcess(folder, PYTHONPATH=python_path(), **QUICK_LEASES).start()
        with server.client() as marey:
            marey.create_project(ProjectCreate(name="lab"))
        yield server
        assert server.stop() == 0

    @pytest.fixture
    def engine(
        self,
        server: ServerProcess,
        make_launcher: Callable[[LaunchContext], Launcher],
        tmp_path: Path,
        monkeypatch: pytest.MonkeyPatch,
    ) -> Iterator[Engine]:
        monkeypatch.setenv("PYTHONPATH", python_path())
        engine = Engine(server, make_launcher, tmp_path)
        yield engine
        engine.close()

    def test_every_worker_is_listed_and_runs_a_job(self, engine: Engine, tmp_path: Path) -> None:
        names = engine.start(2, key="k1")
        assert len(set(names)) == 2
        assert all("k1" in name for name in names)
        assert set(names) <= engine.states().keys()
        jobs = [engine.submit("wait", tmp_path / str(number)) for number in range(2)]
        for number in range(2):
            engine.until((tmp_path / str(number) / "started").exists)
        workers = {attempt.worker for job in jobs for attempt in engine.marey.jobs.attempts(job.id)}
        assert workers == set(names)
        engine.until_running()
        for number in range(2):
            (tmp_path / str(number) / "go").touch()
        for job in jobs:
            assert present(engine.marey.jobs.wait(job.id).result)["waited"]

    def test_a_worker_that_is_stopped_returns_its_job(self, engine: Engine, tmp_path: Path) -> None:
        (name,) = engine.start(1, key="k2")
        job = engine.submit("wait", tmp_path / "job")
        engine.until((tmp_path / "job" / "started").exists)
        engine.do(engine.launcher.stop((name,)))
        engine.until_ended(name)
        (attempt,) = engine.marey.jobs.attempts(job.id)
        assert (attempt.worker, attempt.outcome) == (name, "interrupted")
        returned = engine.marey.jobs.get(job.id)
        assert (returned.state, returned.interruptions, returned.attempt) == ("queued", 1, 0)
        assert engine.end_of(name).reason == "stopped"
        engine.do(engine.launcher.stop((name, "crew-unknown-1")))
        engine.marey.jobs.cancel(job.id)

    def test_the_death_of_a_worker_is_explained(self, engine: Engine) -> None:
        (name,) = engine.start(1, key="k3")
        engine.until_running()
        assert engine.do(engine.launcher.why_ended(name)) is None
        (process,) = processes_of(name)
        os.kill(process.pid, signal.SIGKILL)
        end = engine.end_of(name)
        assert (end.reason, end.status) == ("killed", -signal.SIGKILL)

    def test_the_job_of_a_worker_that_was_killed_is_run_again_and_published_once(
        self, engine: Engine, tmp_path: Path
    ) -> None:
        engine.start(2, key="k7")
        job = engine.submit("wait", tmp_path / "job")
        engine.until((tmp_path / "job" / "started").exists)
        (first,) = engine.marey.jobs.attempts(job.id)
        (worker,) = processes_of(first.worker)
        worker.kill()
        (tmp_path / "job" / "go").touch()
        engine.until(lambda: engine.marey.jobs.get(job.id).state == "succeeded")
        outcomes = [attempt.outcome for attempt in engine.marey.jobs.attempts(job.id)]
        assert outcomes == ["lost", "succeeded"]
        assert engine.end_of(first.worker).reason == "killed"

    def test_a_start_that_is_repeated_starts_nothing_twice(self, engine: Engine) -> None:
        names = engine.start(2, key="k4")
        assert engine.start(2, key="k4") == names
        engine.until_running()
        assert engine.start(2, key="k4") == names
        other = engine.start(1, key="k5")
        engine.until_running()
        assert not set(other) & set(names)
        assert {name: len(processes_of(name)) for name in (*names, *other)} == dict.fromkeys((*names, *other), 1)

    @pytest.fixture
    def new_processes(self) -> None:
        """Let the launcher start new processes, of which `/proc` shows the variables, instead of forked ones."""

    @pytest.mark.usefixtures("new_processes")
    def test_the_token_is_in_no_argument_variable_or_log(self, engine: Engine, tmp_path: Path) -> None:
        (name,) = engine.start(1, key="k6")
        job = engine.submit("wait", tmp_path / "job")
        engine.until((tmp_path / "job" / "started").exists)
        (worker,) = processes_of(name)
        family = [worker, *worker.children(recursive=True)]
        assert len(family) > 1
        for process in family:
            shown = (
                Path(f"/proc/{process.pid}/cmdline").read_bytes() + Path(f"/proc/{process.pid}/environ").read_bytes()
            )
            assert engine.token.encode() not in shown
        (tmp_path / "job" / "go").touch()
        engine.marey.jobs.wait(job.id)
        engine.do(engine.launcher.stop((name,)))
        engine.until_ended(name)
        private = engine.context.token_file
        for file in (file for file in tmp_path.rglob("*") if file.is_file() and file != private):
            assert engine.token.encode() not in file.read_bytes(), file
        assert private.stat().st_mode & 0o077 == 0
