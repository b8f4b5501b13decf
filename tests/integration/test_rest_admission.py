"""Request bodies from callers without the necessary rights: refused before any byte of a body is decoded."""

import gc
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import msgpack
import numpy as np
import pytest
from tests.support.patience import PATIENCE_S
from tests.support.rest_server import Server, running

from marey_schemas.access import Role
from marey_schemas.encoding import blocks
from marey_server.access.principal import SYSTEM
from marey_server.http.resource import GUEST_BODY_BYTES, Resource
from marey_server.store.database.connections import Database
from marey_server.store.database.lanes import SERVER, Client

INVENTED = "marey_aaaaaaaaaaaa_" + "b" * 64
MIB = 2**20
CLIPS = "/projects/lab/clips"
MSGPACK = {"Content-Type": "application/msgpack"}


def packed(array: np.ndarray[Any, Any]) -> bytes:
    """Return a document with one array, which is sent in blocks."""
    leaf = {"dtype": array.dtype.str, "shape": list(array.shape), "encoding": "blocks", "data": blocks.encode(array)}
    return msgpack.packb({"name": "walk", "parts": {"motion": {"poses": leaf}}})


def in_chunks(body: bytes) -> Iterator[bytes]:
    """Yield the bytes of a body, so that the client sends a chunked request without Content-Length."""
    yield body


@pytest.mark.parametrize("chunked", [False, True])
@pytest.mark.parametrize(
    ("body", "media_type"),
    [
        (packed(np.zeros((10_000, 700), np.float32)), "application/msgpack"),
        (b"[" + b"[]," * 300_000 + b"[]]", "application/json"),
        (b"not a document", "application/bson"),
    ],
    ids=["blocks", "json", "bson"],
)
def test_nothing_is_decoded_for_an_invented_token(
    server: Server, decoded: list[int], body: bytes, media_type: str, *, chunked: bool
) -> None:
    server.make_project()
    content = in_chunks(body) if chunked else body
    answer = server.client(INVENTED).post(CLIPS, content=content, headers={"Content-Type": media_type})
    assert (answer.status_code, answer.json()["code"], decoded) == (401, "bad-token", [])


@pytest.mark.parametrize(("role", "status"), [(None, 404), (Role.READER, 403)])
def test_nothing_is_decoded_for_users_who_may_not_write_in_the_project(
    server: Server, decoded: list[int], role: Role | None, status: int
) -> None:
    server.make_project()
    token = server.make_user("rita")
    if role is not None:
        server.make_project("lab2", owner="otto", rita=role)
    place = CLIPS if role is None else "/projects/lab2/clips"
    answer = server.client(token).post(place, content=b"{", headers={"Content-Type": "application/json"})
    assert (answer.status_code, decoded) == (status, [])


def test_nothing_is_decoded_for_guests_who_ask_a_long_question(server: Server, decoded: list[int]) -> None:
    server.make_project()
    answer = server.client().post("/projects/lab/parts", content=b"{")
    assert (answer.status_code, decoded) == (404, [])


def test_a_sign_in_is_short(server: Server, decoded: list[int]) -> None:
    answer = server.client().post("/login", json={"name": "olga", "password": "x" * 5000})
    assert (answer.status_code, decoded) == (413, [])


def test_still_motion_of_some_bytes_may_be_long(owner: httpx.Client) -> None:
    still, beyond = (np.zeros((frames, 100, 4), np.float32) for frames in (10_500, 84_000))
    codes = [owner.post(CLIPS, content=packed(array), headers=MSGPACK).json()["code"] for array in (still, beyond)]
    assert codes == ["invalid", "too-large"]


