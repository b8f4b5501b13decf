"""Clock of the database, the only clock that leases are compared with."""

from __future__ import annotations

import logging
import threading
import time
from datetime import UTC, datetime, timedelta
from typing import Protocol

from sqlalchemy import Connection, insert, select, update

from marey_server.store.database.prepared import run_texts
from marey_server.store.tables import server_state

FAR_AHEAD_DAYS = 366
"""Days that a clock may be ahead of the stored time; a clock that is further ahead must be confirmed by an operator."""
NOTABLY_AHEAD_S = 60
"""Number of seconds by which the stored time may be ahead of the machine's clock without a message in the log."""
POSTGRES_NOW = "SELECT (extract(epoch FROM clock_timestamp()) * 1000000)::bigint"
"""Query for the time of a Postgres server in microseconds since the epoch."""
DAY_US = 86400 * 1_000_000
_HIGH_WATER = "clock_high_water_us"
_SAVE_EVERY_US = 1_000_000
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


log = logging.getLogger(__name__)


class ClockFarAhead(Exception):
    """Error for a machine clock that is far ahead of the time at which the database was last used."""


class Clock(Protocol):
    """A source of the current time inside a transaction."""

    def now_us(self, connection: Connection) -> int:
        """Return the time in microseconds since the epoch; it never decreases."""
        ...

    def catch_up(self, stored_us: int) -> None:
        """Move forward if `stored_us`, the high-water mark of another process, shows that the other clock is ahead."""
        ...


class DatabaseClock:
    """Clock of the database: on Postgres the time of the Postgres server, on SQLite a clock that never goes back.

    On SQLite, the clock starts at the wall clock or at the stored high-water mark, whichever is later. The high-water
    mark is the latest time that earlier processes may have used. Then the clock follows the monotonic clock, so that a
    jump of the wall clock neither extends nor ends a lease. Processes that use one database may have started before and
    after such a jump, so each of them catches up with the one whose clock is ahead. If the wall clock is far ahead of
    the stored time, the server does not start, because the stored time could not go back afterwards.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._start_us: int | None = None
        self._start_monotonic_ns = 0

    def now_us(self, connection: Connection) -> int:
        """Return the time in microseconds since the epoch.

        Raises `ClockFarAhead` if the wall clock is implausibly far ahead when the process first asks for the time.
        """
        if connection.dialect.name == "postgresql":
            ((now_us,),) = run_texts(connection, (POSTGRES_NOW,))  # in every write: see docs/decisions/0012
            return int(now_us)
        with self._lock:
            if self._start_us is None:
                stored_us, wall_us = stored_high_water_us(connection), wall_clock_us()
                if stored_us and wall_us - stored_us > FAR_AHEAD_DAYS * DAY_US:
                    raise ClockFarAhead(
                        f"the clock of this machine says {datetime_of(wall_us):%Y-%m-%d}, but the database "
                        f"was last used on {datetime_of(stored_us):%Y-%m-%d}; correct the clock, or confirm "
                        "its time with `marey db clock --set`"
                    )
                if (ahead_s := (stored_us - wall_us) / 1e6) > NOTABLY_AHEAD_S:
                    log.warning(
                        "the database was last used %.0f s after the time of this machine, and its clock continues "
                        "from there; stop the server and see `marey db clock`", ahead_s,
                    )  # fmt: skip
                self._start_us = max(wall_us, stored_us)
                self._start_monotonic_ns = time.monotonic_ns()
            return self._current_us(self._start_us)

    def catch_up(self, stored_us: int) -> None:
        """Move to the time of the process that stored this high-water mark, if that process is notably ahead.

        Without this, each process would take jobs from live workers whose leases another process has extended.
        """
        with self._lock:
            if self._start_us is None:
                return
            behind_us = stored_us - _SAVE_EVERY_US - self._current_us(self._start_us)
            if behind_us > _SAVE_EVERY_US:
                log.warning("another process at this database is ahead by %.0f s; following its clock", behind_us / 1e6)
                self._start_us += behind_us

    def _current_us(self, start_us: int) -> int:
        return start_us + (time.monotonic_ns() - self._start_monotonic_ns) // 1000


def wall_clock_us() -> int:
    """Return the time of this machine in microseconds since the epoch."""
    return time.time_ns() // 1000


def stored_high_water_us(connection: Connection) -> int:
    """Return the latest time that earlier processes may have used, 0 in a new database."""
    statement = select(server_state.c.value).where(server_state.c.key == _HIGH_WATER)
    return int(connection.execute(statement).scalar() or 0)


def save_high_water(connection: Connection, now_us: int) -> int:
    """Store a time after `now_us`, so that the clock never starts at an earlier time, even if the wall clock is behind.

    Returns the stored time: a second after `now_us`, or the previously stored time if this is even later. Until the
    clock reaches the returned time, no other time needs to be stored.
    """
    stored = stored_high_water_us(connection)
    if now_us < stored:
        return stored
    ahead = now_us + _SAVE_EVERY_US
    set_high_water(connection, ahead)
    return ahead


def set_high_water(connection: Connection, us: int) -> None:
    """Store the latest time that processes may have used."""
    changed = update(server_state).where(server_state.c.key == _HIGH_WATER).values(value=us)
    if connection.execute(changed).rowcount == 0:
        connection.execute(insert(server_state).values(key=_HIGH_WATER, value=us))


def micros_of(moment: datetime) -> int:
    """Convert a `datetime` of a document to microseconds since the epoch, the form in which times are stored."""
    return (moment - _EPOCH) // timedelta(microseconds=1)


def datetime_of(us: int) -> datetime:
    """Convert a stored time, in microseconds since the epoch, to the `datetime` that documents contain."""
    return _EPOCH + timedelta(microseconds=us)
