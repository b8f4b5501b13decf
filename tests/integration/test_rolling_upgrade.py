"""Two versions of the server at one database: migrations in phases, and clients and jobs that go on meanwhile."""

from __future__ import annotations

import contextlib
import os
import shutil
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import httpx
import pytest
import sqlalchemy
from alembic import command
from sqlalchemy import Connection
from tests.support.attached_worker import python_path
from tests.support.patience import PATIENCE_S
from tests.support.queue_desk import KINDS
from tests.support.rest_server import Server
from tests.support.server_process import QUICK_LEASES, ServerProcess, WorkerProcess
from tests.support.store_fixtures import skeleton_tree
from tests.support.tcp_proxy import TcpProxy

from marey_client import Marey, blobs
from marey_schemas.access import ProjectCreate
from marey_schemas.encoding.digests import digest_of_file
from marey_schemas.queue import job_kinds
from marey_schemas.queue.jobs import JobCreate
from marey_server import commands
from marey_server.app import open_database
from marey_server.process.settings import Settings
from marey_server.store.database import schema
from marey_server.store.database.connections import Database
from marey_server.store.database.opening import DatabaseUnusable
from marey_server.store.tables import server_state

STEP = '''"""Step of the next version."""
import sqlalchemy as sa
from alembic import op
revision, down_revision, branch_labels, depends_on = "{revision}", "{before}", None, None
phase = "{phase}"
def upgrade() -> None:
    {upgrade}
def downgrade() -> None:
    {downgrade}
'''
ADD = 'op.add_column("job", sa.Column("next_note", sa.String(40), server_default="new"))'
DROP = 'op.drop_column("job", "next_note")'


