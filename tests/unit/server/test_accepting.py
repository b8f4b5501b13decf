"""Connections: limited in number, closed if clients do not read, and accepted again after a lack of descriptors."""

from __future__ import annotations

import asyncio
import errno
import logging
import os
import socket
import time
from collections.abc import Awaitable, Callable, Collection
from typing import Any

import pytest
from tests.support.patience import PATIENCE_S
from tornado.httpserver import HTTPServer
from tornado.iostream import IOStream

from marey_server.http import accepting
from marey_server.http.accepting import LEAST_TAKEN_BYTES, Connections

TIMEOUT_S = 3600.0
UNSENT_BYTES = 8 * 2**20


class Kept(HTTPServer):
    """Server that keeps connections open and sends no answers."""

    streams: list[IOStream]

    def handle_stream(self, stream: IOStream, address: Any) -> None:
        self.streams.append(stream)


class Exhausted(socket.socket):
    """Listening socket whose `accept` fails several times because no file descriptors are left."""

    failures = 3

    def accept(self) -> tuple[socket.socket, Any]:
        if self.failures:
            self.failures -= 1
            raise OSError(errno.EMFILE, os.strerror(errno.EMFILE))
        return super().accept()


class OfOneNetwork(socket.socket):
    """Listening socket whose clients seem to have different addresses of one IPv6 network of 64 bits."""

    accepted = 0

    def accept(self) -> tuple[socket.socket, Any]:
        client, _ = super().accept()
        self.accepted += 1
        return client, (f"2001:db8::{self.accepted}", 1, 0, 0)


Work = Callable[[Connections, Kept, Callable[[], Awaitable[socket.socket]]], Awaitable[None]]


def serve(
    work: Work,
    *,
    listening: type[socket.socket] = socket.socket,
    most: int = 4,
    most_each: int = 4,
    busy: Callable[[Kept], Collection[object]] = lambda _: (),
) -> None:
    """Call `work` with a function that connects a client, while an event loop accepts connections."""

    async def main() -> None:
        server = Kept(lambda _request: None)
        server.streams = []
        connections = Connections(
            server,
            most=most,
            most_each=most_each,
            write_timeout_s=TIMEOUT_S,
            busy=lambda: busy(server),
            count_closed=lambda _reason: None,
        )
        one = listening(socket.AF_INET, socket.SOCK_STREAM)
        one.bind(("127.0.0.1", 0))
        one.listen()
        one.setblocking(False)
        connections.accept_from([one])
        clients: list[socket.socket] = []

        async def connect() -> socket.socket:
            client = socket.socket()
            client.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            client.setblocking(False)
            clients.append(client)
            await asyncio.get_running_loop().sock_connect(client, one.getsockname())
            return client

        try:
            async with asyncio.timeout(PATIENCE_S):
                await work(connections, server, connect)
        finally:
            connections.stop()
            connections.close()
            for client in clients:
                client.close()
            for stream in server.streams:
                stream.close()

    asyncio.run(main())


async def until(condition: Callable[[], bool]) -> None:
    while not condition():
        await asyncio.sleep(0.001)


def test_a_client_that_takes_nothing_is_cut_off_and_one_that_takes_a_little_is_not() -> None:
    async def work(connections: Connections, server: Kept, connect: Callable[[], Awaitable[socket.socket]]) -> None:
        sender = asyncio.get_running_loop()
        await connect()
        moving = await connect()
        await until(lambda: len(server.streams) == 2)
        for stream in server.streams:
            stream.write(b"x" * UNSENT_BYTES)  # more than the operating system buffers
        connections.close_slow(time.monotonic())
        assert len(connections) == 2, "their time is not over"
        taken = 0
        while taken < 4 * LEAST_TAKEN_BYTES:
            taken += len(await sender.sock_recv(moving, LEAST_TAKEN_BYTES))
        streams: Any = server.streams
        still, moved = streams
        still.taken_bytes = 0
        await until(lambda: moved.taken_bytes >= LEAST_TAKEN_BYTES)
        connections.close_slow(time.monotonic() + TIMEOUT_S)
        assert (still.closed(), moved.closed(), len(connections)) == (True, False, 1)
        connections.close_slow(time.monotonic() + 3 * TIMEOUT_S)
        assert moved.closed(), "it has taken nothing since"

    serve(work)


def test_an_idle_connection_makes_room_for_a_new_one() -> None:
    async def work(connections: Connections, server: Kept, connect: Callable[[], Awaitable[socket.socket]]) -> None:
        for number in range(5):
            await connect()
            await until(lambda number=number: len(server.streams) > number)
        assert [stream.closed() for stream in server.streams] == [True, False, False, False, False]
        assert len(connections) == 4

    serve(work)


def test_a_connection_that_is_busy_is_kept_and_the_new_one_is_closed() -> None:
    async def work(connections: Connections, server: Kept, connect: Callable[[], Awaitable[socket.socket]]) -> None:
        for _ in range(4):
            await connect()
        await until(lambda: len(connections) == 4)
        refused = await connect()
        assert await asyncio.get_running_loop().sock_recv(refused, 1) == b""
        assert not any(stream.closed() for stream in server.streams)

    serve(work, busy=lambda server: server.streams)


def test_addresses_of_one_network_share_the_connections_of_one_address() -> None:
    async def work(connections: Connections, server: Kept, connect: Callable[[], Awaitable[socket.socket]]) -> None:
        for number in range(3):
            await connect()
            await until(lambda number=number: len(server.streams) > number)
        assert [stream.closed() for stream in server.streams] == [True, False, False]
        assert len(connections) == 2

    serve(work, listening=OfOneNetwork, most_each=2)


def test_connections_wait_while_there_are_no_descriptors_and_the_log_says_so_once(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(accepting, "PAUSE_S", 0.001)
    caplog.set_level(logging.WARNING)

    async def work(_connections: Connections, server: Kept, connect: Callable[[], Awaitable[socket.socket]]) -> None:
        await connect()
        await until(lambda: len(server.streams) == 1)

    serve(work, listening=Exhausted)
    assert [record.getMessage().startswith("no connection can be accepted") for record in caplog.records] == [True]
