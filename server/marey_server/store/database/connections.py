"""Connections and transactions for SQLite and Postgres.

Threads run transactions, and clients take turns to use the threads (see `lanes`). Other threads are reserved for short
transactions on which the server and its workers depend: heartbeats, claims, completions, readiness, sign-in and
admission.

A read sees one snapshot and cannot write. A write is READ COMMITTED on Postgres, so that the conditions of an UPDATE
are checked against the current row once it is locked. On SQLite, a single thread runs the writes one after another.
Each write starts with `BEGIN IMMEDIATE`, and reads run at the same time as writes.
"""

from __future__ import annotations

import errno
import sqlite3
import threading
import time
from collections.abc import AsyncGenerator, Callable
from concurrent.futures import Future
from contextlib import AbstractContextManager, nullcontext
from typing import Any, Concatenate, ParamSpec, TypeVar

import sqlalchemy
from sqlalchemy import Connection, exc, make_url

from marey_schemas.backoff import Backoff
from marey_server.access.principal import Principal
from marey_server.errors import ApiProblem, InvalidProblem, StorageFullProblem, UnavailableProblem
from marey_server.store import tables
from marey_server.store.blob_backings import BlobBacking, DatabaseBlobs
from marey_server.store.database.clock import Clock, DatabaseClock, save_high_water
from marey_server.store.database.engines import begin_snapshot, postgres_engine, roll_back, sqlite_engine
from marey_server.store.database.lanes import SERVER, Client, Lane
from marey_server.store.database.opening import sqlite_file
from marey_server.store.database.write_ahead_log import WriteAheadLog
from marey_server.store.database.write_lane import WriteLane
from marey_server.store.transaction import IGNORED, Observer, Quotas, Transaction

P = ParamSpec("P")
T = TypeVar("T")

WRITE_TRIES = 5
WRITE_BACKOFF = Backoff(first_s=0.02, longest_s=0.16, jitter=1.0)
READ_TRIES = 3
RESERVED_THREADS = 3
"""Number of threads, and of connections, for short transactions that must not wait for other transactions."""
SHARED_BY_ALL = 2
"""Greatest number of ordinary threads of which one client may use all; half of two would make a lone client slow."""


