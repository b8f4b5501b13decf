"""A server that keeps blobs in object storage, as its clients and its operator see it."""

import hashlib
import os
import secrets
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
from tests.support.database_fixtures import copied_sqlite
from tests.support.faulty_s3 import FaultyS3, faulty_s3
from tests.support.rest_server import Server, running
from tests.support.s3_servers import KEY_ID, SECRET_KEY, S3Server, seaweedfs

from marey_client import Marey
from marey_motion.formats import write_bvh
from marey_motion.gait import generate_gait
from marey_schemas.sizes import MIB
from marey_server import commands
from marey_server.app import connect_database
from marey_server.errors import UnavailableProblem
from marey_server.process import housekeeping
from marey_server.process.settings import Settings
from marey_server.store import fsck
from marey_server.store.database.connections import Database

OCTETS = {"Content-Type": "application/octet-stream"}
pytestmark = pytest.mark.xdist_group("object storage")


def digest_of(data: bytes) -> str:
    return f"sha256:{hashlib.sha256(data).hexdigest()}"


@pytest.fixture
def proxy(s3_servers: Callable[[str], S3Server]) -> Iterator[FaultyS3]:
    with faulty_s3(s3_servers("seaweedfs").port) as one:
        yield one


@pytest.fixture
def in_bucket(tmp_path: Path, proxy: FaultyS3) -> dict[str, Any]:
    """Settings of a server that keeps blobs in object storage behind the proxy."""
    secret = tmp_path / "secret-key"
    secret.write_text(SECRET_KEY + "\n")
    return {
        "blobs": "s3",
        "s3_bucket": "marey",
        "s3_endpoint": proxy.endpoint,
        "s3_prefix": f"rest-{secrets.token_hex(8)}",
        "s3_key_id": KEY_ID,
        "s3_secret_key_file": secret,
        "s3_timeout_s": 3,
    }


@pytest.fixture
def opened(database_url: str, tmp_path: Path, in_bucket: dict[str, Any]) -> Iterator[Database]:
    database = connect_database(Settings(data=tmp_path, database_url=database_url, **in_bucket))
    yield database
    database.close()


