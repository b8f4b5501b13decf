"""Connections of clients: the number of connections is limited, in total and for each address. A connection is closed
if its client does not read the answer. When a limit is reached, idle connections are closed in favour of new
connections. If no file descriptor is free, new connections wait.
"""

from __future__ import annotations

import asyncio
import errno
import logging
import socket
import sys
import time
from collections import Counter
from collections.abc import Awaitable, Callable, Collection, Iterable, Sequence
from typing import Any

from tornado.httpserver import HTTPServer
from tornado.iostream import IOStream, UnsatisfiableReadError
from tornado.netutil import bind_sockets

from marey_schemas.sizes import KIB
from marey_server.process.password_lanes import limited_address

log = logging.getLogger(__name__)

RESERVED_DESCRIPTORS = 256
"""Number of file descriptors that are kept for the database, files and child processes."""
MOST_CONNECTIONS = 10_000
ADDRESS_SHARE = 0.75
"""Largest share of all connections that one address (IPv6: one /64 network) may have; trusted proxies may have more."""
EVICTED_SHARE = 1 / 16
"""Greatest number of idle connections that are closed when a limit is reached.

The number is given as a share of the limit on all connections.
"""
ACCEPTED_AT_ONCE = 2
"""Number of connections accepted in one round of the event loop; then requests on open connections get their turn."""
PAUSE_S = 0.5
"""Time in seconds for which no connection is accepted after a failure for lack of descriptors or memory."""
LOG_EVERY_S = 60.0
CHECKS_PER_TIMEOUT = 4
LEAST_TAKEN_BYTES = 64 * KIB
"""Number of bytes that a client with waiting answers must receive within each write timeout, to stay connected."""
_FAULTS = {
    "head-timeout": "did not send the head of a request in time",
    "body-timeout": "did not send the body of a request in time",
    "long-head": "sent the head of a request that is too long",
    "malformed": "sent a malformed request",
}
"""Faults of clients for which Tornado closes a connection without calling a resource."""
_TORNADO_400 = b"HTTP/1.1 400 Bad Request\r\n\r\n"
"""Answer of Tornado to a malformed request; answers of resources have headers."""
_TORNADO_100 = b"HTTP/1.1 100 (Continue)\r\n\r\n"
_EXHAUSTED = (errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM)


class CannotListen(Exception):
    """Error of a server that cannot listen on its address and port; the text contains address, port and reason."""


def listen(host: str, port: int) -> list[socket.socket]:
    """Return sockets that listen on an address. Raises `CannotListen`, for example if the port is in use."""
    try:
        return bind_sockets(port, host)
    except OSError as error:
        raise CannotListen(f"the server cannot listen on {host}, port {port}: {error.strerror}") from error


def address_of(sockets: Sequence[socket.socket]) -> str:
    """Return the address at which clients reach a server with these listening sockets."""
    host, port = sockets[0].getsockname()[:2]
    return f"http://[{host}]:{port}" if ":" in host else f"http://{host}:{port}"


def raise_descriptor_limit() -> None:
    """Increase this process's limit on open files to the greatest allowed value."""
    if sys.platform == "win32":
        return
    import resource

    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if hard == resource.RLIM_INFINITY:
        hard = max(soft, MOST_CONNECTIONS + RESERVED_DESCRIPTORS)
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard, resource.getrlimit(resource.RLIMIT_NOFILE)[1]))


