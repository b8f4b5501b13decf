"""Worker processes of the test: real workers that kill or stop themselves at a named point of a job."""

from __future__ import annotations

import importlib.util
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

from marey_client.errors import MissingPackage
from marey_client.load.scratch import KIND, LABEL, Scratch
from marey_schemas.queue.worker_protocol import FAULT_VARIABLE

STATE_EVERY_S = 0.1


class WorkerFault(NamedTuple):
    """Point of a job at which a worker process kills or stops itself, and the action: `kill` or `stop`."""

    point: str
    action: str

    def __str__(self) -> str:
        verb = {"kill": "killed", "stop": "paused"}[self.action]
        return f"worker {verb} {self.point.removeprefix('worker.').replace('_', ' ')}"


WORKER_FAULTS = (
    WorkerFault("worker.after_claim", "kill"),
    WorkerFault("worker.after_blob", "kill"),
    WorkerFault("worker.before_complete", "kill"),
    WorkerFault("worker.after_complete", "kill"),
    WorkerFault("worker.before_complete", "stop"),
)


class WorkerProcess:
    """A worker process that claims jobs of the scratch project only, since its token is bound to this project."""

    def __init__(self, scratch: Scratch, folder: Path, fault: WorkerFault | None) -> None:
        environment = {name: text for name, text in os.environ.items() if not name.startswith("MAREY_")}
        environment["TMPDIR"] = str(folder)  # a killed worker cannot remove its temporary folders
        if fault is not None:
            environment[FAULT_VARIABLE] = f"{fault.point}:{fault.action}"
        label = f"{LABEL}={scratch.project.name}"
        command = [sys.executable, "-m", "marey_worker", "--attached", "--server", scratch.url, "--kind", KIND]
        self._process = subprocess.Popen(  # noqa: S603 - our own interpreter and module
            [*command, "--label", label, "--cache", str(folder)],
            env=environment, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
            start_new_session=True,
        )  # fmt: skip
        if self._process.stdin is None:
            raise AssertionError("the worker has no standard input")
        self._process.stdin.write(f"{scratch.token}\n".encode())
        self._process.stdin.flush()

    def wait_for_fault(self, seconds: float) -> bool:
        """Wait until the process has died or is stopped; return False if neither happens within `seconds`."""
        deadline = time.monotonic() + seconds
        while time.monotonic() < deadline:
            if self._process.poll() is not None or self._is_stopped():
                return True
            time.sleep(STATE_EVERY_S)
        return False

    def resume(self) -> None:
        """Let a stopped process continue."""
        if self._process.poll() is None:
            self._process.send_signal(signal.SIGCONT)

    def end(self) -> None:
        """Kill the process and its children, which are in its process group."""
        if self._process.poll() is None:
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()
        if self._process.stdin is not None:
            self._process.stdin.close()

    def _is_stopped(self) -> bool:
        """Return whether the process is stopped; because of `WNOWAIT`, a later call sees this state again."""
        found = os.waitid(os.P_PID, self._process.pid, os.WSTOPPED | os.WNOHANG | os.WNOWAIT)
        return found is not None and found.si_code == os.CLD_STOPPED


class WorkerProcesses:
    """Worker processes of a test, which are started one by one and killed together."""

    def __init__(self, scratch: Scratch, folder: Path) -> None:
        self._scratch, self._folder = scratch, folder
        self._started: list[WorkerProcess] = []

    def start(self, fault: WorkerFault | None = None) -> WorkerProcess:
        """Start a worker process, which kills or stops itself as `fault` says; without `fault`, it does neither."""
        made = WorkerProcess(self._scratch, self._folder, fault)
        self._started.append(made)
        return made

    def end(self) -> None:
        """Kill all worker processes."""
        for one in self._started:
            one.end()


@contextmanager
def worker_processes(scratch: Scratch) -> Iterator[WorkerProcesses]:
    """Yield an object that starts worker processes; all of them are killed at the end of the `with` block."""
    if importlib.util.find_spec("marey_worker") is None:
        raise MissingPackage("the test starts workers, which are not installed; run: pip install 'marey[worker]'")
    with tempfile.TemporaryDirectory(prefix="marey-chaos-") as folder:
        processes = WorkerProcesses(scratch, Path(folder))
        try:
            yield processes
        finally:
            processes.end()
