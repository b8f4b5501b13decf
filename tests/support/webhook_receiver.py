"""HTTP servers that receive the requests of webhooks and record them."""

from __future__ import annotations

import base64
import hmac
import json
import ssl
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest
from tests.support.patience import PATIENCE_S

SELF_SIGNED = """\
-----BEGIN PRIVATE KEY-----
MIGHAgEAMBMGByqGSM49AgEGCCqGSM49AwEHBG0wawIBAQQghyQlcVgLq5JbtYST
rjT7sulir6UUVdGqk72Oejb1ah2hRANCAATRlc73OXqdi3JdSvBP6iDFNw4giWlM
vjYTRi5e7lGIQHBdZrBT0eLzUs9rFEPt8ZZgJxFbZAlEHPlZERvIEctU
-----END PRIVATE KEY-----
-----BEGIN CERTIFICATE-----
MIIBkDCCATagAwIBAgIUWfJSjSFJuFoRy8OuWMrwKRo9v/YwCgYIKoZIzj0EAwIw
FDESMBAGA1UEAwwJMTI3LjAuMC4xMCAXDTI2MTEyNDIzNDA0M1oYDzIxMjYxMDMx
MjM0MDQzWjAUMRIwEAYDVQQDDAkxMjcuMC4wLjEwWTATBgcqhkjOPQIBBggqhkjO
PQMBBwNCAATRlc73OXqdi3JdSvBP6iDFNw4giWlMvjYTRi5e7lGIQHBdZrBT0eLz
Us9rFEPt8ZZgJxFbZAlEHPlZERvIEctUo2QwYjAdBgNVHQ4EFgQUtjwRSrD5JOHj
zBj4lEwwTLIvJOowHwYDVR0jBBgwFoAUtjwRSrD5JOHjzBj4lEwwTLIvJOowDwYD
VR0TAQH/BAUwAwEB/zAPBgNVHREECDAGhwR/AAABMAoGCCqGSM49BAMCA0gAMEUC
IQCXA6VAHlmloaSzEU1Z26+aNoj8t5YTwokj2CZuq88mRQIgO0bgCMX9rHuaRWFT
KJr2O8GJlqONEqbhOT46ZXvv/OM=
-----END CERTIFICATE-----
"""
"""Self-signed certificate of 127.0.0.1, and its private key, which is used only here."""


@dataclass
class Received:
    """Request that a receiver got."""

    headers: dict[str, str]
    body: bytes

    @property
    def message(self) -> dict[str, Any]:
        return dict(json.loads(self.body))

    def is_signed_with(self, secret: str) -> bool:
        """Return whether one of the signatures of the request was made with `secret`."""
        key = base64.b64decode(secret.removeprefix("whsec_"))
        signed = f"{self.headers['webhook-id']}.{self.headers['webhook-timestamp']}.".encode() + self.body
        expected = "v1," + base64.b64encode(hmac.new(key, signed, "sha256").digest()).decode()
        return expected in self.headers["webhook-signature"].split()


@dataclass
class Receiver:
    """HTTP server that records requests, and answers with `status`; if it is `silent`, it never answers."""

    status: int = 204
    silent: bool = False
    answer: bytes = b""
    headers: dict[str, str] = field(default_factory=dict)
    certificate: Path | None = None
    """File with a certificate and its key, for https."""
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
                if receiver.silent:
                    threading.Event().wait()  # until the test process ends
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

            def log_message(self, format: str, *_args: Any) -> None:  # noqa: A002
                pass

        server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        if receiver.certificate is not None:
            context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
            context.load_cert_chain(receiver.certificate)
            server.socket = context.wrap_socket(server.socket, server_side=True)
        servers.append(server)
        threading.Thread(target=server.serve_forever, daemon=True).start()
        scheme = "http" if receiver.certificate is None else "https"
        receiver.url = f"{scheme}://127.0.0.1:{server.server_address[1]}/hook"
        return receiver

    yield start
    for server in servers:
        server.shutdown()
        server.server_close()
