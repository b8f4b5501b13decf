"""Tornado server that answers every request with the same bytes: an upper limit for the speed of Marey's server.

`python -m benchmarks.bare_server PORT BYTES`
"""

from __future__ import annotations

import asyncio
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress

import httpx
from tornado.web import Application, RequestHandler

from benchmarks.local_server import free_port

START_S = 30


class _Bytes(RequestHandler):
    body = b""

    def get(self) -> None:
        self.set_header("Content-Type", "application/octet-stream")
        self.write(self.body)

    def compute_etag(self) -> None:
        """Return None, so that Tornado does not hash the body: hashing would take longer than sending."""


async def _serve(port: int, size: int) -> None:
    _Bytes.body = os.urandom(size)
    Application([(".*", _Bytes)], log_function=lambda _handler: None).listen(port, "127.0.0.1")
    await asyncio.Event().wait()


@contextmanager
def bare_server(size: int) -> Iterator[int]:
    """Run the server in a process while the `with` block runs; yield the port of the server.

    `size` is the number of bytes of an answer.
    """
    port = free_port()
    process = subprocess.Popen([sys.executable, "-m", "benchmarks.bare_server", str(port), str(size)])
    try:
        deadline = time.monotonic() + START_S
        while time.monotonic() < deadline:
            with suppress(httpx.TransportError):
                httpx.get(f"http://127.0.0.1:{port}/")
                break
            time.sleep(0.05)
        yield port
    finally:
        process.terminate()
        process.wait()


if __name__ == "__main__":
    asyncio.run(_serve(int(sys.argv[1]), int(sys.argv[2])))
