"""One transaction: on whose behalf it runs, what time it is in it, and what it does in each database's own words."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import sqlalchemy
from sqlalchemy import Connection, CursorResult, Executable, Table
from sqlalchemy.dialects import postgresql, sqlite

from marey_server.access.principal import Principal
from marey_server.access.roles import STRICTEST
from marey_server.store import tables
from marey_server.store.blob_backings import BlobBacking
from marey_server.store.database.clock import Clock
from marey_server.store.database.prepared import Prepared


class Transaction:
    """One transaction and the principal on whose behalf it runs."""

    def __init__(self, connection: Connection, principal: Principal, clock: Clock, blobs: BlobBacking) -> None:
        self.connection = connection
        self.principal = principal
        self.required_role = STRICTEST
        """What the request's operation declares; `projects.require` enforces it."""
        self.blobs = blobs
        self.shared_outputs = 0
        """Number of results of earlier jobs that it has published again."""
        self._clock = clock
        self._now_us: int | None = None
        self._after_commit: list[Callable[[], None]] = []

    @property
    def now_us(self) -> int:
        """The database's time, microseconds since the epoch; the same throughout the transaction."""
        if self._now_us is None:
            self._now_us = self._clock.now_us(self.connection)
        return self._now_us

    def beside(self, principal: Principal) -> Transaction:
        """Another one, on behalf of `principal`, that is committed with this one."""
        return Transaction(self.connection, principal, self._clock, self.blobs)

    @property
    def is_postgres(self) -> bool:
        """Whether this runs on Postgres."""
        return self.connection.dialect.name == "postgresql"

    def execute(self, statement: Executable, parameters: Any = None) -> CursorResult[Any]:
        """Run one statement."""
        return self.connection.execute(statement, parameters)

    def run(self, statement: Prepared, parameters: Mapping[str, Any]) -> list[Any]:
        """Return the rows of a prepared statement."""
        return statement.run(self.connection, parameters)

    def first(self, statement: Prepared, parameters: Mapping[str, Any]) -> Any | None:
        """Return the first row of a prepared statement; None where it gives none."""
        rows = statement.run(self.connection, parameters)
        return rows[0] if rows else None

    def run_each(self, statement: Prepared, many: Sequence[Mapping[str, Any]]) -> None:
        """Run a prepared statement once for each of `many`."""
        statement.run_each(self.connection, many)

    def insert_or_ignore(self, table: Table, row: Mapping[str, Any] | None = None) -> postgresql.Insert | sqlite.Insert:
        """Return an INSERT that does nothing where a unique index refuses the row; `returning` then gives nothing.

        Without `row`, give the rows when executing it.
        """
        added = postgresql.insert(table) if self.is_postgres else sqlite.insert(table)
        return (added if row is None else added.values(**row)).on_conflict_do_nothing()

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
