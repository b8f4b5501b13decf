"""HTTP servers that receive the requests of webhooks and record them."""

from __future__ import annotations

import base64
import hmac
import json
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

import pytest

PATIENCE_S = 60.0


@dataclass
class Received:
    """Request that a receiver got."""

    headers: dict[str, str]
    body: bytes

    @property
    def message(self) -> dict[str, Any]:
        return dict(json.loads(self.body))

    def is_signed_with(self, secret: str) -> bool:
        """Return whether one of the signatures is that of a secret."""
        key = base64.b64decode(secret.removeprefix("whsec_"))
        signed = f"{self.headers['webhook-id']}.{self.headers['webhook-timestamp']}.".encode() + self.body
        expected = "v1," + base64.b64encode(hmac.new(key, signed, "sha256").digest()).decode()
        return expected in self.headers["webhook-signature"].split()


@dataclass
class Receiver:
    """HTTP server that records requests, and answers with `status` after `delay_s`."""

    status: int = 204
    delay_s: float = 0.0
    answer: bytes = b""
    headers: dict[str, str] = field(default_factory=dict)
    received: list[Received] = field(default_factory=list)
    url: str = ""
    changed: threading.Condition = field(default_factory=threading.Condition)

    @property
    def kinds(self) -> list[str]:
        return [one.message["kind"] for one in self.received]

    def wait_for(self, condition: Callable[[list[Received]], bool]) -> list[Received]:
        """Wait until the requests meet a condition, and return them."""
        with self.changed:
            assert self.changed.wait_for(lambda: condition(self.received), PATIENCE_S), self.received
            return list(self.received)


Open = Callable[..., Receiver]
"""Function that starts a receiver with the given fields."""


@pytest.fixture
def open_receiver() -> Iterator[Open]:
    """Function that starts a receiver on this machine."""
    servers: list[ThreadingHTTPServer] = []

    def start(**kwargs: Any) -> Receiver:
        receiver = Receiver(**kwargs)

        class Handler(BaseHTTPRequestHandler):
            def do_POST(self) -> None:
                body = self.rfile.read(int(self.headers["Content-Length"]))
                time.sleep(receiver.delay_s)
                status = receiver.status
                with receiver.changed:
                    receiver.received.append(Received({k.lower(): v for k, v in self.headers.items()}, body))
                    receiver.changed.notify_all()
                self.send_response(status)
                for name, value in receiver.headers.items():
                    self.send_header(name, value)
                self.send_header("Content-Length", str(len(receiver.answer)))
                self.end_headers()
                self.wfile.write(receiver.answer)

            def log_message(self, *_args: Any) -> None:
                pass

        server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        servers.append(server)
        threading.Thread(target=server.serve_forever, daemon=True).start()
        receiver.url = f"http://127.0.0.1:{server.server_address[1]}/hook"
        return receiver

    yield start
    for server in servers:
        server.shutdown()
        server.server_close()
