"""Connections and transactions, for SQLite and Postgres.

SQLite has one writer lane: writes run one after another in a thread of their own, each starting with `BEGIN IMMEDIATE`.
Reads run beside it, each in a snapshot. On Postgres both share a pool.
"""

from __future__ import annotations

import logging
import random
import sqlite3
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any, Concatenate, ParamSpec, TypeVar

import sqlalchemy
from sqlalchemy import Connection, CursorResult, Engine, Executable, Table, event, exc, make_url
from sqlalchemy.dialects import postgresql, sqlite

from marey_server.access.principal import Principal
from marey_server.errors import StorageFull, Unavailable
from marey_server.store import tables
from marey_server.store.blob_backings import BlobBacking, DatabaseBlobs
from marey_server.store.clock import Clock, DatabaseClock

P = ParamSpec("P")
T = TypeVar("T")

log = logging.getLogger(__name__)

BUSY_TIMEOUT_MS = 30_000
PAGE_BYTES = 16_384
MMAP_BYTES = 128 * 2**20
WRITE_TRIES = 5


class Transaction:
    """One transaction and the principal on whose behalf it runs."""

    def __init__(self, connection: Connection, principal: Principal, clock: Clock, blobs: BlobBacking) -> None:
        self.connection = connection
        self.principal = principal
        self.blobs = blobs
        self._clock = clock
        self._now_us: int | None = None
        self._after_commit: list[Callable[[], None]] = []

    @property
    def now_us(self) -> int:
        """The database's time, microseconds since the epoch; the same throughout the transaction."""
        if self._now_us is None:
            self._now_us = self._clock.now_us(self.connection)
        return self._now_us

    @property
    def is_postgres(self) -> bool:
        """Whether this runs on Postgres."""
        return self.connection.dialect.name == "postgresql"

    def execute(self, statement: Executable, parameters: Any = None) -> CursorResult[Any]:
        """Run one statement."""
        return self.connection.execute(statement, parameters)

    def insert_or_ignore(self, table: Table, row: Mapping[str, Any]) -> postgresql.Insert | sqlite.Insert:
        """An INSERT that does nothing where a unique index refuses the row; `returning` then gives nothing."""
        if self.is_postgres:
            return postgresql.insert(table).values(**row).on_conflict_do_nothing()
        return sqlite.insert(table).values(**row).on_conflict_do_nothing()

    def lock(self, name: str) -> None:
        """Wait until nobody else holds the lock `name`, and hold it to the end of a write.

        SQLite has one writer at a time anyway.
        """
        if self.is_postgres:
            self.execute(
                sqlalchemy.select(sqlalchemy.func.pg_advisory_xact_lock(sqlalchemy.func.hashtextextended(name, 0)))
            )

    def emit(self, kind: str, subject: str, *, project_id: str | None = None, **body: Any) -> None:
        """Record an event, visible when the transaction commits."""
        row: dict[str, Any] = {
            "at_us": self.now_us,
            "project_id": project_id,
            "kind": kind,
            "subject": subject,
            "actor": self.principal.actor,
            "body": body,
        }
        if self.is_postgres:
            row["xid"] = sqlalchemy.text("pg_current_xact_id()::text::bigint")
            self.execute(sqlalchemy.insert(tables.event).values(**row))
        else:
            self.execute(sqlalchemy.insert(tables.event), row)

    def after_commit(self, action: Callable[[], None]) -> None:
        """Run `action` once the transaction has committed; not at all if it rolls back."""
        self._after_commit.append(action)

    def run_after_commit(self) -> None:
        """Run what waits for the commit."""
        for action in self._after_commit:
            action()


