"""Rules for launchers, checked for worker processes on the machine of the server."""

import os
import signal
from collections.abc import Callable
from pathlib import Path

import psutil
import pytest
from tests.support.launcher_contract import Engine, LauncherContract, processes_of

from marey_server.launchers import local
from marey_server.launchers.launcher import LaunchContext, Launcher, LauncherUnusable
from marey_server.launchers.local import LocalLauncher


class TestLocalLauncher(LauncherContract):
    @pytest.fixture
    def make_launcher(self) -> Callable[[LaunchContext], Launcher]:
        return LocalLauncher

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


def test_options_are_refused(tmp_path: Path) -> None:
    with pytest.raises(LauncherUnusable, match="the launcher `local` has no options, but partition is given"):
        LocalLauncher(LaunchContext("crew", "http://x", "t", tmp_path, "text", "info", {"partition": "gpu"}))