def test_arrays_take_from_the_memory_of_requests_before_they_are_decoded(
    database: Database, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with running(database, tmp_path, request_memory_bytes=MIB) as server:
        client = server.client(server.make_project())
        monkeypatch.setattr("marey_schemas.encoding.codecs.array_from_leaf", None)
        body = packed(np.zeros((MIB, 1), np.float32))
        server.app.services.memory.take(Client("somebody else"), 0, 1, reserved=False)
        refused = client.post(CLIPS, content=body, headers=MSGPACK)
        assert (refused.status_code, refused.json()["code"]) == (503, "memory")


def test_claims_of_too_many_workers_of_one_user_are_refused_before_they_get_a_job(
    database: Database, tmp_path: Path
) -> None:
    with running(database, tmp_path, user_workers=1) as server:
        server.make_project()
        client = server.client(server.make_user("worker", administrator=True, scopes=("work",)))
        for worker, status in (("a", 200), ("b", 429), ("a", 200)):
            answer = client.post("/leases", json={"worker": worker, "kinds": ["errand"]})
            assert answer.status_code == status
            if status == 429:
                assert (answer.json()["code"], answer.headers["Retry-After"].isdigit()) == ("too-many-workers", True)


@pytest.mark.parametrize("chunked", [False, True])
def test_guests_may_send_short_bodies_only(server: Server, owner: httpx.Client, *, chunked: bool) -> None:
    etag = owner.get("/projects/lab").headers["ETag"]
    assert owner.patch("/projects/lab", json={"visibility": "public"}, headers={"If-Match": etag}).is_success
    body = b'{"parts": []}' + b" " * GUEST_BODY_BYTES
    headers = {"Content-Type": "application/json"}
    answers = [
        client.post("/projects/lab/parts", content=in_chunks(body) if chunked else body, headers=headers)
        for client in (server.client(), owner)
    ]
    assert [answer.status_code for answer in answers] == [413, 422]


def test_callers_are_admitted_or_refused_while_all_threads_for_reads_are_busy(server: Server) -> None:
    server.make_project()
    done = threading.Event()
    reads = [server.database.queue_read(SERVER, SYSTEM, lambda _tx: done.wait(PATIENCE_S)) for _ in range(16)]
    try:
        refused = server.client(INVENTED).post(CLIPS, json={})
        assert not any(read.done() for read in reads)
    finally:
        done.set()
    assert refused.status_code == 401


def test_a_token_that_was_revoked_writes_nothing_though_its_body_is_decoded_for_a_while(server: Server) -> None:
    client = server.client(server.make_project())
    assert client.post("/projects/lab/collections", json={"path": "before"}).status_code == 201
    assert client.post("/logout").status_code == 204
    answer = client.post("/projects/lab/collections", json={"path": "after"})
    assert (answer.status_code, answer.json()["code"]) == (401, "bad-token")


@pytest.mark.parametrize("path", ["/login", "/projects/lab/clips", "/nowhere"])
def test_a_refused_request_leaves_nothing_for_the_garbage_collector(server: Server, path: str) -> None:
    """The garbage collector stops all threads. The more refused requests it must free, the longer this takes."""
    client = server.client(server.make_project())
    refuse_bodies(client, path)  # the first validation builds the model, and leaves a cycle with the frame
    deadline = time.monotonic() + PATIENCE_S
    while are_resources_left():  # of earlier requests, which may end after their answers
        gc.collect()
        assert time.monotonic() < deadline
    gc.disable()
    try:
        refuse_bodies(client, path)
        while are_resources_left():
            assert time.monotonic() < deadline
            time.sleep(0.05)
    finally:
        gc.enable()


def refuse_bodies(client: httpx.Client, path: str) -> None:
    """Send bodies that are malformed, invalid, and refused."""
    for body in b'{"name": "x", "password": ', b'{"name": 1}', b'{"name": "nobody", "password": "wrong wrong wrong"}':
        assert client.post(path, content=body, headers={"Content-Type": "application/json"}).is_client_error


def are_resources_left() -> bool:
    """Return whether the memory contains the resource of a request."""
    return any(issubclass(type(one), Resource) for one in gc.get_objects())
