"""Correction of the clock that an SQLite database stores, after a server ran while the clock of its machine was wrong.

The stored clock never goes back by itself. If a server once started with a clock that was years ahead, all leases,
tokens and ages would be compared with that time. This module sets the stored clock to the time of this machine. It also
corrects all stored times that are later than the time of this machine.
"""

from __future__ import annotations

from dataclasses import dataclass

from sqlalchemy import Connection, update

from marey_server.store.database.clock import datetime_of, set_high_water, stored_high_water_us, wall_clock_us
from marey_server.store.tables import invitation, job, metadata, schedule, study_participant, study_trial, token

PAST = frozenset(
    {
        "at_us", "cancel_requested_us", "created_us", "deleted_us", "delivered_us", "ended_us", "failing_since_us",
        "finished_us", "fired_us", "last_used_us", "purged_us", "served_us", "since_us", "started_us", "updated_us",
        "withdrawn_us",
    }
)  # fmt: skip
"""Columns of times of past events. Times in the future are set to now."""
WAITING = frozenset({"expires_us", "lease_expires_us", "next_us", "old_secret_until_us", "run_at_us", "until_us"})
"""Columns of times at which a lease, a validity or a wait ends.

Times in the future are set to now: workers then renew their leases, and jobs, sign-ins and webhooks no longer wait.
"""
MOVED = {
    token.c.expires_us: token.c.created_us,
    invitation.c.expires_us: invitation.c.created_us,
    job.c.deadline_us: job.c.started_us,
    study_participant.c.expires_us: study_participant.c.created_us,
    study_trial.c.deadline_us: study_trial.c.started_us,
}
"""Columns of end times, each with the column of the start time.

A start time in the future is set to now, and the end time moves back by the same amount.
"""

RECOMPUTED = schedule.c.due_us
"""Column of the times of schedules. Times in the future are set to 0: the server then computes the next time."""


@dataclass(frozen=True)
class StoredClock:
    """Latest time that a database has used (0 if none) and time of this machine, each in microseconds since 1970."""

    stored_us: int
    wall_us: int

    def __str__(self) -> str:
        stored, wall = (f"{datetime_of(us):%Y-%m-%d %H:%M:%SZ}" for us in (self.stored_us, self.wall_us))
        used = f"last used at {stored}" if self.stored_us else "never used"
        return f"the database was {used}; this machine says {wall}"


def read_clock(connection: Connection) -> StoredClock:
    """Return the latest time that the database has used, and the time of the machine's clock."""
    return StoredClock(stored_high_water_us(connection), wall_clock_us())


def set_clock(connection: Connection) -> int:
    """Set the stored clock to the time of this machine, and move later times back; return the number of changed values.

    Later times of past events are set to the new time. Leases end at the new time, so running jobs continue if their
    workers report, and are queued again otherwise. Tokens and time limits that were created with the wrong clock keep
    their duration.
    """
    now_us = wall_clock_us()
    moved = 0
    for column, origin in MOVED.items():
        later = update(column.table).where(origin > now_us, column.is_not(None))
        moved += connection.execute(later.values({column: column - origin + now_us})).rowcount
    moved += connection.execute(update(schedule).where(now_us < RECOMPUTED).values({RECOMPUTED: 0})).rowcount
    for table in metadata.sorted_tables:
        for column in table.columns:
            if column.name in PAST | WAITING and column not in MOVED:
                moved += connection.execute(update(table).where(column > now_us).values({column: now_us})).rowcount
    set_high_water(connection, now_us)
    return moved