class Database:
    """Connections of one server process to its database."""

    def __init__(
        self,
        url: str,
        *,
        readers: int = 8,
        clock: Clock | None = None,
        blobs: BlobBacking | None = None,
        quotas: Quotas | None = None,
        echo: bool = False,
    ) -> None:
        self.url = make_url(url)
        if self.url.drivername in ("postgresql", "postgres"):
            self.url = self.url.set(drivername="postgresql+psycopg")
        self.is_sqlite = self.url.get_backend_name() == "sqlite"
        if self.is_sqlite:
            self.engine = sqlite_engine(self.url, 2, echo, begin="BEGIN IMMEDIATE")
            self._read_engine = sqlite_engine(
                self.url, readers + RESERVED_THREADS, echo, begin="BEGIN", query_only=True
            )
        else:
            self.engine = postgres_engine(self.url, readers + RESERVED_THREADS, echo)
            self._read_engine = self.engine.execution_options(isolation_level="AUTOCOMMIT")  # see `begin_snapshot`
        self.clock: Clock = clock or DatabaseClock()
        self._has_own_clock = clock is None
        self._high_water_us = 0
        self.blobs: BlobBacking = blobs or DatabaseBlobs()
        self.quotas = quotas or Quotas()
        self.observer: Observer = IGNORED
        """Receiver of numbers about the transactions of this process; the server replaces it."""
        self._lane: AbstractContextManager[Any] = threading.Lock() if self.is_sqlite else nullcontext()
        file = sqlite_file(self.url)
        self._log = WriteAheadLog(file) if file else None
        self._ordinary = Lane("marey-database", readers, most_each=readers if readers <= SHARED_BY_ALL else readers - 1)
        self._reserved = Lane("marey-reserved", RESERVED_THREADS, most_each=RESERVED_THREADS - 1)
        self._write_lane = WriteLane(self.write) if self.is_sqlite else None

    @property
    def shown(self) -> str:
        """Return the address of the database without its password."""
        if self.is_sqlite:
            return str(self.url.database)
        return self.url.set(query={}).render_as_string(hide_password=True)

    @property
    def lanes(self) -> dict[str, Lane | WriteLane]:
        """The lanes by name."""
        lanes: dict[str, Lane | WriteLane] = {"database": self._ordinary, "database-reserved": self._reserved}
        return lanes if self._write_lane is None else {**lanes, "database-writing": self._write_lane}

    @property
    def is_behind(self) -> bool:
        """Whether writes of many bytes should wait until the database has processed earlier writes."""
        return self._log is not None and self._log.is_long

    @property
    def connections_in_use(self) -> int:
        """The number of connections that run a transaction."""
        pools = {self.engine.pool, self._read_engine.pool}
        return sum(pool.checkedout() for pool in pools if isinstance(pool, sqlalchemy.QueuePool))

    # -- running functions in transactions ----------------------------------------------------------------------------

    def read(
        self,
        principal: Principal,
        function: Callable[Concatenate[Transaction, P], T],
        *args: P.args,
        **kwargs: P.kwargs,
    ) -> T:
        """Run `function(tx, ...)` in a read-only transaction in the calling thread; retry if the connection breaks."""
        for attempt in range(READ_TRIES):
            try:
                with self._read_engine.connect() as connection, connection.begin() as transaction:
                    begun_us = None if self.is_sqlite else begin_snapshot(connection)
                    tx = self._transaction(connection, principal, begun_us if self._has_own_clock else None)
                    try:
                        return function(tx, *args, **kwargs)
                    except ApiProblem:
                        transaction.commit()  # there is nothing to roll back, and see `roll_back`
                        raise
            except _FAILURES as error:
                if attempt == READ_TRIES - 1 or not _worth_retrying(error):
                    raise _translated(error) from error
        raise AssertionError("unreachable")

    def write(
        self,
        principal: Principal,
        function: Callable[Concatenate[Transaction, P], T],
        *args: P.args,
        **kwargs: P.kwargs,
    ) -> T:
        """Run `function(tx, ...)` and commit, in the calling thread.

        The function runs again from the start after a deadlock, a serialisation failure, or a connection that broke
        before the commit. So the function may change things only through its transaction.
        """
        for attempt in range(WRITE_TRIES):
            try:
                with self._lane, self.engine.connect() as connection:
                    tx = self._transaction(connection, principal)
                    answer = self._run_and_commit(tx, function, *args, **kwargs)
            except _FAILURES as error:
                if attempt == WRITE_TRIES - 1 or not _worth_retrying(error):
                    raise _translated(error) from error
                time.sleep(WRITE_BACKOFF.delay_s(attempt + 1))
            else:
                tx.run_after_commit()
                return answer
        raise AssertionError("unreachable")

    def _transaction(self, connection: Connection, principal: Principal, now_us: int | None = None) -> Transaction:
        return Transaction(connection, principal, self.clock, self.blobs, self.quotas, self.observer, now_us=now_us)

    def _run_and_commit(
        self,
        tx: Transaction,
        function: Callable[Concatenate[Transaction, P], T],
        *args: P.args,
        **kwargs: P.kwargs,
    ) -> T:
        with tx.connection.begin() as transaction:
            try:
                answer = function(tx, *args, **kwargs)
            except ApiProblem:
                if not self.is_sqlite:
                    roll_back(tx.connection)
                raise
            high_water_us = self._high_water_us
            if self.is_sqlite and tx.now_us >= high_water_us:
                high_water_us = save_high_water(tx.connection, tx.now_us)
            try:
                transaction.commit()
            except exc.DBAPIError as error:
                if (
                    error.connection_invalidated
                ):  # nobody knows whether it was committed; doing it again could do it twice
                    raise _no_answer(
                        "The connection to the database broke during the commit, so it is unknown whether "
                        "the change was stored; check before you try again."
                    ) from error
                raise
        self._high_water_us = high_water_us
        if self._log is not None:
            driver: sqlite3.Connection = tx.connection.connection.driver_connection  # type: ignore[assignment]
            self._log.after_commit(driver)
        return answer

    def submit_write(
        self,
        principal: Principal,
        function: Callable[Concatenate[Transaction, P], T],
        *args: P.args,
        **kwargs: P.kwargs,
    ) -> Future[T]:
        """Run `write` in a thread, on behalf of the server itself; return the future of the function's result."""
        return self.queue_write(SERVER, principal, lambda tx: function(tx, *args, **kwargs))

    def queue_read(
        self, client: Client, principal: Principal, function: Callable[[Transaction], T], *, reserved: bool = False
    ) -> Future[T]:
        """Run `self.read(principal, function)` for a client, in a thread for ordinary reads.

        With `reserved`, use a thread for reserved reads. If the client closes the connection, the read is stopped
        before its next statement. Raises `UnavailableProblem` if too many calls wait.
        """

        def run(tx: Transaction) -> T:
            tx.before_statement = client.require_present
            return function(tx)

        lane = self._reserved if reserved else self._ordinary
        return lane.submit(client, self.read, principal, run)

    def queue_write(
        self, client: Client, principal: Principal, function: Callable[[Transaction], T], *, reserved: bool = False
    ) -> Future[T]:
        """Run `self.write(principal, function)` for a client in a thread.

        On SQLite, a reserved write runs before the other waiting writes. The write runs even if the client has closed
        the connection. Raises `UnavailableProblem` if too many writes wait.
        """
        client = Client(client.key, client.known)
        if self._write_lane is not None:
            return self._write_lane.submit(client, principal, function, reserved=reserved)
        lane = self._reserved if reserved else self._ordinary
        return lane.submit(client, self.write, principal, function)

    async def notifications(self, channel: str) -> AsyncGenerator[None]:
        """Listen to a channel of Postgres: yield once when the server listens, and then after each notification.

        The connection is not taken from the pool. Raises `UnavailableProblem` if it breaks.
        """
        arguments, options = self.engine.dialect.create_connect_args(self.url)
        driver = self.engine.dialect.loaded_dbapi
        try:
            connection = await driver.AsyncConnection.connect(*arguments, **options, autocommit=True)
            async with connection:
                await connection.execute(f"LISTEN {channel}")
                yield
                async for _ in connection.notifies():
                    yield
        except driver.Error as error:
            raise _no_answer("The database connection for notifications has ended.") from error

    def close(self) -> None:
        """Finish the running transactions, then close all connections."""
        if self._write_lane is not None:
            self._write_lane.close()
        self._reserved.close()
        self._ordinary.close()
        if self._log is not None:
            self._log.close()
        self._read_engine.dispose()
        self.engine.dispose()


