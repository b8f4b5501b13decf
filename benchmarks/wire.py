"""HTTP/1.1 over a plain socket, with so little code that the load generator hardly affects the measurement."""

from __future__ import annotations

import json
import socket
from types import TracebackType
from typing import Any, Self

_RECEIVE_BYTES = 64 * 1024


class Connection:
    """One keep-alive connection that sends a bearer token. It can read only answers with a Content-Length."""

    def __init__(self, port: int, token: str) -> None:
        self._socket = socket.create_connection(("127.0.0.1", port))
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._token = token
        self._buffer = bytearray(_RECEIVE_BYTES)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._socket.close()

    def head(self, method: str, path: str, *, length: int = 0, token: str | None = None, **headers: str) -> bytes:
        """Return the head of a request; the same head may be sent many times."""
        fields = {"Host": "127.0.0.1", "Authorization": f"Bearer {token or self._token}"}
        fields |= {name.replace("_", "-"): text for name, text in headers.items()}
        if length or method != "GET":
            fields["Content-Length"] = str(length)
        lines = [f"{method} /api/v1{path} HTTP/1.1", *(f"{name}: {text}" for name, text in fields.items())]
        return ("\r\n".join(lines) + "\r\n\r\n").encode()

    def exchange(self, request: bytes) -> memoryview:
        """Send a request and return a view of the answer's body, which is valid until the next request.

        Raises `RuntimeError` if the status is not a success.
        """
        self._socket.sendall(request)
        received = self._socket.recv_into(self._buffer)
        while (end := self._buffer.find(b"\r\n\r\n", 0, received)) < 0:
            more = self._socket.recv_into(memoryview(self._buffer)[received:])
            if not more:
                raise RuntimeError("the server closed the connection")
            received += more
        head = bytes(self._buffer[:end])
        start, stop = end + 4, end + 4 + _content_length(head)
        if stop > len(self._buffer):
            self._buffer.extend(bytes(stop - len(self._buffer)))
        while received < stop:
            rest = memoryview(self._buffer)[received:stop]
            more = self._socket.recv_into(rest, len(rest), socket.MSG_WAITALL)
            if not more:
                raise RuntimeError("the server closed the connection")
            received += more
        body = memoryview(self._buffer)[start:stop]
        if head[9:10] != b"2":
            raise RuntimeError(f"{head.splitlines()[0].decode()}: {bytes(body[:500]).decode()}")
        return body

    def call(self, path: str, document: Any, token: str | None = None) -> Any:
        """Send a JSON document by POST, and return the JSON of the answer."""
        body = json.dumps(document).encode()
        head = self.head("POST", path, length=len(body), token=token, Content_Type="application/json")
        return json.loads(bytes(self.exchange(head + body)))


def _content_length(head: bytes) -> int:
    for line in head.split(b"\r\n")[1:]:
        name, _, text = line.partition(b":")
        if name.lower() == b"content-length":
            return int(text)
    raise RuntimeError(f"an answer without Content-Length: {head.decode()}")
