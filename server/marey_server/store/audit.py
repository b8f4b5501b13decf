"""Audit log: the events that concern access and deletion, newest first.

Entries are deleted only when they are older than the settings allow. Entries are changed only when an item is purged:
in the entries of this item, its id then replaces its name.

On Postgres, call `events.number_events` before the functions that list entries: entries without a number are left out.
"""

from __future__ import annotations

from datetime import datetime
from typing import Any, NamedTuple

from sqlalchemy import ColumnElement, Row, select

from marey_schemas.audit import AuditEntry
from marey_schemas.items import Page
from marey_server.access.roles import require_administrator
from marey_server.store import events, listing, projects
from marey_server.store.database.clock import datetime_of, micros_of
from marey_server.store.ids import is_id
from marey_server.store.tables import event, project
from marey_server.store.transaction import Transaction

_KEYS: dict[str, ColumnElement[Any]] = {"at": event.c.at_us, "seq": event.c.seq}
_ORDER = listing.parse_order("-at,-seq", _KEYS, unique="seq")


class AuditFilter(NamedTuple):
    """Filter of the audit log; a field that is None selects all entries.

    `subject` is the id or the name of the object that was changed; a text that looks like an id is always taken as an
    id. Entries at the time `since` are selected, entries at the time `until` are not.
    """

    kind: str | None = None
    actor: str | None = None
    subject: str | None = None
    since: datetime | None = None
    until: datetime | None = None

    def conditions(self) -> list[ColumnElement[bool]]:
        """Return the SQL conditions of this filter, for rows of the table `event`."""
        found: list[ColumnElement[bool]] = []
        if self.kind is not None:
            found.append(event.c.kind == self.kind)
        if self.actor is not None:
            found.append(event.c.actor == self.actor)
        if self.subject is not None:
            found.append((event.c.subject if is_id(self.subject) else event.c.about) == self.subject)
        if self.since is not None:
            found.append(event.c.at_us >= micros_of(self.since))
        if self.until is not None:
            found.append(event.c.at_us < micros_of(self.until))
        return found


def list_audit(tx: Transaction, wanted: AuditFilter, *, cursor: str | None, limit: int) -> Page:
    """List the audit entries of the whole server. Only administrators may do this."""
    require_administrator(tx.principal)
    return _list(tx, wanted, [], "", cursor, limit)


def list_project_audit(tx: Transaction, name: str, wanted: AuditFilter, *, cursor: str | None, limit: int) -> Page:
    """List the audit entries of a project."""
    project_id = projects.require(tx, name).id
    return _list(tx, wanted, [event.c.project_id == project_id], project_id, cursor, limit)


def _list(
    tx: Transaction, wanted: AuditFilter, of: list[ColumnElement[bool]], project_id: str, cursor: str | None, limit: int
) -> Page:
    """Return a page of audit entries, newest first; entries without a number (see `number_events`) are left out."""
    number = events.number_of(tx)
    statement = (
        select(*_COLUMNS, number.label("number"), project.c.name.label("project"))
        .select_from(event.outerjoin(project, project.c.id == event.c.project_id))
        .where(event.c.about.is_not(None), number.is_not(None), *of, *wanted.conditions())
    )
    identity = ["audit", project_id, *(None if one is None else str(one) for one in wanted)]
    rows, following = listing.read_page(tx, statement, _ORDER, identity, cursor, limit)
    return Page(items=tuple(map(_shown, rows)), next_cursor=following)


_COLUMNS = (
    event.c.seq, event.c.at_us, event.c.kind, event.c.subject, event.c.actor, event.c.token_id, event.c.about,
    event.c.body,
)  # fmt: skip


def _shown(row: Row[Any]) -> AuditEntry:
    return AuditEntry(
        seq=row.number, at=datetime_of(row.at_us), kind=row.kind, project=row.project, actor=row.actor,
        token=row.token_id, about=row.about, subject=row.subject, body=row.body,
    )  # fmt: skip
