"""Events of jobs, many in one statement, and the wake-ups of waiting requests."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

from sqlalchemy import insert, text

from marey_server.store.database.prepared import Prepared
from marey_server.store.tables import event
from marey_server.store.transaction import Transaction
from marey_server.store.wakeups import wakeups

EventOfJob = tuple[str, str, dict[str, Any]]
"""Project id, job id and body of an event."""


_INSERT = Prepared(insert(event))
_INSERT_WITH_XID = Prepared(insert(event).values(xid=text("pg_current_xact_id()::text::bigint")))


def emit_job_events(tx: Transaction, kind: str, events: Sequence[EventOfJob]) -> None:
    """Record one event per job, visible when the transaction commits."""
    if not events:
        return
    common = {"at_us": tx.now_us, "kind": kind, "actor": tx.principal.actor}
    rows = [{**common, "project_id": project, "subject": subject, "body": body} for project, subject, body in events]
    tx.run_each(_INSERT_WITH_XID if tx.is_postgres else _INSERT, rows)


def wake_workers(tx: Transaction, kinds: Iterable[str]) -> None:
    """Wake requests that wait for work of these kinds, after the commit."""
    topics = {f"work:{kind}" for kind in kinds}
    if topics:
        tx.after_commit(lambda: wakeups.announce(topics))


def wake_watchers(tx: Transaction, job_ids: Iterable[str]) -> None:
    """Wake requests that wait for the end of these jobs, after the commit."""
    topics = {f"job:{job_id}" for job_id in job_ids}
    if topics:
        tx.after_commit(lambda: wakeups.announce(topics))
