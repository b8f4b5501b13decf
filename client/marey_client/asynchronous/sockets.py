"""HTTP connections whose waits end when their call is interrupted."""

from __future__ import annotations

import os
import socket
import ssl
from collections.abc import Callable, Iterable
from concurrent.futures import Future, InvalidStateError
from contextlib import suppress
from functools import cached_property, partial
from threading import Thread
from typing import Any, TypeVar

import httpcore
import httpx

from marey_client.asynchronous.interruption import Interrupted, RunningCall, current_call
from marey_client.credentials import trusted_authorities

T = TypeVar("T")


class InterruptibleConnections(httpx.BaseTransport):
    """HTTP connections for calls that can be interrupted. A forked process opens connections of its own."""

    def __init__(self, limits: httpx.Limits) -> None:
        self._limits = limits
        self._opened = (os.getpid(), _Pools(limits))

    def _pools(self) -> _Pools:
        process, pools = self._opened
        if process != os.getpid():
            pools = _Pools(self._limits)
            self._opened = (os.getpid(), pools)
        return pools

    def handle_request(self, request: httpx.Request) -> httpx.Response:
        """Send a request, and return the answer; its body is read later."""
        pools = self._pools()
        return (pools.tls if request.url.scheme == "https" else pools.plain).handle_request(request)

    def close(self) -> None:
        """Close every connection."""
        self._pools().close()


class _Pools:
    """Connections of one process without TLS, and with TLS; the first request with TLS loads trusted certificates."""

    def __init__(self, limits: httpx.Limits) -> None:
        self._limits = limits
        self.plain = _Pool(ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT), limits)  # trusts nobody

    @cached_property
    def tls(self) -> _Pool:
        return _Pool(trusted_authorities(), self._limits)

    def close(self) -> None:
        self.plain.close()
        if "tls" in self.__dict__:
            self.tls.close()


class _Pool(httpx.HTTPTransport):
    def __init__(self, authorities: ssl.SSLContext, limits: httpx.Limits) -> None:
        super().__init__(verify=authorities, trust_env=False)
        # httpx has no parameter for the network backend of its pool.
        self._pool = httpcore.ConnectionPool(
            ssl_context=authorities,
            max_connections=limits.max_connections,
            max_keepalive_connections=limits.max_keepalive_connections,
            keepalive_expiry=limits.keepalive_expiry,
            network_backend=_Network(),
        )


class _Network(httpcore.SyncBackend):
    def connect_tcp(
        self,
        host: str,
        port: int,
        timeout: float | None = None,
        local_address: str | None = None,
        socket_options: Iterable[Any] | None = None,
    ) -> httpcore.NetworkStream:
        connect = partial(super().connect_tcp, host, port, timeout, local_address, socket_options)
        call = current_call()
        return _Stream(connect() if call is None else _connected(connect, call))


def _connected(connect: Callable[[], httpcore.NetworkStream], call: RunningCall) -> httpcore.NetworkStream:
    """Connect in another thread. If the call is interrupted, the thread ends later, and closes its connection.

    Neither the look-up of a name nor the wait for a server can be interrupted.
    """
    made: Future[httpcore.NetworkStream] = Future()

    def run() -> None:
        try:
            stream = connect()
        except BaseException as error:  # noqa: BLE001 - the thread that waits raises it
            with suppress(InvalidStateError):  # nobody waits any more
                made.set_exception(error)
            return
        try:
            made.set_result(stream)
        except InvalidStateError:
            stream.close()

    Thread(target=run, name="marey-connect", daemon=True).start()
    try:
        with call.ending_by(made.cancel):
            return made.result()
    except Interrupted:
        made.add_done_callback(_close)
        raise


def _close(made: Future[httpcore.NetworkStream]) -> None:
    if not made.cancelled() and made.exception() is None:
        made.result().close()


class _Stream(httpcore.NetworkStream):
    """Connection that is shut down if the call that reads or writes is interrupted."""

    def __init__(self, stream: httpcore.NetworkStream) -> None:
        self._stream = stream

    def read(self, max_bytes: int, timeout: float | None = None) -> bytes:
        return self._interruptible(lambda: self._stream.read(max_bytes, timeout))

    def write(self, buffer: bytes, timeout: float | None = None) -> None:
        self._interruptible(lambda: self._stream.write(buffer, timeout))

    def close(self) -> None:
        self._stream.close()

    def start_tls(
        self, ssl_context: ssl.SSLContext, server_hostname: str | None = None, timeout: float | None = None
    ) -> httpcore.NetworkStream:
        return _Stream(self._interruptible(lambda: self._stream.start_tls(ssl_context, server_hostname, timeout)))

    def get_extra_info(self, info: str) -> Any:
        return self._stream.get_extra_info(info)

    def _interruptible(self, step: Callable[[], T]) -> T:
        call = current_call()
        if call is None:
            return step()
        with call.ending_by(self._shut_down):
            return step()

    def _shut_down(self) -> None:
        with suppress(OSError):  # closed already
            # Not the method of `ssl.SSLSocket`, which would take the TLS state away from the thread that reads.
            socket.socket.shutdown(self._stream.get_extra_info("socket"), socket.SHUT_RDWR)
