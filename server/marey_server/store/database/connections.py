"""Connections and transactions for SQLite and Postgres.

Threads run transactions, and clients take turns to use the threads (see `lanes`). Other threads are reserved for short
transactions on which the server and its workers depend: heartbeats, claims, completions, readiness, sign-in and
admission.

A read sees one snapshot and cannot write. A write is READ COMMITTED on Postgres, so that the conditions of an UPDATE
are checked against the current row once it is locked. On SQLite, a single thread runs the writes one after another.
Each write starts with `BEGIN IMMEDIATE`, and reads run at the same time as writes.
"""

from __future__ import annotations

import sqlite3
import threading
import time
from collections.abc import AsyncGenerator, Callable
from concurrent.futures import Future
from contextlib import AbstractContextManager, nullcontext
from functools import partial
from typing import Any, Concatenate, ParamSpec, TypeVar, cast

import sqlalchemy
from sqlalchemy import Connection, exc, make_url

from marey_server.access.own_pods import PodRules
from marey_server.access.principal import Principal
from marey_server.errors import ApiProblem
from marey_server.store.blob_backings import BlobBacking, DatabaseBlobs
from marey_server.store.database.byte_moves import MovingCall, run_and_move
from marey_server.store.database.clock import Clock, DatabaseClock, save_high_water
from marey_server.store.database.engines import begin_snapshot, postgres_engine, roll_back, sqlite_engine
from marey_server.store.database.failures import (
    FAILURES,
    READ_TRIES,
    WRITE_BACKOFF,
    WRITE_TRIES,
    no_answer,
    translated,
    worth_retrying,
)
from marey_server.store.database.lanes import SERVER, Client, Lane
from marey_server.store.database.opening import sqlite_file
from marey_server.store.database.write_ahead_log import WriteAheadLog
from marey_server.store.database.write_lane import WriteLane
from marey_server.store.object_storage.backing import ObjectBlobs
from marey_server.store.transaction import IGNORED, Observer, Quotas, Transaction

P = ParamSpec("P")
T = TypeVar("T")

MOVING_THREADS = 16
"""Number of threads that move bytes to and from object storage; they are started when they are needed."""
RESERVED_THREADS = 3
"""Number of threads, and of connections, for short transactions that must not wait for other transactions."""
SHARED_BY_ALL = 2
"""Number of ordinary threads up to which one client may use all of them at the same time.

If there are more ordinary threads, one client may use all but one.
"""


