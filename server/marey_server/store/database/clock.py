"""Clock of the database, the only clock that leases are compared with."""

from __future__ import annotations

import threading
import time
from datetime import UTC, datetime, timedelta
from typing import Protocol

from sqlalchemy import Connection, insert, select, text, update

from marey_server.store.tables import server_state

_HIGH_WATER = "clock_high_water_us"
_SAVE_EVERY_US = 1_000_000
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


class Clock(Protocol):
    """A source of the current time inside a transaction."""

    def now_us(self, connection: Connection) -> int:
        """Return the time in microseconds since the epoch; it never decreases."""
        ...


class DatabaseClock:
    """Clock of the database: on Postgres the time of the Postgres server, on SQLite a clock that never goes back.

    On SQLite it starts at the wall clock or the stored high-water mark, whichever is later, and is then advanced by the
    monotonic clock, so that a jump of the wall clock neither extends nor ends a lease.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._start_us: int | None = None
        self._start_monotonic_ns = 0

    def now_us(self, connection: Connection) -> int:
        """Return the time in microseconds since the epoch."""
        if connection.dialect.name == "postgresql":
            now = text("SELECT (extract(epoch FROM clock_timestamp()) * 1000000)::bigint")
            return int(connection.execute(now).scalar_one())
        with self._lock:
            if self._start_us is None:
                self._start_us = max(time.time_ns() // 1000, stored_high_water_us(connection))
                self._start_monotonic_ns = time.monotonic_ns()
            return self._start_us + (time.monotonic_ns() - self._start_monotonic_ns) // 1000


def stored_high_water_us(connection: Connection) -> int:
    """Return the latest time that earlier processes may have used, 0 in a new database."""
    statement = select(server_state.c.value).where(server_state.c.key == _HIGH_WATER)
    return int(connection.execute(statement).scalar() or 0)


def save_high_water(connection: Connection, now_us: int) -> int:
    """Store a time after `now_us`, so that no restart uses an earlier time, whatever the wall clock says.

    The stored time is a second ahead, so that it need not be written more often. It is returned: nothing needs to be
    saved until then.
    """
    stored = stored_high_water_us(connection)
    if now_us < stored:
        return stored
    ahead = now_us + _SAVE_EVERY_US
    if stored == 0:
        connection.execute(insert(server_state).values(key=_HIGH_WATER, value=ahead))
    else:
        connection.execute(update(server_state).where(server_state.c.key == _HIGH_WATER).values(value=ahead))
    return ahead


def datetime_of(us: int) -> datetime:
    """Return a stored time as the `datetime` of documents."""
    return _EPOCH + timedelta(microseconds=us)
