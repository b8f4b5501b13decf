"""A backup that is made while clients write, with blobs in object storage: a server uses the restored copy."""

from __future__ import annotations

import os
import secrets
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import httpx
import pytest
from sqlalchemy import make_url
from tests.support.database_copies import dump, restore_dump
from tests.support.database_fixtures import database_address, empty_postgres_database
from tests.support.patience import PATIENCE_S
from tests.support.rest_server import Server, running
from tests.support.s3_servers import SECRET_KEY, S3Server

from marey_schemas.encoding.digests import digest_of
from marey_schemas.formats import OCTETS
from marey_server import commands
from marey_server.app import connect_database
from marey_server.process import housekeeping
from marey_server.process.settings import Settings
from marey_server.store.fsck import check_store
from marey_server.store.object_storage.client import Bucket, ObjectStorage

pytestmark = pytest.mark.xdist_group("object storage")


class Writers:
    """Two threads that upload bytes, create items that refer to them, and submit jobs.

    `done` and `jobs` contain what the server has confirmed.
    """

    def __init__(self, server: Server, token: str) -> None:
        self.done: dict[str, bytes] = {}
        """The bytes to which each study refers, by the id of the study."""
        self.jobs: set[str] = set()
        self._clients = [server.client(token) for _ in range(2)]
        self._stopping = threading.Event()
        self._threads = [threading.Thread(target=self._run, args=(number,)) for number in range(2)]
        self._failures: list[str] = []

    def __enter__(self) -> Writers:
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, *_error: object) -> None:
        self._stopping.set()
        for thread in self._threads:
            thread.join(PATIENCE_S)
        assert self._failures == []

    def await_more(self, count: int) -> None:
        """Wait until this number of further studies has been created."""
        wanted, deadline = len(self.done) + count, time.monotonic() + PATIENCE_S
        while len(self.done) < wanted:
            assert time.monotonic() < deadline, self._failures
            time.sleep(0.02)

    def _run(self, writer: int) -> None:
        client, number = self._clients[writer], 0
        while not self._stopping.is_set():
            number += 1
            try:
                self._write(client, f"study {writer} {number}")
            except (httpx.HTTPError, KeyError) as error:
                self._failures.append(repr(error))
                return

    def _write(self, client: httpx.Client, name: str) -> None:
        data = os.urandom(20_000)
        study = store_study(client, name, data)
        job = client.post("/projects/lab/jobs", json={"kind": "errand", "cache": "off"}).raise_for_status()
        self.jobs.add(job.json()["id"])
        self.done[study] = data


def store_study(client: httpx.Client, name: str, data: bytes) -> str:
    """Upload bytes, and create a study that refers to them; return the id of the study."""
    digest = digest_of(data)
    client.put(f"/blobs/{digest}", content=data, headers={"Content-Type": OCTETS}).raise_for_status()
    study = {"schema": "marey/document@1", "blob": digest}
    made = client.post("/projects/lab/characters", json={"name": name, "parts": {"character": study}})
    return str(made.raise_for_status().json()["id"])


def copy_objects(source: Bucket, target: Bucket) -> int:
    """Copy the objects that `target` does not have; return their number."""
    known = {one.name for page in ObjectStorage(target).pages() for one in page}
    copied = 0
    for page in ObjectStorage(source).pages():
        for one in page:
            if one.name not in known:
                size = ObjectStorage(source).size_of(one.name)
                assert size is not None
                data = ObjectStorage(source).read(one.name, 0, size)
                assert data is not None
                ObjectStorage(target).put(one.name, [data])
                copied += 1
    return copied


@contextmanager
def restored(database_url: str, data: Path, folder: Path) -> Iterator[Callable[[], str]]:
    """Make a backup now; yield a function that restores it, and returns the address of the new database."""
    with ExitStack() as stack:
        if database_url.startswith("sqlite"):
            commands.backup(target=folder / "backup.db", data=data)

            def restore() -> str:
                commands.restore(source=folder / "backup.db", data=folder)
                return f"sqlite:///{folder / 'marey.db'}"
        else:
            dump(database_url.replace("+psycopg", ""), folder / "backup.dump")

            def restore() -> str:
                url = stack.enter_context(empty_postgres_database(make_url(database_url), "restored"))
                restore_dump(folder / "backup.dump", database_address(url.set(drivername="postgresql")))
                return database_address(url)

        yield restore


@pytest.mark.soak
def test_a_backup_under_load_is_restored_with_everything_that_was_confirmed_before_it(
    database_url: str,
    tmp_path: Path,
    s3_servers: Callable[[str], S3Server],
    monkeypatch: pytest.MonkeyPatch,
    test_kinds: None,
) -> None:
    monkeypatch.setattr(housekeeping, "MOVE_EVERY_S", 0.1)
    source = s3_servers("seaweedfs").bucket(f"backup-{secrets.token_hex(8)}")
    target = replace(source, prefix=f"restored-{secrets.token_hex(8)}")
    (tmp_path / "secret").write_text(SECRET_KEY)
    (elsewhere := tmp_path / "elsewhere").mkdir()

    def settings(data: Path, url: str, bucket: Bucket) -> dict[str, Any]:
        return {
            "data": data, "database_url": url, "blobs": "s3", "s3_bucket": bucket.name, "s3_prefix": bucket.prefix,
            "s3_endpoint": bucket.endpoint, "s3_key_id": bucket.key_id, "s3_secret_key_file": tmp_path / "secret",
        }  # fmt: skip

    before = settings(tmp_path, database_url, source)
    with running(connect_database(Settings(**before)), **_for_server(before)) as server:
        owner_token = server.make_project()
        with Writers(server, owner_token) as writers:
            writers.await_more(4)
            assert copy_objects(source, target) > 0
            writers.await_more(4)
            studies, jobs = dict(writers.done), set(writers.jobs)
            with restored(database_url, tmp_path, elsewhere) as restore:
                writers.await_more(2)
                after = settings(elsewhere, restore(), target)
                missing = findings(after)
                assert copy_objects(source, target) > 0
                assert missing, "objects that were stored after the first copy are part of the backup"
                assert findings(after) == []
                with running(connect_database(Settings(**after)), **_for_server(after)) as restored_server:
                    owner = restored_server.client(owner_token)
                    assert_serves(owner, studies, jobs)
                assert findings(after) == []


def _for_server(settings: dict[str, Any]) -> dict[str, Any]:
    given = {name: value for name, value in settings.items() if name not in ("data", "database_url")}
    return {"folder": settings["data"], **given}


def findings(settings: dict[str, Any]) -> list[str]:
    """Return what `marey db fsck` finds."""
    with closing(connect_database(Settings(**settings))) as database:
        return [str(one) for one in check_store(database)]


def assert_serves(owner: httpx.Client, studies: dict[str, bytes], jobs: set[str]) -> None:
    """Check that all studies and jobs are there, and that further writes work."""
    for study, data in studies.items():
        found = owner.get(f"/projects/lab/characters/{study}/parts/character").raise_for_status().json()["blob"]
        assert owner.get(f"/blobs/{found}").raise_for_status().content == data
    for job in jobs:
        assert owner.get(f"/jobs/{job}").raise_for_status().json()["state"] == "queued"
    assert store_study(owner, "after the restore", b"bytes" * 1000)
    assert owner.post(f"/jobs/{min(jobs)}/cancel").raise_for_status().json()["state"] == "cancelled"
