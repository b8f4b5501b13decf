"""Audit log of a project or of a server."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import datetime

from marey_client.paging import pages
from marey_client.transport import Transport
from marey_schemas.audit import AuditEntry
from marey_schemas.event_kinds import AuditKind


def read_audit(
    transport: Transport,
    path: str,
    *,
    kind: AuditKind | None = None,
    actor: str | None = None,
    subject: str | None = None,
    since: datetime | None = None,
    until: datetime | None = None,
) -> Iterator[AuditEntry]:
    """List the entries of the audit log at `path` that meet all conditions, newest first.

    `subject` is the name or id of the user or object that was changed. Entries at `since` are listed, entries at
    `until` are not; times without a time zone are local times.
    """
    times = {"since": _text_of(since), "until": _text_of(until)}
    return pages(transport, AuditEntry, path, {"kind": kind, "actor": actor, "subject": subject, **times})


def _text_of(moment: datetime | None) -> str | None:
    return None if moment is None else moment.astimezone().isoformat()
