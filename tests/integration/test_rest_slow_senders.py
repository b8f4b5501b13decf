"""Clients that send streamed bodies slowly: they count towards the memory limit, and silent ones are cut off."""

from __future__ import annotations

import asyncio
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from tests.support.patience import PATIENCE_S, wait_until
from tests.support.rest_server import Server, running

from marey_schemas.encoding.digests import digest_of
from marey_schemas.sizes import KIB, MIB
from marey_server.handlers.blobs import Blob
from marey_server.handlers.imports import MAX_FORM_BYTES
from marey_server.store.blob_backings import SPOOLED_BYTES
from marey_server.store.database.connections import Database
from marey_server.store.database.lanes import Client

BODY = b"HIERARCHY"
BLOB = f"/blobs/{digest_of(BODY)}"
IMPORTS = "/projects/lab/imports"
MULTIPART = "multipart/form-data; boundary=b"
IMPORT_BYTES = MIB + MAX_FORM_BYTES + 64 * SPOOLED_BYTES


@contextmanager
def sending(
    server: Server, token: str, method: str, path: str, length: int | None, content_type: str = "application/json"
) -> Iterator[socket.socket]:
    """Send the head of a request with a body of `length` bytes, or of unknown length; yield the socket."""
    host, port = server.address.removeprefix("http://").split(":")
    size = "Transfer-Encoding: chunked" if length is None else f"Content-Length: {length}"
    head = f"{method} /api/v1{path} HTTP/1.1\r\nHost: {host}\r\nAuthorization: Bearer {token}\r\nUpload-Offset: 0\r\n"
    with socket.create_connection((host, int(port)), PATIENCE_S) as client:
        client.sendall(f"{head}Content-Type: {content_type}\r\n{size}\r\n\r\n".encode())
        yield client


@pytest.mark.parametrize(
    ("method", "path", "length", "content_type", "held_bytes"),
    [
        ("PUT", BLOB, 700 * MIB, "", MIB),
        ("PUT", BLOB, 10 * KIB, "", 10 * KIB),
        ("PUT", BLOB, None, "", MIB),
        ("PATCH", "/uploads/{upload}", 700 * MIB, "", MIB),
        ("POST", IMPORTS, 700 * MIB, MULTIPART, IMPORT_BYTES),
        ("POST", IMPORTS, None, "application/json", MIB),
    ],
    ids=["blob", "short", "chunked", "upload", "files", "list"],
)
def test_the_memory_of_a_streamed_body_counts_before_the_body_comes(
    server: Server, method: str, path: str, length: int | None, content_type: str, held_bytes: int
) -> None:
    token, memory = server.make_project(), server.app.services.memory
    upload = server.client(token).post("/uploads", json={"length": 700 * MIB}).json()["id"]
    wait_until(lambda: memory.held_bytes == 0)
    with sending(server, token, method, path.format(upload=upload), length, content_type):
        wait_until(lambda: memory.held_bytes == held_bytes)
        memory.take(Client("somebody else"), 0, memory.total_bytes - held_bytes, reserved=True)
        with sending(server, token, method, path.format(upload=upload), length, content_type) as second:
            assert second.recv(12) == b"HTTP/1.1 503"
        memory.give_back(Client("somebody else"), memory.total_bytes - held_bytes)
    wait_until(lambda: memory.held_bytes == 0)


def test_a_refused_body_holds_no_memory(server: Server) -> None:
    client, memory = server.client(server.make_project()), server.app.services.memory
    for _ in range(3):
        refused = client.patch("/uploads/invented", content=b"a" * 10_000, headers={"Upload-Offset": "0"})
        assert refused.status_code == 404
    wait_until(lambda: memory.held_bytes == 0)


def test_who_sends_nothing_for_a_while_is_cut_off(database: Database, tmp_path: Path) -> None:
    with running(database, tmp_path, body_timeout_s=0.5) as server:
        token, memory = server.make_project(), server.app.services.memory
        with sending(server, token, "PUT", BLOB, len(BODY)) as client:
            client.sendall(BODY[:-1])
            assert client.recv(1) == b""
        wait_until(lambda: memory.held_bytes == 0)
        assert server.client(token).put(BLOB, content=BODY).status_code == 204


HEAD = b"POST /api/v1/login HTTP/1.1\r\nHost: h\r\n"
FAULTS = {
    "head-timeout": [b"", HEAD, b"GET /healthz HTTP/1.1\r\nHost: h\r\n\r\n" + HEAD],
    "body-timeout": [
        HEAD + b"Content-Type: application/json\r\nContent-Length: 9\r\n\r\n{",
        HEAD + b"Content-Type: application/json\r\nTransfer-Encoding: chunked\r\n\r\n1\r\n",
        HEAD + b"Content-Length: 9\r\nExpect: 100-continue\r\n\r\n",
    ],
    "long-head": [HEAD + b"X: " + b"x" * 70_000],
    "malformed": [b"GET\r\n\r\n", HEAD + b"Content-Length: x\r\n\r\n", HEAD + b"no colon\r\n\r\n"],
}
NO_FAULTS = [
    b"GET /healthz HTTP/1.1\r\nHost: h\r\n\r\n",  # then the connection is idle
    b"GET /healthz HTTP/1.1\r\nHost: h\r\nConnection: close\r\n\r\n",
    HEAD + b"Content-Length: 9000\r\n\r\n{",  # refused at once, which is counted as such
]


def test_each_fault_for_which_a_connection_is_closed_is_counted(database: Database, tmp_path: Path) -> None:
    with running(database, tmp_path, header_timeout_s=0.4, body_timeout_s=0.4) as server:
        host, port = server.address.removeprefix("http://").split(":")

        def counted() -> dict[str, float]:
            samples = [one for metric in server.app.services.metrics.closed.collect() for one in metric.samples]
            return {one.labels["reason"]: one.value for one in samples}

        def send(data: bytes) -> None:
            with socket.create_connection((host, int(port)), PATIENCE_S) as client:
                client.sendall(data)
                while client.recv(65536):
                    pass

        for data in NO_FAULTS:
            send(data)
        with socket.create_connection((host, int(port)), PATIENCE_S) as client:
            client.sendall(HEAD)  # and the client leaves
        for sent in FAULTS.values():
            for data in sent:
                send(data)
        expected = {fault: len(sent) for fault, sent in FAULTS.items()}
        wait_until(lambda: sum(counted().values()) == sum(expected.values()))
        assert counted() == expected


def test_who_sends_slowly_or_waits_for_the_server_is_not_cut_off(
    database: Database, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    receive = Blob.receive

    async def late(self: Blob, chunk: bytes) -> None:
        await asyncio.sleep(1.5 if chunk == BODY[:1] else 0)
        await receive(self, chunk)

    monkeypatch.setattr(Blob, "receive", late)
    with running(database, tmp_path, body_timeout_s=1.0) as server:
        token = server.make_project()
        with sending(server, token, "PUT", BLOB, len(BODY)) as client:
            client.sendall(BODY[:1])
            time.sleep(0.3)
            for at in range(1, len(BODY)):
                client.sendall(BODY[at : at + 1])
                time.sleep(0.3)
            assert client.recv(12) == b"HTTP/1.1 204"