def default_connections() -> int:
    """Return the number of connections that the limit on open files allows, at most `MOST_CONNECTIONS`.

    Some file descriptors are reserved for other purposes.
    """
    if sys.platform == "win32":
        return MOST_CONNECTIONS
    import resource

    soft = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
    if soft == resource.RLIM_INFINITY:
        return MOST_CONNECTIONS
    return min(MOST_CONNECTIONS, max(soft - RESERVED_DESCRIPTORS, soft // 2))


class _Connection(IOStream):
    """Connection that counts the bytes received by its client since the last call of `start_count`.

    The connection also records which fault of the client, if any, makes the server close it.
    """

    def __init__(
        self, accepted: socket.socket, address: str, forget: Callable[[_Connection], None], server: HTTPServer
    ) -> None:
        super().__init__(accepted, max_buffer_size=server.max_buffer_size, read_chunk_size=server.read_chunk_size)
        self.address = address
        self.taken_bytes, self.since_s = 0, 0.0
        self.is_counted = False
        """True if the connection is closed for a reason that `Connections` counts itself."""
        self._forget = forget
        self._requests = 0
        self._reads_head = self._ended_by_client = self._malformed = self._answered = self._sends = False

    def fault(self) -> str | None:
        """Return the fault of the client (a key of `_FAULTS`) that makes the server close the connection, or None."""
        if self._malformed:
            return "malformed"
        if isinstance(self.error, UnsatisfiableReadError):
            return "long-head"
        if self.is_counted or self._ended_by_client or self.error is not None or not self.reading():
            return None
        if self._reads_head:
            return "head-timeout" if self._sends or self._requests == 1 else None  # else it was idle between requests
        return None if self._answered else "body-timeout"

    def read_until_regex(self, regex: bytes, max_bytes: int | None = None) -> Awaitable[bytes]:
        """Read the head of a request: the request line and the headers."""
        self._requests += 1
        self._reads_head, self._answered = True, False
        self._sends = self._read_buffer_size > 0  # the begin of the head may have come with the request before
        return super().read_until_regex(regex, max_bytes)

    def read_until(self, delimiter: bytes, max_bytes: int | None = None) -> Awaitable[bytes]:
        """Read the size of a chunk of a body."""
        self._reads_head = False
        return super().read_until(delimiter, max_bytes)

    def read_bytes(self, num_bytes: int, partial: bool = False) -> Awaitable[bytes]:
        """Read `num_bytes` bytes of a body, or fewer if `partial` is true."""
        self._reads_head = False
        return super().read_bytes(num_bytes, partial)

    def read_from_fd(self, buf: bytearray | memoryview) -> int | None:
        """Read received bytes into `buf`, and return their number; 0 if the client has closed the connection."""
        count = super().read_from_fd(buf)
        self._ended_by_client = count == 0
        self._sends = self._sends or bool(count)
        return count

    def close_fd(self) -> None:
        """Close the socket, so that another connection can be opened."""
        super().close_fd()
        self._forget(self)

    def write(self, data: bytes | memoryview) -> asyncio.Future[None]:
        """Write bytes, and start a time limit within which the client must receive some of them.

        Returns a future that ends when all bytes are written.
        """
        self._malformed = data == _TORNADO_400
        self._answered = self._answered or data != _TORNADO_100
        if not self.writing():
            self.start_count(time.monotonic())
        return super().write(data)

    def write_to_fd(self, data: memoryview) -> int:
        """Pass bytes to the operating system; return how many it accepted, and add them to `taken_bytes`."""
        taken = super().write_to_fd(data)
        self.taken_bytes += taken
        return taken

    def start_count(self, now_s: float) -> None:
        """Start a new count of the bytes that the client receives."""
        self.taken_bytes, self.since_s = 0, now_s


class Connections:
    """Connections of a server.

    Parameters
    ----------
    server : server that handles the connections
    most : greatest number of connections
    most_each : greatest number of connections of one address, as `limited_address` returns it
    write_timeout_s : time in seconds in which a client must receive `LEAST_TAKEN_BYTES`, or all bytes if fewer wait
    busy : returns the streams on which a request is being answered; all other streams are idle
    count_closed : counts a refused or closed connection by its reason
    at_once : number of connections accepted in one round of the event loop
    """

    def __init__(
        self,
        server: HTTPServer,
        *,
        most: int,
        most_each: int,
        write_timeout_s: float,
        busy: Callable[[], Collection[object]],
        count_closed: Callable[[str], None],
        at_once: int = ACCEPTED_AT_ONCE,
    ) -> None:
        self._server = server
        self._most = most
        self._most_each = most_each
        self._write_timeout_s = write_timeout_s
        self._busy = busy
        self._count_closed = count_closed
        self._at_once = at_once
        self._open: dict[_Connection, None] = {}  # in the order of their acceptance
        self._by_address: Counter[str] = Counter()
        self._listening: list[socket.socket] = []
        self._logged_s: dict[str, float] = {}
        self._check: asyncio.TimerHandle | None = None

    def __len__(self) -> int:
        return len(self._open)

    def accept_from(self, sockets: Iterable[socket.socket]) -> None:
        """Accept connections from listening sockets until `stop`."""
        self._listening = list(sockets)
        for one in self._listening:
            asyncio.get_running_loop().add_reader(one, self._accept, one)
        self._check_later()

    def stop(self) -> None:
        """Close the listening sockets; connections stay open, and are still checked."""
        listening, self._listening = self._listening, []
        for one in listening:
            asyncio.get_running_loop().remove_reader(one)
            one.close()

    def close(self) -> None:
        """Stop the regular checks for slow clients."""
        if self._check is not None:
            self._check.cancel()

    def _accept(self, listening: socket.socket) -> None:
        for _ in range(self._at_once):
            try:
                accepted, address = listening.accept()
            except BlockingIOError:
                return
            except ConnectionAbortedError:
                continue
            except OSError as error:
                if error.errno not in _EXHAUSTED:
                    raise
                self._pause(listening, error)
                return
            self._begin(accepted, address)

    def _begin(self, accepted: socket.socket, address: Any) -> None:
        """Serve a connection, or close it if there are too many."""
        host = limited_address(str(address[0])) if isinstance(address, tuple) else ""
        if self._by_address[host] >= self._most_each:
            self._evict(host)
        elif len(self._open) >= self._most:
            self._evict(None)
        if self._by_address[host] >= self._most_each or len(self._open) >= self._most:
            accepted.close()
            self._log("full", "refused a connection: %d are open already, %d of them from its address",
                      len(self._open), self._by_address[host])  # fmt: skip
            return
        stream = _Connection(accepted, host, self._forget, self._server)
        self._open[stream] = None
        self._by_address[host] += 1
        self._server.handle_stream(stream, address)

    def _evict(self, host: str | None) -> None:
        """Close the oldest idle connections of the address `host`.

        If `host` is None, close those of the address with the most idle connections.
        """
        busy = self._busy()
        idle = [one for one in self._open if one not in busy and not one.writing()]
        if host is None and idle:
            host = Counter(one.address for one in idle).most_common(1)[0][0]
        own = [one for one in idle if one.address == host]
        for one in own[: max(1, int(self._most * EVICTED_SHARE))]:
            one.is_counted = True
            one.close()
        if own:
            self._log("evicted", "closed idle connections of %s, because a limit on connections was reached", host)

    def _forget(self, one: _Connection) -> None:
        if self._listening and (fault := one.fault()) is not None:
            self._log(fault, "closed a connection of %s, which %s", one.address, _FAULTS[fault])
        del self._open[one]
        self._by_address[one.address] -= 1
        if not self._by_address[one.address]:
            del self._by_address[one.address]

    def _pause(self, listening: socket.socket, error: OSError) -> None:
        """Stop accepting connections for `PAUSE_S` seconds, after a failure for lack of descriptors or memory.

        Without this pause, the event loop would repeat the failed `accept` at once and without end.
        """
        loop = asyncio.get_running_loop()
        loop.remove_reader(listening)
        loop.call_later(PAUSE_S, self._resume, listening)
        self._log("exhausted", "no connection can be accepted: %s; raise the limit on open files (ulimit -n), "
                  "or lower max_connections", error.strerror)  # fmt: skip
        self._evict(None)

    def _resume(self, listening: socket.socket) -> None:
        if listening in self._listening:
            asyncio.get_running_loop().add_reader(listening, self._accept, listening)

    def _check_later(self) -> None:
        delay_s = self._write_timeout_s / CHECKS_PER_TIMEOUT
        self._check = asyncio.get_running_loop().call_later(delay_s, self._check_clients)

    def _check_clients(self) -> None:
        self._check_later()
        self.close_slow(time.monotonic())

    def close_slow(self, now_s: float) -> None:
        """Close each connection whose client has received too little of the waiting bytes.

        The limit is `LEAST_TAKEN_BYTES` within each write timeout; `now_s` is the time of the monotonic clock.
        """
        for one in [one for one in self._open if one.writing() and now_s - one.since_s >= self._write_timeout_s]:
            if one.taken_bytes < LEAST_TAKEN_BYTES:
                self._log("slow", "closed a connection of %s, whose client read only %d bytes in %.0f s",
                          one.address, one.taken_bytes, now_s - one.since_s)  # fmt: skip
                one.is_counted = True
                one.close()
            else:
                one.start_count(now_s)

    def _log(self, kind: str, text: str, *args: object) -> None:
        """Count a refused or closed connection, and log a warning.

        For each reason, at most one warning is logged in `LOG_EVERY_S` seconds.
        """
        self._count_closed(kind)
        now_s = time.monotonic()
        if now_s - self._logged_s.get(kind, -LOG_EVERY_S) >= LOG_EVERY_S:
            self._logged_s[kind] = now_s
            log.warning(text, *args)