class Database:
    """The connections of one server process."""

    def __init__(
        self,
        url: str,
        *,
        readers: int = 8,
        clock: Clock | None = None,
        blobs: BlobBacking | None = None,
        echo: bool = False,
    ) -> None:
        self.url = make_url(url)
        if self.url.drivername in ("postgresql", "postgres"):
            self.url = self.url.set(drivername="postgresql+psycopg")
        self.is_sqlite = self.url.get_backend_name() == "sqlite"
        self.engine = self._create_engine(readers, echo)
        self.clock: Clock = clock or DatabaseClock()
        self.blobs: BlobBacking = blobs or DatabaseBlobs()
        self._readers = ThreadPoolExecutor(readers, thread_name_prefix="marey-read")
        self._writers = ThreadPoolExecutor(1, thread_name_prefix="marey-write") if self.is_sqlite else self._readers

    def _create_engine(self, readers: int, echo: bool) -> Engine:
        if not self.is_sqlite:
            return sqlalchemy.create_engine(
                self.url, pool_size=readers, max_overflow=4, pool_pre_ping=True, pool_timeout=30, echo=echo
            )
        engine = sqlalchemy.create_engine(
            self.url,
            pool_size=readers + 2,
            max_overflow=4,
            echo=echo,
            connect_args={"timeout": BUSY_TIMEOUT_MS / 1000, "check_same_thread": False, "isolation_level": None},
            poolclass=sqlalchemy.QueuePool,
        )
        event.listen(engine, "connect", _configure_sqlite)
        event.listen(engine, "begin", _begin_sqlite)
        return engine

    # -- running functions in transactions ----------------------------------------------------------------------------

    def read(
        self,
        principal: Principal,
        function: Callable[Concatenate[Transaction, P], T],
        *args: P.args,
        **kwargs: P.kwargs,
    ) -> T:
        """Run `function(tx, ...)` in a read-only transaction of the calling thread."""
        with self._connect(readonly=True) as connection:
            return function(Transaction(connection, principal, self.clock, self.blobs), *args, **kwargs)

    def write(
        self,
        principal: Principal,
        function: Callable[Concatenate[Transaction, P], T],
        *args: P.args,
        **kwargs: P.kwargs,
    ) -> T:
        """Run `function(tx, ...)` and commit, in the calling thread.

        Runs again, from the start, when the database asks for it (deadlock, serialisation failure): `function` must
        have no effect but through its transaction.
        """
        for attempt in range(WRITE_TRIES):
            try:
                with self._connect(readonly=False) as connection:
                    tx = Transaction(connection, principal, self.clock, self.blobs)
                    answer = function(tx, *args, **kwargs)
            except exc.DBAPIError as error:
                if attempt == WRITE_TRIES - 1 or not _worth_retrying(error):
                    raise _translated(error) from error
                time.sleep(random.uniform(0, 0.02 * 2**attempt))  # noqa: S311 - spreads retries, no secret
            else:
                tx.run_after_commit()
                return answer
        raise AssertionError("unreachable")

    def submit_read(
        self,
        principal: Principal,
        function: Callable[Concatenate[Transaction, P], T],
        *args: P.args,
        **kwargs: P.kwargs,
    ) -> Future[T]:
        """`read` in a thread of the pool, for callers on an event loop."""
        return self._readers.submit(self.read, principal, function, *args, **kwargs)  # type: ignore[arg-type]

    def submit_write(
        self,
        principal: Principal,
        function: Callable[Concatenate[Transaction, P], T],
        *args: P.args,
        **kwargs: P.kwargs,
    ) -> Future[T]:
        """`write` in a thread of the pool (SQLite: in the writer lane), for callers on an event loop."""
        return self._writers.submit(self.write, principal, function, *args, **kwargs)  # type: ignore[arg-type]

    @contextmanager
    def _connect(self, *, readonly: bool) -> Iterator[Connection]:
        with self.engine.connect() as connection:
            options: Mapping[str, Any] = {"marey_readonly": readonly}
            connection = connection.execution_options(**options)
            with connection.begin():
                yield connection

    def close(self) -> None:
        """Finish what runs, then close every connection."""
        self._writers.shutdown(wait=True)
        self._readers.shutdown(wait=True)
        self.engine.dispose()


def _configure_sqlite(connection: sqlite3.Connection, _record: object) -> None:
    for pragma in (
        f"page_size = {PAGE_BYTES}",
        "journal_mode = WAL",
        "synchronous = FULL",
        "foreign_keys = ON",
        f"busy_timeout = {BUSY_TIMEOUT_MS}",
        f"mmap_size = {MMAP_BYTES}",
        "cache_size = -8192",
    ):
        connection.execute(f"PRAGMA {pragma}")


def _begin_sqlite(connection: Connection) -> None:
    readonly = connection.get_execution_options().get("marey_readonly", False)
    connection.exec_driver_sql("BEGIN" if readonly else "BEGIN IMMEDIATE")


def _worth_retrying(error: exc.DBAPIError) -> bool:
    state = getattr(error.orig, "sqlstate", None)
    return state in ("40001", "40P01") or error.connection_invalidated


def _translated(error: exc.DBAPIError) -> Exception:
    """The same failure in the server's own terms, where the caller can do something about it."""
    message = str(error.orig)
    state = getattr(error.orig, "sqlstate", None)
    if "disk is full" in message or "disk I/O error" in message or state == "53100":
        return StorageFull("The database's disk has no room left; nothing was written.")
    if "database is locked" in message or isinstance(error, exc.OperationalError):
        return Unavailable(
            "The database does not answer; nothing was written. Try again.", headers={"Retry-After": "2"}
        )
    return error
