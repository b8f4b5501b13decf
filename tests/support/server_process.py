"""A real `marey serve` in a separate process, which tests can kill, stop and start again with the same data."""

from __future__ import annotations

import contextlib
import os
import random
import signal
import socket
import subprocess
import time
from collections.abc import Iterator, Sequence
from contextlib import closing
from pathlib import Path
from typing import Self

import httpx
from tests.support.forked_programs import ForkedProgram, nursery

from marey_client import Marey
from marey_client.retries import ONCE, Retries
from marey_server.app import connect_database
from marey_server.process.settings import Settings
from marey_server.store.fsck import check_store

PORTS = range(20_000, 30_000)
READY_S = 120.0
"""Longest wait in seconds until a server is ready, or a process has ended; long, because the machine may be busy."""

PATIENT = Retries(tries=400, first_s=0.1, longest_s=1.0, total_s=1.5 * READY_S)
"""Retries that last longer than the slowest allowed restart of a server."""
QUICK_LEASES = {"MAREY_LEASE_TTL_S": "3", "MAREY_HEARTBEAT_S": "0.5", "MAREY_CANCEL_GRACE_S": "2"}


class MareyProcess:
    """A process with its own environment; `log` is the file of its output."""

    own_children = False
    """Whether the child processes are started as new programs instead of forked, so that they share no memory."""

    def __init__(self, log: Path) -> None:
        self.log = log
        self.process: ForkedProgram | None = None

    def spawn(self, arguments: list[str], environment: dict[str, str], stdin: bytes | None = None) -> None:
        """Start the program; `stdin` is written to it and kept open."""
        surroundings = {name: text for name, text in os.environ.items() if not name.startswith("MAREY_")}
        with self.log.open("ab") as log:
            self.process = nursery().start(
                arguments,
                surroundings | environment,
                output=log.fileno(),
                with_stdin=stdin is not None,
                own_children=self.own_children,
            )
        if stdin is not None:
            assert self.process.stdin is not None
            self.process.stdin.write(stdin)
            self.process.stdin.flush()

    def send(self, number: signal.Signals) -> None:
        """Send a signal."""
        assert self.process is not None
        self.process.send_signal(number)

    def kill(self) -> None:
        """Kill the process."""
        assert self.process is not None
        with contextlib.suppress(ProcessLookupError):
            self.process.kill()
        self.process.wait(READY_S)

    def wait_until_dead(self, seconds: float = READY_S) -> int:
        """Wait until the process has ended without a signal from the test; return its exit status."""
        assert self.process is not None
        return self.process.wait(seconds)

    def stop(self) -> int | None:
        """Stop the server with SIGTERM if it is running; return the exit status, or None if it was never started."""
        if self.process is None:
            return None
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGCONT)
            self.process.terminate()
        try:
            return self.process.wait(READY_S)
        except subprocess.TimeoutExpired:
            self.kill()
            raise


class ServerProcess(MareyProcess):
    """`marey serve` on its own port, with the variables in `environment`."""

    def __init__(self, folder: Path, database_url: str | None = None, **environment: str) -> None:
        super().__init__(folder / "server.log")
        self.worker: WorkerProcess | None = None
        """The worker that `serving` has started."""
        self.data = folder / "data"
        self.port = reserved_port()
        self.url = f"http://127.0.0.1:{self.port}"
        self._settings = Settings(data=self.data, database_url=database_url, blobs="database")
        own = {"MAREY_DATA": str(self.data), "MAREY_PORT": str(self.port), "MAREY_WARM_UP": "false"}
        self.environment = own | environment
        if database_url is not None:
            self.environment["MAREY_DATABASE_URL"] = database_url

    def start(self, *, workers: int = 0, fault: str | None = None) -> Self:
        """Start the server, wait until it is ready, and return this object."""
        environment = self.environment | ({"MAREY_FAULT": fault} if fault else {})
        self.spawn(["marey_client.cli", "serve", "--workers", str(workers)], environment)
        assert self.process is not None
        deadline = time.monotonic() + READY_S
        with httpx.Client(verify=False) as asking:  # reading certificates each time takes the server's time
            while time.monotonic() < deadline:
                assert self.process.poll() is None, f"the server ended:\n{self.log.read_text()[-3000:]}"
                with contextlib.suppress(httpx.TransportError):
                    if asking.get(f"{self.url}/readyz", timeout=5).status_code == 200:
                        return self
                time.sleep(0.05)
        raise AssertionError(f"the server is not ready:\n{self.log.read_text()[-3000:]}")

    @property
    def token(self) -> str:
        """The token of the first administrator."""
        return (self.data / "admin.token").read_text().strip()

    def client(self, *, patient: bool = True, port: int | None = None) -> Marey:
        """Return an administrator's client; with `patient`, its retries last longer than a restart of the server."""
        url = f"http://127.0.0.1:{port}" if port else self.url
        return Marey(url, self.token, retries=PATIENT if patient else ONCE)

    def check_database(self) -> None:
        """Fail if `marey db fsck` finds a defect."""
        with closing(connect_database(self._settings)) as database:
            findings = list(check_store(database))
        assert not findings, "\n".join(map(str, findings))


class WorkerProcess(MareyProcess):
    """`python -m marey_worker`, started separately, so that it survives the end of the server."""

    def __init__(self, log: Path, **environment: str) -> None:
        super().__init__(log)
        self.environment = environment

    def start(
        self, url: str, token: str, folder: Path, *, name: str, fault: str | None = None, kinds: Sequence[str] = ()
    ) -> Self:
        """Start the worker, and return this object.

        The worker connects to the server without further help of the test. It runs and loads only jobs of `kinds`, if
        any are given.
        """
        environment = self.environment | ({"MAREY_FAULT": fault} if fault else {})
        arguments = ["marey_worker", "--attached", "--server", url, "--name", name, "--cache", str(folder / "cache")]
        arguments += [word for kind in kinds for word in ("--kind", kind)]
        self.spawn(arguments, environment, stdin=f"{token}\n".encode())
        return self


@contextlib.contextmanager
def serving(folder: Path, database_url: str | None = None, **environment: str) -> Iterator[ServerProcess]:
    """Run a server with one worker while the `with` block runs; then check the server's exit status.

    Unlike a worker that the server starts, this worker is forked, and so are its children. They need not import their
    modules, which takes a few seconds of processor time.
    """
    process = ServerProcess(folder, database_url, **environment).start()
    worker = process.worker = WorkerProcess(folder / "worker.log", **environment)
    try:
        worker.start(process.url, process.token, folder, name="worker")
        yield process
    finally:
        try:
            worker.stop()
        finally:
            status = process.stop()
    assert status == 0, process.log.read_text()[-3000:]


_RESERVED: list[socket.socket] = []


def reserved_port() -> int:
    """Return a port for a server that is restarted on the same port; no other test gets it while this process runs.

    The system never gives ports of this range to sockets that ask for any free port. A datagram socket that is bound to
    the port reserves the port among test processes, and does not disturb the server.
    """
    for port in random.SystemRandom().sample(PORTS, 100):
        reserving, probe = socket.socket(type=socket.SOCK_DGRAM), socket.socket()
        with contextlib.closing(probe):
            try:
                reserving.bind(("127.0.0.1", port))
                probe.bind(("127.0.0.1", port))
            except OSError:
                reserving.close()
                continue
        _RESERVED.append(reserving)
        return port
    raise AssertionError(f"no port of {PORTS} is free")
