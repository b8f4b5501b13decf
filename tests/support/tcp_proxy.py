"""A loopback TCP proxy with faults on demand: block one direction, cut connections, lose an answer."""

from __future__ import annotations

import contextlib
import selectors
import socket
import threading
from typing import Self, cast


class TcpProxy:
    """Forwards connections to `target_port` on the loopback interface.

    While the event `drop_requests` is set, all bytes to the server are discarded; while `drop_answers` is set, all
    bytes to the client. `lose_answers` closes connections when the server begins to answer: the server has done the
    work, but the client gets no answer.
    """

    def __init__(self, target_port: int) -> None:
        self.target_port = target_port
        self.drop_requests = threading.Event()
        self.drop_answers = threading.Event()
        self.lost = 0
        self._lose: tuple[bytes, int] = (b"", 0)
        self._losing = threading.Lock()
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port: int = self._listener.getsockname()[1]
        self._stopping = threading.Event()
        self._threads: list[threading.Thread] = []
        self._open: set[socket.socket] = set()

    def __enter__(self) -> Self:
        accepting = threading.Thread(target=self._accept, daemon=True)
        accepting.start()
        self._threads.append(accepting)
        return self

    def __exit__(self, *_exc: object) -> None:
        self._stopping.set()
        self._listener.close()
        for thread in self._threads:
            thread.join(5)

    def lose_answers(self, text: bytes, count: int) -> None:
        """Lose the next `count` answers to requests that contain `text`; `lost` counts them."""
        with self._losing:
            self._lose = text, self.lost + count

    def cut(self) -> None:
        """Close all connections, as a router does that forgets them."""
        for one in self._open.copy():
            with contextlib.suppress(OSError):
                one.shutdown(socket.SHUT_RDWR)

    def _loses(self, request: bytes) -> bool:
        with self._losing:
            text, most = self._lose
            loses = self.lost < most and text in request
            self.lost += loses
            return loses

    def _accept(self) -> None:
        self._listener.settimeout(0.2)
        while not self._stopping.is_set():
            try:
                client, _ = self._listener.accept()
            except TimeoutError:
                continue
            except OSError:
                return
            thread = threading.Thread(target=self._forward, args=(client,), daemon=True)
            thread.start()
            self._threads.append(thread)

    def _forward(self, client: socket.socket) -> None:
        with (
            contextlib.ExitStack() as leaving,
            client,
            contextlib.suppress(OSError),
            socket.create_connection(("127.0.0.1", self.target_port), 5) as server,
        ):
            leaving.callback(self._open.discard, client)
            self._open.add(client)
            selector = selectors.DefaultSelector()
            selector.register(client, selectors.EVENT_READ, (server, self.drop_requests))
            selector.register(server, selectors.EVENT_READ, (client, self.drop_answers))
            request = b""
            while not self._stopping.is_set():
                for key, _ in selector.select(0.2):
                    peer, dropping = key.data
                    data = cast(socket.socket, key.fileobj).recv(65536)
                    if not data:
                        return
                    if key.fileobj is client:
                        request += data
                    elif self._loses(request):
                        return
                    else:
                        request = b""
                    if not dropping.is_set():
                        peer.sendall(data)
