"""Clients that do not read answers or do not send bodies: the memory and the time that they cost are limited."""

from __future__ import annotations

import hashlib
import json
import logging
import socket
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from threading import Event

import httpx
import numpy as np
import pytest
from tests.support.patience import PATIENCE_S, wait_until
from tests.support.rest_server import Server, running

from marey_schemas.encoding.codecs import MSGPACK, encode_tree
from marey_server.http.accepting import ADDRESS_SHARE
from marey_server.http.streaming import HELD_BYTES
from marey_server.motions import exporting
from marey_server.process.computing import RENDERING_THREADS
from marey_server.store.database.connections import Database
from marey_server.store.database.lanes import Client

MIB = 2**20
DOCUMENT_BYTES = 6 * MIB
MOST_CONNECTIONS = 16
MOST_EACH = int(MOST_CONNECTIONS * ADDRESS_SHARE)


@contextmanager
def reading(server: Server, path: str, token: str, body: bytes = b"") -> Iterator[socket.socket]:
    """Send a request, a POST if it has a body, and read nothing of the answer; yield the socket."""
    host, port = server.address.removeprefix("http://").split(":")
    head = f"{'POST' if body else 'GET'} /api/v1{path} HTTP/1.1\r\nHost: {host}\r\nAuthorization: Bearer {token}\r\n"
    with socket.socket() as client:
        client.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        client.settimeout(PATIENCE_S)
        client.connect((host, int(port)))
        head += f"Accept: application/msgpack\r\nContent-Type: application/json\r\nContent-Length: {len(body)}\r\n\r\n"
        client.sendall(head.encode() + body)
        yield client