# -- failures ---------------------------------------------------------------------------------------------------------

_FAILURES = (exc.DBAPIError, exc.TimeoutError, OSError, OverflowError, UnicodeEncodeError)


def _worth_retrying(error: Exception) -> bool:
    if not isinstance(error, exc.DBAPIError):
        return False
    constraint = getattr(getattr(error.orig, "diag", None), "constraint_name", None)
    return (
        error.connection_invalidated
        or getattr(error.orig, "sqlstate", None) in _TRY_AGAIN
        or constraint == tables.ONE_RUNS_PER_KEY
    )


_TRY_AGAIN = ("40001", "40P01")
"""SQLSTATE codes after which a transaction is retried: serialisation failure, deadlock."""


def _translated(error: Exception) -> Exception:
    """Convert a failure of the database into an error of the server, if the caller can react to the failure.

    Other failures are returned unchanged.
    """
    if isinstance(error, OSError):
        full = error.errno in (errno.ENOSPC, errno.EDQUOT)
        return StorageFullProblem("The disk has no space left; nothing was written.") if full else error
    if isinstance(error, exc.TimeoutError):
        return _no_answer("All connections to the database are in use; nothing was written.")
    if isinstance(error, OverflowError | UnicodeEncodeError | exc.DataError):
        return InvalidProblem("The request contains a number or text that the database cannot store.", code="bad-value")
    if not isinstance(error, exc.DBAPIError):
        return error
    message = str(error.orig)
    if "disk is full" in message or getattr(error.orig, "sqlstate", None) == "53100":
        return StorageFullProblem("The disk of the database has no space left; nothing was written.")
    if isinstance(error, exc.OperationalError) and not message.startswith(("no such", "near ")):  # those are our faults
        return _no_answer("The database does not answer; nothing was written. Try again.")
    return error


def _no_answer(detail: str) -> UnavailableProblem:
    return UnavailableProblem(detail, headers={"Retry-After": "2"})