class Database:
    """Connections of one server process to its database."""

    def __init__(
        self,
        url: str,
        *,
        readers: int = 8,
        clock: Clock | None = None,
        blobs: BlobBacking | ObjectBlobs | None = None,
        quotas: Quotas | None = None,
        pod_rules: PodRules | None = None,
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
        self.blobs: BlobBacking | ObjectBlobs = blobs or DatabaseBlobs()
        self.quotas = quotas or Quotas()
        self.pod_rules = pod_rules
        self.observer: Observer = IGNORED
        """Receiver of numbers about the transactions of this process; the server replaces it."""
        self._lane: AbstractContextManager[Any] = threading.Lock() if self.is_sqlite else nullcontext()
        file = sqlite_file(self.url)
        self._log = WriteAheadLog(file) if file else None
        self._ordinary = Lane("marey-database", readers, most_each=readers if readers <= SHARED_BY_ALL else readers - 1)
        self._reserved = Lane("marey-reserved", RESERVED_THREADS, most_each=RESERVED_THREADS - 1)
        self._moving = Lane("marey-objects", MOVING_THREADS, most_each=MOVING_THREADS - MOVING_THREADS // 4)
        self._write_lane = WriteLane(self._write) if self.is_sqlite else None

    @property
    def shown(self) -> str:
        """Return the address of the database without its password."""
        if self.is_sqlite:
            return str(self.url.database)
        return self.url.set(query={}).render_as_string(hide_password=True)

    @property
    def lanes(self) -> dict[str, Lane | WriteLane]:
        """Lanes of this process by name: groups of threads that run the calls for this database."""
        lanes: dict[str, Lane | WriteLane] = {"database": self._ordinary, "database-reserved": self._reserved}
        if isinstance(self.blobs, ObjectBlobs):
            lanes["object-storage"] = self._moving
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
        """Run `function(tx, ...)` in a read-only transaction in the calling thread; retry if the connection breaks.

        If the function needs bytes from object storage, they are read outside the transaction, and the function runs
        again.
        """

        def run(tx: Transaction) -> T:
            return function(tx, *args, **kwargs)

        return run_and_move(self.blobs, lambda wanted: self._read(principal, wanted), run)

    def _read(self, principal: Principal, function: Callable[[Transaction], T]) -> T:
        for attempt in range(READ_TRIES):
            try:
                with self._read_engine.connect() as connection, connection.begin() as transaction:
                    begun_us = None if self.is_sqlite else begin_snapshot(connection)
                    tx = self._transaction(connection, principal, begun_us if self._has_own_clock else None)
                    try:
                        return function(tx)
                    except ApiProblem:
                        transaction.commit()  # there is nothing to roll back, and see `roll_back`
                        raise
            except FAILURES as error:
                if attempt == READ_TRIES - 1 or not worth_retrying(error):
                    raise translated(error) from error
        raise AssertionError("the last try of a read returns or raises")

    def write(
        self,
        principal: Principal,
        function: Callable[Concatenate[Transaction, P], T],
        *args: P.args,
        **kwargs: P.kwargs,
    ) -> T:
        """Run `function(tx, ...)` and commit, in the calling thread.

        The function runs again from the start after a deadlock, a serialisation failure, or a connection that broke
        before the commit. It also runs again if it needs bytes to be moved to or from object storage, which is done
        outside the transaction. So the function may change things only through its transaction.
        """

        def run(tx: Transaction) -> T:
            return function(tx, *args, **kwargs)

        return run_and_move(self.blobs, lambda wanted: self._write(principal, wanted), run)

    def _write(self, principal: Principal, function: Callable[[Transaction], T]) -> T:
        for attempt in range(WRITE_TRIES):
            try:
                with self._lane, self.engine.connect() as connection:
                    tx = self._transaction(connection, principal)
                    answer = self._run_and_commit(tx, function)
            except FAILURES as error:
                if attempt == WRITE_TRIES - 1 or not worth_retrying(error):
                    raise translated(error) from error
                time.sleep(WRITE_BACKOFF.delay_s(attempt + 1))
            else:
                tx.run_after_commit()
                return answer
        raise AssertionError("the last try of a write returns or raises")

    def _transaction(self, connection: Connection, principal: Principal, now_us: int | None = None) -> Transaction:
        blobs = self.blobs.local if isinstance(self.blobs, ObjectBlobs) else self.blobs  # see `run_and_move`
        return Transaction(
            connection,
            principal,
            self.clock,
            blobs,
            self.quotas,
            self.observer,
            pod_rules=self.pod_rules,
            now_us=now_us,
        )

    def _run_and_commit(self, tx: Transaction, function: Callable[[Transaction], T]) -> T:
        with tx.connection.begin() as transaction:
            try:
                answer = function(tx)
            except ApiProblem:
                if not self.is_sqlite:
                    roll_back(tx.connection)
                raise
            high_water_us = self._high_water_us
            if self.is_sqlite and tx.now_us >= high_water_us:
                high_water_us = save_high_water(tx.connection, tx.now_us)
                self.clock.catch_up(high_water_us)
            try:
                transaction.commit()
            except exc.DBAPIError as error:
                if (
                    error.connection_invalidated
                ):  # nobody knows whether it was committed; doing it again could do it twice
                    raise no_answer(
                        "The connection to the database broke during the commit, so it is unknown whether "
                        "the change was stored; check before you try again."
                    ) from error
                if self.is_sqlite:  # a commit that fails on a full disk may leave its transaction open
                    cast(sqlite3.Connection, tx.connection.connection.driver_connection).rollback()
                raise
        self._high_water_us = high_water_us
        if self._log is not None:
            driver = cast(sqlite3.Connection, tx.connection.connection.driver_connection)
            self._log.after_commit(driver)
        return answer

    def submit_write(
        self,
        principal: Principal,
        function: Callable[Concatenate[Transaction, P], T],
        *args: P.args,
        **kwargs: P.kwargs,
    ) -> Future[T]:
        """Run `self.write(principal, function, ...)` in a thread; return the future of the function's result.

        The call waits its turn as a call of the server itself, not of a client.
        """
        return self.queue_write(SERVER, principal, lambda tx: function(tx, *args, **kwargs))

    def queue_read(
        self, client: Client, principal: Principal, function: Callable[[Transaction], T], *, reserved: bool = False
    ) -> Future[T]:
        """Run `self.read(principal, function)` for a client in an ordinary thread; return the future of the result.

        With `reserved`, use a reserved thread instead. If the client closes the connection, the read is stopped
        before its next statement. Raises `UnavailableProblem` if too many calls wait.
        """

        def run(tx: Transaction) -> T:
            tx.before_statement = client.require_present
            return function(tx)

        lane = self._reserved if reserved else self._ordinary
        return self._queue(client, run, lambda wanted: lane.submit(client, self._read, principal, wanted))

    def queue_write(
        self, client: Client, principal: Principal, function: Callable[[Transaction], T], *, reserved: bool = False
    ) -> Future[T]:
        """Run `self.write(principal, function)` for a client in a thread; return the future of the result.

        With `reserved`, the write uses a reserved thread on Postgres, and runs before the other waiting writes on
        SQLite. The write runs even if the client has closed the connection. Raises `UnavailableProblem` if too many
        writes wait.
        """
        client = Client(client.key, client.known)
        write_lane, lane = self._write_lane, self._reserved if reserved else self._ordinary
        if write_lane is not None:
            return self._queue(
                client, function, lambda wanted: write_lane.submit(client, principal, wanted, reserved=reserved)
            )
        return self._queue(client, function, lambda wanted: lane.submit(client, self._write, principal, wanted))

    def _queue(
        self,
        client: Client,
        function: Callable[[Transaction], T],
        submit: Callable[[Callable[[Transaction], T]], Future[T]],
    ) -> Future[T]:
        """Submit a function to a lane, and return the future of the result.

        While bytes are moved for the function, it occupies no connection and no thread of the lane.
        """
        if not isinstance(self.blobs, ObjectBlobs):
            return submit(function)
        return MovingCall(self.blobs, self._moving, client, function, submit).begin()

    def submit_move(self, function: Callable[[], T]) -> Future[T]:
        """Run a function that moves bytes to or from object storage in a thread; return the future of its result."""
        return self._moving.submit(SERVER, function)

    def submit_signed_url(self, object_name: str, valid_s: int) -> Future[str]:
        """Sign a URL with which anybody can read an object for `valid_s` seconds; return the future of the URL.

        May be called only if the settings name a bucket of an object storage.
        """
        assert isinstance(self.blobs, ObjectBlobs)
        return self.submit_move(partial(self.blobs.storage.signed_url, object_name, valid_s))

    async def notifications(self, channel: str) -> AsyncGenerator[None]:
        """Listen to a channel of Postgres: yield once when the connection listens, and then after each notification.

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
            raise no_answer("The database connection for notifications has ended.") from error

    def close(self) -> None:
        """Finish the running transactions, then close all connections."""
        if self._write_lane is not None:
            self._write_lane.close()
        self._reserved.close()
        self._ordinary.close()
        self._moving.close()
        if self._log is not None:
            self._log.close()
        self._read_engine.dispose()
        self.engine.dispose()