def add_long_document(server: Server, token: str) -> str:
    """Create an item with a document of `DOCUMENT_BYTES`; return its path."""
    array = np.random.default_rng(1).random(DOCUMENT_BYTES // 8)
    body = encode_tree({"name": "s", "parts": {"character": {"schema": "marey/document@1", "x": array}}}, MSGPACK)
    made = server.client(token).post("/projects/lab/characters", content=body, headers={"Content-Type": MSGPACK})
    assert made.status_code == 201, made.text
    return f"/projects/lab/characters/{made.json()['id']}/parts/character"


def test_a_reader_that_takes_nothing_is_cut_off_and_holds_nothing_any_more(
    database: Database, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.WARNING, "marey_server.http.accepting")
    with running(database, tmp_path, write_timeout_s=0.2) as server:
        token = server.make_project()
        path, memory = add_long_document(server, token), server.app.services.memory
        with reading(server, path, token) as client:
            wait_until(lambda: any("closed a connection" in record.message for record in caplog.records))
            wait_until(lambda: memory.held_bytes == 0)
            received = sum(len(data) for data in iter(lambda: client.recv(MIB), b""))
            assert received < DOCUMENT_BYTES
        assert server.client(token).get("/me").status_code == 200


def test_one_client_cannot_hold_all_memory_of_answers(database: Database, tmp_path: Path) -> None:
    with running(database, tmp_path, request_memory_bytes=3 * DOCUMENT_BYTES) as server:
        token, other = server.make_project(), server.make_user("rita")
        path, memory = add_long_document(server, token), server.app.services.memory
        with reading(server, path, token), reading(server, path, token):
            wait_until(lambda: memory.held_bytes >= 2 * DOCUMENT_BYTES)
            refused = server.client(token).get(path, headers={"Accept": MSGPACK})
            assert (refused.status_code, refused.json()["code"]) == (503, "memory")
            assert int(refused.headers["Retry-After"]) > 0
            assert server.client(other).get("/me").status_code == 200
        wait_until(lambda: memory.held_bytes == 0)
        assert server.client(token).get(path, headers={"Accept": MSGPACK}).status_code == 200


def test_a_reader_that_leaves_early_is_no_error_in_the_log(
    database: Database, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with running(database, tmp_path) as server:
        token = server.make_project()
        path, services = add_long_document(server, token), server.app.services
        with reading(server, path, token) as client:
            client.recv(1000)
        wait_until(lambda: not services.in_flight and services.memory.held_bytes == 0)
    assert [record.message for record in caplog.records if record.levelno >= logging.ERROR] == []


@pytest.mark.parametrize("several", [False, True])
def test_documents_that_wait_for_a_thread_that_renders_them_count_as_memory(
    database: Database, tmp_path: Path, *, several: bool
) -> None:
    with running(database, tmp_path, request_memory_bytes=3 * DOCUMENT_BYTES) as server, ExitStack() as open_until:
        token = server.make_project()
        path, services = add_long_document(server, token), server.app.services
        go_on = Event()
        open_until.callback(go_on.set)
        for number in range(RENDERING_THREADS):
            services.compute_threads.rendering.submit(Client(f"busy-{number}"), go_on.wait)
        place = {"kind": "character", "item": path.split("/")[4], "revision": 1, "part": "character"}
        body = json.dumps({"parts": [place]}).encode() if several else b""
        for _ in range(2):
            open_until.enter_context(reading(server, "/projects/lab/parts" if several else path, token, body))
        wait_until(lambda: services.memory.held_bytes > 1.5 * DOCUMENT_BYTES)  # stored documents are compressed
        refused = server.client(token).get(path, headers={"Accept": MSGPACK})
        assert (refused.status_code, refused.json()["code"]) == (503, "memory")
        go_on.set()


def test_the_documents_of_an_export_count_as_memory_before_they_are_packed(
    database: Database, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(exporting, "export_order", lambda *_: b"an order, which counts as memory itself")
    with running(database, tmp_path, request_memory_bytes=DOCUMENT_BYTES) as server:
        token = server.make_project()
        path = add_long_document(server, token).replace("parts/character", "export?format=json")
        server.app.services.memory.take(Client("somebody else"), 0, DOCUMENT_BYTES // 2, reserved=False)
        refused = server.client(token).get(path)
        assert (refused.status_code, refused.json()["code"]) == (503, "memory")


def test_blobs_that_are_being_sent_count_as_memory(database: Database, tmp_path: Path) -> None:
    with running(database, tmp_path, request_memory_bytes=3 * MIB) as server:
        client, memory = server.client(token := server.make_project()), server.app.services.memory
        data = np.random.default_rng(2).bytes(8 * MIB)
        path = f"/blobs/sha256:{hashlib.sha256(data).hexdigest()}"
        assert client.put(path, content=data).is_success
        with reading(server, path, token):
            wait_until(lambda: memory.held_bytes == HELD_BYTES)
            refused = client.get(path)
            assert (refused.status_code, refused.json()["code"]) == (503, "memory")
            short = client.get(path, headers={"Range": "bytes=5-9"})
            assert (short.status_code, short.content) == (206, data[5:10])
        wait_until(lambda: memory.held_bytes == 0)
        assert client.get(path).content == data
        wait_until(lambda: memory.held_bytes == 0)


@pytest.mark.parametrize(
    ("path", "answer"), [("projects", b"HTTP/1.1 401"), ("login", b"")], ids=["refused", "allowed"]
)
def test_guests_whose_bodies_do_not_come_do_not_keep_others_out(
    database: Database, tmp_path: Path, path: str, answer: bytes
) -> None:
    head = f"POST /api/v1/{path} HTTP/1.1\r\nHost: x\r\nContent-Type: application/json\r\nContent-Length: 9\r\n\r\n"
    with running(database, tmp_path, max_connections=MOST_CONNECTIONS) as server, ExitStack() as open_until:
        host, port = server.address.removeprefix("http://").split(":")
        requests = server.app.services.in_flight
        for _ in range(MOST_EACH):
            client = open_until.enter_context(socket.create_connection((host, int(port)), timeout=PATIENCE_S))
            client.sendall(head.encode())
            if answer:
                assert client.recv(MIB).startswith(answer)
        wait_until(lambda: sum(one.awaits_guest for one in list(requests)) == (0 if answer else MOST_EACH))
        assert httpx.get(f"{server.address}/healthz", timeout=PATIENCE_S).status_code == 200
