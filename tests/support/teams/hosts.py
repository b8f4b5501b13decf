"""Servers for the random programs of `machine`: in this process, or in processes that die at a chosen step."""

from __future__ import annotations

import contextlib
import json
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any

import httpx
from tests.support.rest_server import running
from tests.support.server_process import reserved_port
from tests.support.teams import mortal_servers
from tests.support.teams.mortal_servers import COUNTER, FIRED, Countdown

from marey_client import Marey
from marey_client.retries import Retries
from marey_server.store.database.connections import Database

RETRIES = Retries(tries=8, first_s=0.001, longest_s=0.05, total_s=240.0)


class Host:
    """A running server; `database` is the test's own connection to its database."""

    def __init__(self, url: str, database: Database) -> None:
        self.url = url
        self.database = database

    def arm(self, steps: int) -> None:
        """Let the server die `steps` steps from now. Do nothing for a server in this process, which cannot die."""

    def disarm(self) -> bool:
        """Cancel the planned death of the server.

        If it has died already, start it again; return whether it had died.
        """
        return False

    def client(self, token: str) -> tuple[Marey, Line]:
        """Return a client of the server, and the transport of this client."""
        line = Line(self)
        return Marey(self.url, token, retries=RETRIES, http=line), line


class MortalHost(Host):
    """A server in a process of its own, which can die."""

    def __init__(self, database: Database, url: str, folder: Path, nursery: Nursery) -> None:
        port = reserved_port()
        super().__init__(f"http://127.0.0.1:{port}", database)
        folder.mkdir(exist_ok=True)
        counter = folder / "counter"
        counter.write_bytes(COUNTER.pack(0))
        self._countdown = Countdown(counter)
        self._order = {"data": str(folder), "port": port, "database_url": url, "counter": str(counter)}
        self._nursery = nursery
        self._reviving = threading.Lock()
        self._died = False
        nursery.start(self._order)

    def arm(self, steps: int) -> None:
        self._died = False
        self._countdown.left = steps

    def disarm(self) -> bool:
        self._countdown.cancel()
        self.revive()
        return self._died

    def revive(self) -> None:
        """Start the server again if it has died."""
        with self._reviving:
            if self._countdown.left == FIRED:
                self._died = True
                self._countdown.left = 0
                self._nursery.start(self._order)


class Nursery:
    """The process that forks servers."""

    def __init__(self, log: Path) -> None:
        self._log = log
        with log.open("ab") as file:
            self._process = subprocess.Popen(
                [sys.executable, mortal_servers.__file__],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=file,
                text=True,
            )

    def start(self, order: dict[str, Any]) -> None:
        """Start a server, or start it again."""
        orders, answers = self._streams
        orders.write(json.dumps(order) + "\n")
        orders.flush()
        assert answers.readline().strip(), f"no server was started:\n{self._log.read_text()[-3000:]}"

    def close(self) -> None:
        """Kill all servers."""
        for stream in self._streams:
            stream.close()
        self._process.wait(60)

    @property
    def _streams(self) -> tuple[IO[str], IO[str]]:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        return self._process.stdin, self._process.stdout


class Line(httpx.BaseTransport):
    """Transport to a server, which loses answers on demand, and starts the server again after the server has died."""

    def __init__(self, host: Host) -> None:
        self.lose = 0
        """Number of answers to writes that will be lost, after the server has done the work."""
        self._host = host
        self._inner = httpx.HTTPTransport(limits=httpx.Limits(max_connections=32, max_keepalive_connections=4))

    def handle_request(self, request: httpx.Request) -> httpx.Response:
        """Send a request, and return the whole answer."""
        try:
            response = self._inner.handle_request(request)
            response.read()
        except httpx.TransportError:
            if isinstance(self._host, MortalHost):
                self._host.revive()
            raise
        if self.lose and request.method not in ("GET", "HEAD"):
            self.lose -= 1
            raise httpx.ReadError("the answer was lost", request=request)
        return response

    def close(self) -> None:
        """Close all connections."""
        self._inner.close()


@contextlib.contextmanager
def mortal_hosts(databases: dict[str, tuple[str, Database]], folder: Path) -> Iterator[dict[str, Host]]:
    """Run a server in a process of its own for each name; `databases` contains address and database by name."""
    nursery = Nursery(folder / "servers.log")
    try:
        yield {name: MortalHost(database, url, folder / name, nursery) for name, (url, database) in databases.items()}
    finally:
        nursery.close()


@contextlib.contextmanager
def local_hosts(databases: dict[str, tuple[str, Database]], folder: Path) -> Iterator[dict[str, Host]]:
    """Run a server in a thread of this process for each name; `databases` contains address and database by name."""
    with contextlib.ExitStack() as stack:
        yield {
            name: Host(stack.enter_context(running(database, folder / name)).address, database)
            for name, (_, database) in databases.items()
        }
