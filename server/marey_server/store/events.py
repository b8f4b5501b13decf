"""Feed of events, in the order in which they became visible."""

from __future__ import annotations

from typing import Any

from sqlalchemy import ColumnElement, Row, and_, or_, select, text

from marey_schemas.items import Event
from marey_server.store import projects, users
from marey_server.store.database.clock import datetime_of
from marey_server.store.tables import event, project
from marey_server.store.transaction import Transaction

MAX_EVENTS = 1000


def list_events(
    tx: Transaction, project_name: str | None = None, *, after: int = 0, limit: int = 100, subject: str | None = None
) -> list[Event]:
    """List the events after the one numbered `after`: of a project, or, for administrators, of the whole server.

    With `subject`, only events of that object are listed.

    Numbers follow the order of the feed, but on Postgres they do not always ascend: continue after the last one
    received. Events of a transaction are held back while an older transaction is running, so that no event is later
    inserted before one that was already listed.
    """
    statement = select(event, project.c.name.label("project")).outerjoin(project, project.c.id == event.c.project_id)
    if project_name is None:
        users.require_administrator(tx.principal)
    else:
        statement = statement.where(event.c.project_id == projects.require(tx, project_name).id)
    if subject is not None:
        statement = statement.where(event.c.subject == subject)
    statement = statement.where(_behind(tx, after))
    if tx.is_postgres:
        statement = statement.where(event.c.xid < text("pg_snapshot_xmin(pg_current_snapshot())::text::bigint"))
    rows = tx.execute(statement.order_by(event.c.xid, event.c.seq).limit(min(limit, MAX_EVENTS)))
    return [_shown(row) for row in rows]


def _behind(tx: Transaction, after: int) -> ColumnElement[bool]:
    last = tx.execute(
        select(event.c.xid, event.c.seq).where(event.c.seq <= after).order_by(event.c.seq.desc()).limit(1)
    ).first()
    if last is None:
        return event.c.seq > 0
    return or_(event.c.xid > last.xid, and_(event.c.xid == last.xid, event.c.seq > last.seq))


def _shown(row: Row[Any]) -> Event:
    return Event(
        seq=row.seq, at=datetime_of(row.at_us), project=row.project, kind=row.kind, subject=row.subject,
        actor=row.actor, body=row.body,
    )  # fmt: skip
