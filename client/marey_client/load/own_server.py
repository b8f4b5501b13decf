"""Server that a load test starts for itself, in its own process, with its data in a temporary folder."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from marey_client.credentials import read_secret
from marey_client.errors import MareyError
from marey_client.marey import Marey
from marey_client.retries import ONCE
from marey_schemas.address import ADMIN_TOKEN_FILE

START_S = 60.0
STOP_S = 40.0
LOOK_EVERY_S = 0.1
LISTENING = "listening on "
SHOWN_LOG = 2000
"""Number of characters of the log's end that an error shows."""


@contextmanager
def own_server(database_url: str | None = None, **settings: str) -> Iterator[Marey]:
    """Start a server without workers, yield an administrator's client, and stop the server afterwards.

    `database_url` names an empty Postgres database; otherwise, the server has an SQLite file in a temporary folder.
    `settings` are environment variables. Raises `MareyError` if the server does not start.
    """
    with tempfile.TemporaryDirectory(prefix="marey-bench-") as name:
        folder = Path(name)
        environment = {key: text for key, text in os.environ.items() if not key.startswith("MAREY_")}
        environment |= {"MAREY_DATA": str(folder / "data"), "MAREY_WARM_UP": "false", **settings}
        if database_url is not None:  # in the environment, since other users can read command lines
            environment["MAREY_DATABASE_URL"] = database_url
        command = [sys.executable, "-m", "marey_client.cli", "serve", "--workers", "0", "--port", "0"]
        with (folder / "server.log").open("wb") as log:
            process = subprocess.Popen(  # noqa: S603 - our own interpreter and module
                [*command, "--host", "127.0.0.1", "--log-form", "text"],
                cwd=folder, env=environment, stdin=subprocess.DEVNULL, stdout=log, stderr=log, start_new_session=True,
            )  # fmt: skip
        try:
            url = _address(process, folder / "server.log")
            with Marey(url, read_secret(folder / "data" / ADMIN_TOKEN_FILE)) as marey:
                yield marey
        finally:
            process.terminate()
            try:
                process.wait(STOP_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def _address(process: subprocess.Popen[bytes], log: Path) -> str:
    """Wait until the server is ready, and return its address, which it writes to its log."""
    deadline = time.monotonic() + START_S
    while time.monotonic() < deadline and process.poll() is None:
        text = log.read_text(encoding="utf-8", errors="replace")
        if LISTENING in text:
            url = text.partition(LISTENING)[2].split()[0]
            with Marey(url, retries=ONCE) as marey:
                marey.transport.send("GET", f"{url}/readyz")
            return url
        time.sleep(LOOK_EVERY_S)
    text = log.read_text(encoding="utf-8", errors="replace")
    raise MareyError(f"the server of the test did not start: {text[-SHOWN_LOG:].strip() or 'its log is empty'}")