class NextVersion:
    """The migrations of this version and further ones, as the next version of the server has them."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.folder = folder / "migrations"
        config = schema._config()
        shutil.copytree(str(config.get_main_option("script_location")), self.folder)
        self._patch = monkeypatch
        self.head = schema._head()

    def add(self, phase: str, upgrade: str = "pass", downgrade: str = "pass") -> str:
        """Add a migration; return its name."""
        before, self.head = self.head, f"{int(self.head) + 1:04}"
        text = STEP.format(revision=self.head, before=before, phase=phase, upgrade=upgrade, downgrade=downgrade)
        (self.folder / "versions" / f"{self.head}_next.py").write_text(text)
        return self.head

    @contextlib.contextmanager
    def runs(self) -> Iterator[None]:
        """Let the code of this process be the next version in the `with` block."""
        with self._patch.context() as patch:
            patch.setattr(schema, "_CHECKOUT", self.folder)
            schema._steps.cache_clear()
            yield
        schema._steps.cache_clear()


@pytest.fixture
def following(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, database: Database) -> Iterator[NextVersion]:
    """The next version; at the end, its changes of the database are undone, because tests share it."""
    one = NextVersion(tmp_path, monkeypatch)
    first = one.head
    yield one
    with one.runs(), database.engine.begin() as connection:
        config = schema._config()
        config.attributes["connection"] = connection
        command.downgrade(config, first)


def version_in(connection: Connection) -> str:
    return str(connection.exec_driver_sql("SELECT version_num FROM alembic_version").scalar_one())


def test_an_earlier_server_goes_on_after_a_step_that_only_adds_and_its_workers_finish(
    server: Server,
    owner: httpx.Client,
    worker: httpx.Client,
    database_url: str,
    following: NextVersion,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(job_kinds, "job_kinds", lambda: KINDS)
    submitted = owner.post("/projects/lab/jobs", json={"kind": "errand"}).json()
    (lease,) = worker.post("/leases", json={"worker": "old", "kinds": ["errand"]}).json()["leases"]
    added = following.add("before", ADD, DROP)
    with following.runs():
        done = schema.upgrade_schema(database_url, while_serving=True)
    assert (done.applied, done.additive, done.waiting) == ((added,), True, ())

    assert httpx.get(f"{server.address}/readyz").status_code == 200
    attempt = {"Authorization": f"Bearer {lease['attempt_token']}"}
    address = f"/jobs/{lease['job']}/attempts/{lease['fence']}"
    assert worker.post(f"{address}/heartbeat", json={}, headers=attempt).status_code == 200
    assert worker.post(f"{address}/complete", json={"write_id": "w" * 16}, headers=attempt).status_code == 200
    assert owner.get(f"/jobs/{submitted['id']}").json()["state"] == "succeeded"
    assert owner.post("/projects/lab/jobs", json={"kind": "errand", "cache": "off"}).status_code == 202

    open_database(Settings(data=tmp_path, database_url=database_url)).close()  # an earlier server may start, too
    commands.upgrade(data=tmp_path, database_url=database_url)
    assert "this version can serve them" in capsys.readouterr().out


def test_an_earlier_server_stops_serving_after_a_step_that_changes_what_it_uses(
    server: Server, database_url: str, following: NextVersion, tmp_path: Path
) -> None:
    following.add("stopped")
    with following.runs():
        with pytest.raises(DatabaseUnusable, match="stop all servers"):
            schema.upgrade_schema(database_url, while_serving=True)
        assert httpx.get(f"{server.address}/readyz").status_code == 503, "the next version needs the step"
        assert not schema.upgrade_schema(database_url).additive
    assert httpx.get(f"{server.address}/readyz").status_code == 503
    with pytest.raises(DatabaseUnusable, match="newer, version of Marey"):
        open_database(Settings(data=tmp_path, database_url=database_url))


def test_steps_after_the_upgrade_wait_until_they_are_wanted(
    database: Database, database_url: str, following: NextVersion, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first = following.head
    added, removing = following.add("before"), following.add("after")
    waits = () if database.is_sqlite else (removing,)
    with following.runs():
        commands.upgrade(data=tmp_path, database_url=database_url)
        assert ("db upgrade --finish" in capsys.readouterr().out) == bool(waits)
        with database.engine.begin() as connection:
            assert version_in(connection) == (added if waits else removing)
            assert schema.schema_fits(connection)
        commands.upgrade(data=tmp_path, database_url=database_url, finish=True)
        with database.engine.begin() as connection:
            assert version_in(connection) == removing
            assert schema.schema_fits(connection)
        open_database(Settings(data=tmp_path, database_url=database_url), while_serving=not database.is_sqlite).close()
    with database.engine.begin() as connection:
        assert not schema.schema_fits(connection), "an earlier version may use what was removed"
        served = sqlalchemy.select(server_state.c.value).where(server_state.c.key == schema.SERVED_FROM)
        assert connection.execute(served).scalar_one() == removing > first


# -- requests, uploads and jobs while servers are replaced -------------------------------------------------------------


class Visitors:
    """A thread that writes and reads, and one that sends a file in many pieces, each with the usual retries."""

    def __init__(self, url: str, token: str, file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.written, self.pieces = 0, 0
        self._url, self._token, self._file = url, token, file
        self._stopping = threading.Event()
        send_piece = blobs._send_piece

        def count_piece(*given: Any) -> Any:
            self.pieces += 1
            return send_piece(*given)

        monkeypatch.setattr(blobs, "PIECE_BYTES", 1 << 15)
        monkeypatch.setattr(blobs, "_send_piece", count_piece)
        self._pool = ThreadPoolExecutor(2)
        self._running = [self._pool.submit(self._write), self._pool.submit(self._upload)]

    def stop(self) -> None:
        """Wait until the file is sent, and end both threads. Raises the first error of a client."""
        self._stopping.set()
        self._pool.shutdown()
        for one in self._running:
            one.result()

    def await_more(self, count: int) -> None:
        """Wait until `count` more items have been written, and `count` more pieces of the file have been sent."""
        written, pieces = self.written + count, self.pieces + count
        deadline = time.monotonic() + PATIENCE_S
        while self.written < written or self.pieces < pieces:
            failed = [one.exception() for one in self._running if one.done()]
            assert not failed, failed
            assert time.monotonic() < deadline
            time.sleep(0.02)

    def _write(self) -> None:
        with Marey(self._url, self._token) as marey:
            rigs = marey.project("lab").skeletons
            while not self._stopping.is_set():
                made = rigs.create(f"rig {self.written}", {"hierarchy": skeleton_tree()})
                assert rigs.get(made.id).id == made.id
                self.written += 1

    def _upload(self) -> None:
        with Marey(self._url, self._token) as marey:
            blobs.send_in_pieces(marey.transport, self._file, digest_of_file(self._file))


@pytest.mark.soak
def test_no_client_with_retries_sees_a_failure_while_servers_are_replaced(
    database_url: str, following: NextVersion, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On Postgres, the servers overlap; on SQLite, the second starts when the first has ended."""
    overlap = not database_url.startswith("sqlite")
    settings = QUICK_LEASES | {"PYTHONPATH": python_path()}
    old, new = (ServerProcess(tmp_path, database_url, **settings) for _ in range(2))
    worker = WorkerProcess(tmp_path / "worker.log", PYTHONPATH=python_path())
    (file := tmp_path / "file").write_bytes(os.urandom(1 << 22))
    with ExitStack() as stack:
        for process in (old, new, worker):
            stack.callback(process.stop)
        old.start()
        front = stack.enter_context(TcpProxy(old.port))
        address = f"http://127.0.0.1:{front.port}"
        worker.start(address, old.token, tmp_path, name="steady")
        with Marey(address, old.token) as marey:
            lab = marey.create_project(ProjectCreate(name="lab"))
            job = lab.submit(JobCreate(kind="draw", params={"name": "slow", "seed": 1, "seconds": 8}))
            while marey.jobs.get(job.id).state != "running":
                time.sleep(0.1)
            visitors = Visitors(address, old.token, file, monkeypatch)
            stack.callback(visitors.stop)
            visitors.await_more(3)
            following.add("before", ADD, DROP)
            if overlap:
                with following.runs():
                    assert schema.upgrade_schema(database_url, while_serving=True).additive
                new.start()
            else:
                assert old.stop() == 0
                with following.runs():
                    schema.upgrade_schema(database_url)
                new.start()
            front.target_port = new.port
            visitors.await_more(3)
            assert old.stop() == 0
            visitors.await_more(3)
            ended = marey.jobs.wait(job.id, timeout_s=PATIENCE_S)
            visitors.stop()
            assert [one.outcome for one in marey.jobs.attempts(ended.id)] == ["succeeded"]
            assert marey.blobs.fetch(digest_of_file(file)) == file.read_bytes()
            assert len(list(lab.skeletons.list())) == visitors.written + 1
    new.check_database()
