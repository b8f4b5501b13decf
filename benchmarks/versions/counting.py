"""Proxy between a client and a server that counts the bytes of both directions."""

from __future__ import annotations

import socket
import threading
from types import TracebackType
from typing import Self

_PIECE_BYTES = 256 * 1024


class CountingProxy:
    """Port of this machine that forwards connections to another port, and counts what is sent either way.

    The count includes requests, answers and their HTTP headers, but not the headers of TCP and IP.
    """

    def __init__(self, port: int) -> None:
        self._target = port
        self._listener = socket.create_server(("127.0.0.1", 0))
        self._lock = threading.Lock()
        self._counted = 0
        threading.Thread(target=self._accept, daemon=True).start()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._listener.close()

    @property
    def url(self) -> str:
        """The address to which a client connects."""
        return f"http://127.0.0.1:{self._listener.getsockname()[1]}"

    def take_count(self) -> int:
        """Return the number of bytes since the last call, and start again at 0."""
        with self._lock:
            counted, self._counted = self._counted, 0
            return counted

    def _accept(self) -> None:
        while True:
            try:
                caller, _ = self._listener.accept()
            except OSError:  # the listener was closed
                return
            server = socket.create_connection(("127.0.0.1", self._target))
            for one in (caller, server):
                one.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            for source, target in ((caller, server), (server, caller)):
                threading.Thread(target=self._forward, args=(source, target), daemon=True).start()

    def _forward(self, source: socket.socket, target: socket.socket) -> None:
        try:
            while piece := source.recv(_PIECE_BYTES):
                with self._lock:
                    self._counted += len(piece)
                target.sendall(piece)
            target.shutdown(socket.SHUT_WR)
        except OSError:  # one side has closed the connection
            source.close()
            target.close()
