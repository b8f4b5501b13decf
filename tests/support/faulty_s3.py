"""HTTP proxy in front of an S3 server that spoils chosen requests: errors, silence, lost answers, wrong bytes."""

from __future__ import annotations

import contextlib
import http.client
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

FAULTS = ("500", "503", "silence", "lost answer", "lost request", "truncated", "wrong bytes")


@dataclass
class FaultyS3:
    """Proxy at `endpoint`. `spoil` plans the faults of the next requests with an HTTP method; later requests pass."""

    port: int
    upstream_port: int
    planned: dict[str, list[str]] = field(default_factory=dict)
    seen: list[tuple[str, str]] = field(default_factory=list)
    """Method and path of each request."""
    authorizations: list[str | None] = field(default_factory=list)
    """The header Authorization of each request."""
    silent: threading.Semaphore = field(default_factory=lambda: threading.Semaphore(0))
    """Semaphore that is released once for each request without an answer."""
    go_on: threading.Event = field(default_factory=threading.Event)
    """Ends the silence of all requests."""

    @property
    def endpoint(self) -> str:
        return f"http://127.0.0.1:{self.port}"

    def spoil(self, method: str, *faults: str) -> None:
        """Plan the faults of the next requests with this method, in this order; each is one of `FAULTS`."""
        assert set(faults) <= set(FAULTS)
        self.planned.setdefault(method, []).extend(faults)

    def next_fault(self, method: str, path: str) -> str | None:
        """Record a request, and return its fault."""
        self.seen.append((method, path))
        waiting = self.planned.get(method)
        return waiting.pop(0) if waiting else None


@contextlib.contextmanager
def faulty_s3(upstream_port: int) -> Iterator[FaultyS3]:
    """Run a proxy in front of the S3 server at a local port while the `with` block runs."""

    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def handle_any(self) -> None:
            body = self.rfile.read(int(self.headers.get("Content-Length", 0)))
            proxy.authorizations.append(self.headers.get("Authorization"))
            fault = proxy.next_fault(self.command, self.path)
            if fault == "silence":
                proxy.silent.release()
                proxy.go_on.wait(60)
            if fault in ("silence", "lost request"):
                self.close_connection = True
                return
            if fault in ("500", "503"):
                self.answer(int(fault), {}, b"<Error><Code>InternalError</Code></Error>")
                return
            upstream = http.client.HTTPConnection("127.0.0.1", upstream_port, timeout=60)
            with contextlib.closing(upstream):
                upstream.putrequest(self.command, self.path, skip_host=True, skip_accept_encoding=True)
                for name, value in self.headers.items():
                    upstream.putheader(name, value)
                upstream.endheaders(body)
                response = upstream.getresponse()
                data = response.read()
                headers = {name: value for name, value in response.getheaders() if name.lower() not in HOP_BY_HOP}
            if fault == "lost answer":
                self.close_connection = True
                return
            if fault == "wrong bytes":
                data = bytes([data[0] ^ 1]) + data[1:]
            self.answer(response.status, headers, data[: len(data) // 2] if fault == "truncated" else data, len(data))
            self.close_connection = fault == "truncated"

        do_GET = do_PUT = do_POST = do_HEAD = do_DELETE = handle_any  # noqa: N815 - names of the base class

        def answer(self, status: int, headers: dict[str, str], data: bytes, length: int | None = None) -> None:
            self.send_response(status)
            if self.command != "HEAD":
                headers = {name: value for name, value in headers.items() if name.lower() != "content-length"}
                headers["Content-Length"] = str(len(data) if length is None else length)
            for name, value in headers.items():
                self.send_header(name, value)
            self.end_headers()
            if self.command != "HEAD":
                self.wfile.write(data)

        def log_message(self, format: str, *_: object) -> None:  # noqa: A002
            """Print nothing."""

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    server.daemon_threads = True
    proxy = FaultyS3(server.server_address[1], upstream_port)
    thread = threading.Thread(target=server.serve_forever, args=(0.05,))
    thread.start()
    try:
        yield proxy
    finally:
        proxy.go_on.set()
        server.shutdown()
        server.server_close()
        thread.join()


HOP_BY_HOP = {"connection", "date", "keep-alive", "server", "transfer-encoding"}
