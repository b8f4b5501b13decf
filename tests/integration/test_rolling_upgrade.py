"""Two versions of the server at one database: migrations in phases, and an earlier server that goes on."""

from __future__ import annotations

import contextlib
import shutil
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest
import sqlalchemy
from alembic import command
from sqlalchemy import Connection
from tests.support.queue_desk import KINDS
from tests.support.rest_server import Server

from marey_schemas.queue import job_kinds
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
