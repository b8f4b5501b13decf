"""Transaction: its principal, its time, and operations that differ between SQLite and Postgres."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import sqlalchemy
from sqlalchemy import Connection, CursorResult, Executable, Table
from sqlalchemy.dialects import postgresql, sqlite

from marey_schemas.event_kinds import AuditKind, OrdinaryEventKind
from marey_schemas.sizes import batched
from marey_server.access.folder_rights import FolderRights
from marey_server.access.own_pods import PodRules
from marey_server.access.principal import Principal
from marey_server.access.roles import STRICTEST
from marey_server.store import tables
from marey_server.store.blob_backings import BlobBacking
from marey_server.store.database.clock import Clock
from marey_server.store.database.prepared import Prepared, run_together
from marey_server.store.wakeups import COMMITTED_EVENTS, wakeups

_MOST_IN_LIST = 1000
"""Greatest number of list values in one statement, because databases limit the parameters."""

T = TypeVar("T")

Event = tuple[OrdinaryEventKind, str | None, str, dict[str, Any]]
"""Event that is not in the audit log: its kind, the id of its project, the id of its subject, and its body."""

_INSERT_EVENT = Prepared(sqlalchemy.insert(tables.event))

_KEY_OF_LOCK = sqlalchemy.func.hashtextextended(sqlalchemy.bindparam("name", type_=sqlalchemy.Text), 0)
_LOCKS = {
    shared: Prepared(sqlalchemy.select(acquire(_KEY_OF_LOCK).label("acquired")))
    for shared, acquire in (
        (False, sqlalchemy.func.pg_advisory_xact_lock),
        (True, sqlalchemy.func.pg_advisory_xact_lock_shared),
    )
}


def in_lists(values: Iterable[T]) -> Iterator[list[T]]:
    """Divide values into lists that are short enough for one statement each, for example for `IN`."""
    return batched(values, _MOST_IN_LIST)


@dataclass(frozen=True)
class Quotas:
    """Quotas of the server: how many things, or bytes, one user or one project may have (see `store.quotas`)."""

    user_uploads: int = 1000
    user_upload_bytes: int = 128 * 2**30
    user_daily_bytes: int = 256 * 2**30
    user_daily_inputs: int = 5_000_000
    user_tokens: int = 1000
    user_projects: int = 1000
    user_jobs: int = 200_000
    user_items: int = 2_000_000
    user_stored_bytes: int = 128 * 2**30
    project_items: int = 1_000_000
    project_stored_bytes: int = 64 * 2**30
    project_webhooks: int = 20
    project_schedules: int = 100
    project_scripts: int = 100
    project_invitations: int = 100
    project_participants: int = 2000
    user_invitations: int = 1000
    project_proposal_bytes: int = 64 * 2**20


class Observer:
    """Receiver of numbers about committed transactions, for metrics; this base class ignores them."""

    def count_ended(self, state: str, reason: str | None) -> None:
        """Count a job that has ended; `reason` is the reason of its failure, if it has failed."""

    def count_requeued(self, outcome: str) -> None:
        """Count a job that is queued again after an attempt with this outcome."""

    def count_lost_lease(self) -> None:
        """Count an attempt whose lease has expired."""

    def observe_claims(self, delays_s: Sequence[float]) -> None:
        """Record, for each job of a claim, how many seconds the job was ready before the claim."""


def _untraced(_principal: Principal) -> None:
    """Return None as the trace header of new jobs: they belong to no trace."""


IGNORED = Observer()
"""Observer that ignores everything."""


class Transaction:
    """Database transaction that runs on behalf of a principal, such as a user, a worker or an attempt of a job."""

    def __init__(
        self,
        connection: Connection,
        principal: Principal,
        clock: Clock,
        blobs: BlobBacking,
        quotas: Quotas = Quotas(),
        observer: Observer = IGNORED,
        *,
        pod_rules: PodRules | None = None,
        now_us: int | None = None,
    ) -> None:
        self.connection = connection
        self.principal = principal
        self.continued_for: str | None = None
        """Actor of an earlier transaction whose work this one continues; see `actor`."""
        self.required_role = STRICTEST
        """Role and scope that the request's operation declares; `projects.require` enforces them."""
        self.blobs = blobs
        self.quotas = quotas
        self.observer = observer
        self.pod_rules = pod_rules
        """Rules by which jobs get a pod of their own; None if the server starts no such pods."""
        self.before_statement: Callable[[], object] = bool
        """Function that is called before each lock, and before each statement that is not prepared.

        If it raises an error, the transaction stops.
        """
        self.folder_rights: dict[tuple[str, str | None], FolderRights] = {}
        """Rights that this transaction has read, by project and user; see `store.folder_roles.rights`."""
        self.shared_outputs = 0
        """Number of outputs that this transaction has published from the cache; many facets count as outputs, too."""
        self.new_document_bytes = 0
        """Number of bytes of new documents and arrays that this transaction has stored."""
        self.trace_of_jobs: Callable[[Principal], str | None] = _untraced
        """Function that returns the trace header of the jobs that this transaction submits for a principal."""
        self._clock = clock
        self._now_us = now_us
        self._after_commit: list[Callable[[], None]] = []
        self._has_emitted = False
        self._locks: set[tuple[str, bool]] = set()

    @property
    def now_us(self) -> int:
        """The time of the database in microseconds since the epoch, constant throughout the transaction."""
        if self._now_us is None:
            self._now_us = self._clock.now_us(self.connection)
        return self._now_us

    @property
    def actor(self) -> str | None:
        """The actor in events: that of the principal, or of the earlier transaction whose work this one continues."""
        return self.continued_for or self.principal.actor

    def beside(self, principal: Principal) -> Transaction:
        """Return a transaction for another `principal` on the same connection; the two are committed together.

        After the commit, the caller must call `run_after_commit` of the returned transaction, too.
        """
        other = Transaction(
            self.connection, principal, self._clock, self.blobs, self.quotas, self.observer, pod_rules=self.pod_rules
        )
        other.before_statement = self.before_statement
        other.trace_of_jobs = self.trace_of_jobs
        return other

    @property
    def is_postgres(self) -> bool:
        """Whether the database is Postgres."""
        return self.connection.dialect.name == "postgresql"

    def execute(self, statement: Executable, parameters: Any = None) -> CursorResult[*tuple[Any, ...]]:
        """Run one SQL statement, and return its result."""
        self.before_statement()
        return self.connection.execute(statement, parameters)

    def run(self, statement: Prepared, parameters: Mapping[str, Any]) -> list[Any]:
        """Run a prepared statement, and return its rows."""
        return statement.run(self.connection, parameters)

    def first(self, statement: Prepared, parameters: Mapping[str, Any]) -> Any | None:
        """Return the first row of a prepared statement, or None."""
        rows = statement.run(self.connection, parameters)
        return rows[0] if rows else None

    def run_together(self, *runs: tuple[Prepared, Mapping[str, Any]]) -> list[list[Any]]:
        """Run prepared statements that do not depend on each other, and return the rows of each.

        On Postgres, all of them take a single round trip.
        """
        return run_together(self.connection, runs)

    def run_each(self, statement: Prepared, many: Sequence[Mapping[str, Any]]) -> None:
        """Run a prepared statement once for each mapping in `many`."""
        statement.run_each(self.connection, many)

    def insert_or_ignore(self, table: Table, row: Mapping[str, Any] | None = None) -> postgresql.Insert | sqlite.Insert:
        """Return an INSERT that skips rows that violate a unique index; `returning` gives no row for them.

        Without `row`, the rows are passed to `execute`.
        """
        return self.insert_into(table, row).on_conflict_do_nothing()

    def insert_into(self, table: Table, row: Mapping[str, Any] | None = None) -> postgresql.Insert | sqlite.Insert:
        """Return an INSERT to which a clause ON CONFLICT can be added."""
        added = postgresql.insert(table) if self.is_postgres else sqlite.insert(table)
        return added if row is None else added.values(**row)

    def lock(self, name: str, *, shared: bool = False) -> None:
        """Acquire the lock `name`, and hold it until the transaction ends.

        Several transactions can hold a lock at the same time if all of them acquire it with `shared`. On SQLite,
        nothing is locked, because there is only one writer at a time.
        """
        if not self.is_postgres or (name, shared) in self._locks:
            return
        self.before_statement()
        self.run(_LOCKS[shared], {"name": name})
        if not self.connection.in_nested_transaction():  # whose rollback would release the lock
            self._locks.add((name, shared))

    def emit(self, kind: OrdinaryEventKind, subject: str, *, project_id: str | None = None, **body: Any) -> None:
        """Record an event, which becomes visible when the transaction commits."""
        self.emit_each([(kind, project_id, subject, body)])

    def emit_each(self, events: Iterable[Event]) -> None:
        """Record events in this order, visible when the transaction commits."""
        self._record(
            {"kind": kind, "project_id": project_id, "subject": subject, "body": body, "about": None, "token_id": None}
            for kind, project_id, subject, body in events
        )

    def audit(self, kind: AuditKind, subject: str, *, about: str, project_id: str | None = None, **body: Any) -> None:
        """Record an event that is also an entry of the audit log.

        `about` is the name of the user or object that is changed; only the audit log shows it. Neither `about` nor the
        body may contain a secret.
        """
        token_id = self.principal.token_id
        row = {"kind": kind, "project_id": project_id, "subject": subject, "body": body}
        self._record([{**row, "about": about, "token_id": token_id}])

    def _record(self, events: Iterable[Mapping[str, Any]]) -> None:
        common = {"at_us": self.now_us, "actor": self.actor}
        rows = [{**common, **one} for one in events]
        if rows:
            self.run_each(_INSERT_EVENT, rows)
            self._has_emitted = True

    def after_commit(self, action: Callable[[], None]) -> None:
        """Run `action` after the transaction has committed, but not if it rolls back."""
        self._after_commit.append(action)

    def run_after_commit(self) -> None:
        """Run the actions that were passed to `after_commit`; if events were recorded, announce them."""
        for action in self._after_commit:
            action()
        if self._has_emitted:
            wakeups.announce([COMMITTED_EVENTS])