@pytest.fixture
def server(
    opened: Database, tmp_path: Path, in_bucket: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> Iterator[Server]:
    """A running server whose uploads are moved at once, and that refers readers of 2 MiB or more to the bucket."""
    monkeypatch.setattr(housekeeping, "MOVE_EVERY_S", 0.1)
    with running(opened, tmp_path, **in_bucket, s3_redirect_bytes=2 * MIB) as one:
        yield one


def put(client: httpx.Client, data: bytes) -> httpx.Response:
    return client.put(f"/blobs/{digest_of(data)}", content=data, headers=OCTETS)


def test_bytes_come_back_whole_and_in_ranges(owner: httpx.Client) -> None:
    data = os.urandom(MIB + 17)
    assert put(owner, data).status_code == 204
    path = f"/blobs/{digest_of(data)}"
    assert owner.get(path).content == data
    part = owner.get(path, headers={"Range": "bytes=5-99"})
    assert (part.status_code, part.content) == (206, data[5:100])
    assert part.headers["Content-Range"] == f"bytes 5-99/{len(data)}"
    assert owner.head(path).headers["Content-Length"] == str(len(data))


def test_motion_is_imported_and_read(server: Server, owner: httpx.Client, proxy: FaultyS3) -> None:
    """The import stores a file and the arrays of a clip, for which its transaction runs several times."""
    parts = [("files", ("walk.bvh", write_bvh(generate_gait(1.2, 0.0, 1.0))))]
    answer = owner.post("/projects/lab/imports", files=parts)
    assert [entry["status"] for entry in answer.json()["entries"]] == ["created"]
    assert len([path for method, path in proxy.seen if method == "PUT" and "/blobs/" in path]) >= 2
    again = owner.post("/projects/lab/imports", files=parts)
    assert [entry["status"] for entry in again.json()["entries"]] == ["unchanged"]
    (clip,) = owner.get("/projects/lab/clips").json()["items"]
    proxy.seen.clear()
    assert owner.get(f"/projects/lab/clips/{clip['id']}/parts/motion").status_code == 200
    assert "GET" in {method for method, _ in proxy.seen}
    assert list(fsck.check_store(server.database)) == []


def test_a_storage_that_is_away_is_a_503_that_says_when_to_try_again(
    server: Server, owner: httpx.Client, proxy: FaultyS3
) -> None:
    data = os.urandom(1000)
    proxy.spoil("PUT", *["500"] * 20)
    refused = put(owner, data)
    assert (refused.status_code, refused.json()["code"]) == (503, "object-storage-unavailable")
    assert int(refused.headers["Retry-After"]) > 0
    assert "Traceback" not in refused.text
    assert proxy.endpoint not in refused.text
    assert owner.get("/me").status_code == 200
    proxy.planned.clear()
    assert put(owner, data).status_code == 204
    assert owner.get(f"/blobs/{digest_of(data)}").content == data


def test_a_server_whose_storage_is_away_is_not_ready_and_its_administrator_sees_why(
    server: Server, proxy: FaultyS3
) -> None:
    proxy.spoil("PUT", "503")
    ready = f"{server.address}/readyz"
    assert httpx.get(ready).status_code == 503
    token = server.make_user("root", administrator=True)
    seen = httpx.get(ready, headers={"Authorization": f"Bearer {token}"}).json()
    assert f"{proxy.endpoint}, bucket marey" in seen["detail"]
    assert SECRET_KEY not in str(seen)


def test_large_blobs_move_to_the_bucket_and_are_read_there_by_those_who_may(
    server: Server, owner: httpx.Client, tmp_path: Path
) -> None:
    data = os.urandom(5 * MIB + 3)
    path = f"/blobs/{digest_of(data)}"
    assert put(owner, data).status_code == 204
    patience = threading.Event()
    while (answer := owner.get(path)).status_code == 200:  # until the server has moved it
        assert answer.content == data
        patience.wait(0.1)
    assert answer.status_code == 307
    assert answer.headers["Cache-Control"] == "no-store"
    location = answer.headers["Location"]
    assert httpx.get(location).content == data
    assert httpx.get(location, headers={"Range": "bytes=7-9"}).content == data[7:10]
    assert owner.head(path).headers["Content-Length"] == str(len(data))
    stranger, nobody = server.client(server.make_user("stranger")), server.client()
    for who in (stranger, nobody):
        refused = who.get(path)
        assert (refused.status_code, refused.headers.get("Location")) == (404, None)
    with Marey(server.address, token=owner.headers["Authorization"].removeprefix("Bearer ")) as marey:
        assert marey.blobs.fetch(digest_of(data)) == data
        assert marey.blobs.fetch_to(digest_of(data), tmp_path / "copy").read_bytes() == data


def test_the_sdk_sends_no_token_to_the_bucket(
    server: Server, owner: httpx.Client, proxy: FaultyS3, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A server with this header would refuse the request, because it would check two credentials."""
    data = os.urandom(5 * MIB)
    assert put(owner, data).status_code == 204
    while owner.get(f"/blobs/{digest_of(data)}").status_code != 307:
        threading.Event().wait(0.1)
    proxy.authorizations.clear()
    with Marey(server.address, token=owner.headers["Authorization"].removeprefix("Bearer ")) as marey:
        assert marey.blobs.fetch(digest_of(data)) == data
    assert proxy.authorizations == [None]


def test_a_storage_that_is_killed_and_comes_back_loses_nothing(sqlite_template: Path, tmp_path: Path) -> None:
    """Senders repeat refused requests, as clients with retries do, while the S3 server dies and starts again."""
    folder = tmp_path / "s3"
    folder.mkdir()
    storage = seaweedfs(folder)
    secret = tmp_path / "secret-key"
    secret.write_text(SECRET_KEY)
    settings: dict[str, Any] = {
        "blobs": "s3", "s3_bucket": "marey", "s3_endpoint": storage.endpoint, "s3_key_id": KEY_ID,
        "s3_secret_key_file": secret, "s3_timeout_s": 2, "database_url": copied_sqlite(sqlite_template, tmp_path),
    }  # fmt: skip
    storage.start()
    database = connect_database(Settings(data=tmp_path, **settings))
    contents = [os.urandom(300_000) for _ in range(12)]
    statuses: list[int] = []
    began = threading.Event()
    try:
        with running(database, tmp_path, **settings) as server:
            owner = server.client(server.make_project())

            def send() -> None:
                for number, data in enumerate(contents):
                    if number == 3:
                        began.set()
                    while (status := put(owner, data).status_code) != 204:
                        statuses.append(status)

            sender = threading.Thread(target=send)
            sender.start()
            assert began.wait(60)
            storage.stop()
            while not statuses:
                threading.Event().wait(0.05)
            storage.start()
            sender.join(120)
            assert not sender.is_alive()
            assert set(statuses) == {503}
            assert [owner.get(f"/blobs/{digest_of(data)}").content for data in contents] == contents
        commands.fsck(data=tmp_path, **settings)
    finally:
        storage.stop()


def test_blobs_are_moved_by_a_command_while_a_server_runs(
    sqlite_template: Path, tmp_path: Path, in_bucket: dict[str, Any], capsys: pytest.CaptureFixture[str]
) -> None:
    place: dict[str, Any] = {"data": tmp_path, "database_url": copied_sqlite(sqlite_template, tmp_path)}
    contents = [os.urandom(100_000 + number) for number in range(5)]
    database = connect_database(Settings(**place))
    with running(database, tmp_path) as server:
        owner_token = server.make_project()
        for data in contents:
            assert put(server.client(owner_token), data).status_code == 204
    database = connect_database(Settings(**place, **in_bucket))
    with running(database, tmp_path, **in_bucket) as server:
        owner = server.client(owner_token)
        assert [owner.get(f"/blobs/{digest_of(data)}").content for data in contents] == contents
        commands.move_blobs(**place, **in_bucket)
        assert capsys.readouterr().out == f"moved 5 blobs ({sum(map(len, contents)):,} bytes)\n"
        assert [owner.get(f"/blobs/{digest_of(data)}").content for data in contents] == contents
        commands.move_blobs(**place, **in_bucket)
        assert capsys.readouterr().out == "moved 0 blobs (0 bytes)\n"
    commands.fsck(**place, **in_bucket)
    assert "5 objects" in capsys.readouterr().out


def test_a_move_that_is_interrupted_says_what_to_do(
    sqlite_template: Path, tmp_path: Path, in_bucket: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupt(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("marey_server.store.object_upkeep.moving.move_blobs", interrupt)
    with pytest.raises(commands.CommandFailed, match=r"stopped; 0 blobs .* were moved before; run the command again"):
        commands.move_blobs(data=tmp_path, database_url=copied_sqlite(sqlite_template, tmp_path), **in_bucket)
    monkeypatch.undo()
    with pytest.raises(commands.CommandFailed, match="not into the database"):
        commands.move_blobs(data=tmp_path, database_url=f"sqlite:///{tmp_path / 'marey.db'}")


def test_doctor_tells_that_the_bucket_is_away_without_its_secret(
    sqlite_template: Path, tmp_path: Path, in_bucket: dict[str, Any], proxy: FaultyS3
) -> None:
    url = copied_sqlite(sqlite_template, tmp_path)
    found = {
        check: (state, detail)
        for check, state, detail in commands.examine(data=tmp_path, database_url=url, **in_bucket)
    }
    assert found["database"][0] == "ok"
    proxy.spoil("PUT", "500")
    found = {
        check: (state, detail)
        for check, state, detail in commands.examine(data=tmp_path, database_url=url, **in_bucket)
    }
    assert found["database"][0] == "fault"
    assert f"{proxy.endpoint}, bucket marey" in found["database"][1]
    assert SECRET_KEY not in str(found)


def test_a_lane_that_is_full_refuses_the_next_request(
    owner: httpx.Client, server: Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object) -> None:
        raise UnavailableProblem("Too many requests wait.", code="busy")

    monkeypatch.setattr(server.database._moving, "submit", refuse)
    assert put(owner, b"one too many").json()["code"] == "busy"
