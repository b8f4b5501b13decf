"""Engines: the connections to SQLite and Postgres, their settings, and how their transactions begin and end."""

from __future__ import annotations

import json
import sqlite3
from typing import Any

import sqlalchemy
from sqlalchemy import URL, Connection, Engine, event

from marey_server.store.database.clock import POSTGRES_NOW
from marey_server.store.database.prepared import run_texts
from marey_server.store.database.write_ahead_log import PAGE_BYTES, SHORT_BYTES

BUSY_TIMEOUT_MS = 30_000
CACHE_KIB = 4096
_POSTGRES_SETTINGS = {
    "statement_timeout": "120s",
    "lock_timeout": "30s",
    "idle_in_transaction_session_timeout": "300s",  # a server that was stopped must not hold its locks for ever
}


def _dumps(value: Any) -> str:
    return json.dumps(value, ensure_ascii=False, allow_nan=False, separators=(",", ":"))


def sqlite_engine(url: URL, connections: int, echo: bool, *, begin: str, query_only: bool = False) -> Engine:
    """Return an engine for SQLite, whose transactions begin with the statement `begin`."""
    engine = sqlalchemy.create_engine(
        url,
        pool_size=connections,
        max_overflow=4,
        echo=echo,
        hide_parameters=True,  # parameters contain hashes of secrets, and failed statements are logged
        json_serializer=_dumps,
        connect_args={"timeout": BUSY_TIMEOUT_MS / 1000, "check_same_thread": False, "isolation_level": None},
        poolclass=sqlalchemy.QueuePool,
    )
    # No memory map: it would save 15 us of a read of 150 KB, but every connection would need memory.
    pragmas = [
        f"page_size = {PAGE_BYTES}",
        "journal_mode = WAL",
        f"journal_size_limit = {SHORT_BYTES}",
        "wal_autocheckpoint = 0",  # see `WriteAheadLog`
        "synchronous = FULL",
        "foreign_keys = ON",
        f"cache_size = -{CACHE_KIB}",
        f"query_only = {'ON' if query_only else 'OFF'}",
    ]

    def configure(connection: sqlite3.Connection, _record: object) -> None:
        for pragma in pragmas:
            connection.execute(f"PRAGMA {pragma}")

    event.listen(engine, "connect", configure)
    event.listen(engine, "begin", lambda connection: connection.exec_driver_sql(begin))
    return engine


def postgres_engine(url: URL, connections: int, echo: bool) -> Engine:
    """Return an engine for Postgres, with limits of time for statements and locks."""
    connect_args: dict[str, Any] = {"application_name": "marey", "connect_timeout": 10}
    if "options" not in url.query:
        connect_args["options"] = " ".join(f"-c {name}={value}" for name, value in _POSTGRES_SETTINGS.items())
    return sqlalchemy.create_engine(
        url,
        pool_size=connections,
        max_overflow=4,
        pool_timeout=30,
        echo=echo,
        hide_parameters=True,  # parameters contain hashes of secrets, and failed statements are logged
        isolation_level="READ COMMITTED",
        json_serializer=_dumps,
        connect_args=connect_args,
    )


def begin_snapshot(connection: Connection) -> int:
    """Begin a read-only transaction of Postgres that sees one snapshot; return the time of Postgres in microseconds.

    The statement that begins the transaction and the query for the time are sent in one round trip. The connection must
    be in the mode AUTOCOMMIT, in which the driver does not begin a transaction by itself.
    """
    ((now_us,),) = run_texts(connection, ("BEGIN ISOLATION LEVEL REPEATABLE READ READ ONLY", POSTGRES_NOW))
    return int(now_us)


def roll_back(connection: Connection) -> None:
    """Roll back a transaction of Postgres, and keep the statements that the driver has prepared.

    The driver's own rollback discards them with a further statement, because the transaction may have changed tables.
    Then the next requests on this connection would be slower: their statements would be parsed and planned again. If
    the connection is broken, this function does nothing; the rollback of SQLAlchemy, which follows, reports the fault.
    """
    driver: Any = None if connection.invalidated else connection.connection.driver_connection
    if driver is not None and not driver.closed:
        driver.pgconn.exec_(b"ROLLBACK")
