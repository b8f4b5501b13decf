"""Rules for launchers, checked for worker processes on the machine of the server."""

import json
import os
import signal
import time
from collections.abc import Callable
from pathlib import Path

import psutil
import pytest
from tests.support.attached_worker import python_path
from tests.support.forked_programs import start_program
from tests.support.launcher_contract import LABELS, Engine, LauncherContract, processes_of
from tests.support.patience import PATIENCE_S
from tests.support.present import present
from tests.support.server_process import ServerProcess

from marey_schemas.access import ProjectCreate
from marey_schemas.queue.jobs import JobCreate
from marey_server.launchers import local
from marey_server.launchers.launcher import LaunchContext, Launcher, LauncherUnusable
from marey_server.launchers.local import LocalLauncher
from marey_server.process import programs


class TestLocalLauncher(LauncherContract):
    @pytest.fixture
    def make_launcher(self) -> Callable[[LaunchContext], Launcher]:
        return LocalLauncher

    @pytest.fixture(autouse=True)
    def forked_workers(self, request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
        """Fork the workers, unless a test needs new processes."""
        if "new_processes" not in request.fixturenames:
            monkeypatch.setattr(programs, "start_program", start_program)

    def test_a_worker_that_was_killed_is_started_again(self, engine: Engine) -> None:
        (name,) = engine.start(1, key="k7")
        engine.until_running()
        (first,) = processes_of(name)
        os.kill(first.pid, signal.SIGKILL)
        second = engine.until(lambda: [one for one in processes_of(name) if one.pid != first.pid])
        assert len(second) == 1

    def test_a_worker_that_ignores_sigterm_is_killed(self, engine: Engine, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(local, "STOP_S", 0.2)
        (name,) = engine.start(1, key="k8")
        engine.until_running()
        (worker,) = processes_of(name)
        worker.suspend()
        engine.do(engine.launcher.stop((name,)))
        engine.until_ended(name)
        assert not psutil.pid_exists(worker.pid)

    def test_a_pool_grows_for_a_job_and_shrinks_when_it_has_nothing_to_do(self, tmp_path: Path) -> None:
        pool = {"name": "own", "most": 2, "kinds": ["add"], "labels": LABELS, "idle_s": 1}
        server = ServerProcess(tmp_path, MAREY_POOLS=json.dumps([pool]), PYTHONPATH=python_path()).start()
        try:
            with server.client() as marey:
                marey.create_project(ProjectCreate(name="lab"))
                job = JobCreate(kind="add", params={"a": 1, "b": 2}, labels=LABELS)
                ended = marey.jobs.wait(marey.jobs.submit("lab", job).id, timeout_s=PATIENCE_S)
                assert present(ended.result)["sum"] == 3
                (attempt,) = marey.jobs.attempts(ended.id)
            assert attempt.worker.startswith("own-")
            deadline = time.monotonic() + PATIENCE_S
            while processes_of(attempt.worker):
                assert time.monotonic() < deadline, "the worker has nothing to do and still runs"
                time.sleep(0.2)
        finally:
            assert server.stop() == 0
        assert "pool own: stopping 1 workers that have no jobs" in server.log.read_text()


def test_options_are_refused(tmp_path: Path) -> None:
    with pytest.raises(
        LauncherUnusable, match="options of the launcher local: partition: there is no field of this name"
    ):
        LocalLauncher(LaunchContext("crew", "http://x", "t", tmp_path, "text", "info", {"partition": "gpu"}))
