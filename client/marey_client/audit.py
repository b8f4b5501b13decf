"""Audit log of a project or of a server."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import datetime
from typing import Any, TypedDict, Unpack

from marey_client.errors import BadArgument
from marey_client.paging import pages
from marey_client.transport import Transport
from marey_schemas.audit import AuditEntry
from marey_schemas.event_kinds import AuditKind


class AuditConditions(TypedDict, total=False):
    """Conditions on the entries of an audit log; None, like a missing condition, matches every entry."""

    kind: AuditKind | None
    """Kind of the change, such as `member.added`."""
    actor: str | None
    """Name of the user who made the change."""
    subject: str | None
    """Name or id of the user or object that was changed."""
    since: datetime | None
    """Earliest time of the change; a value without a time zone is local time."""
    until: datetime | None
    """Time before which the change was made; a value without a time zone is local time."""


def read_audit(transport: Transport, path: str, **conditions: Unpack[AuditConditions]) -> Iterator[AuditEntry]:
    """List the entries of the audit log at `path` that meet all conditions, newest first."""
    times = {name: _text_of(name, conditions.get(name)) for name in ("since", "until")}
    query: dict[str, Any] = {**conditions, **times}
    return pages(transport, AuditEntry, path, query)


def _text_of(name: str, moment: object) -> str | None:
    if moment is None:
        return None
    if not isinstance(moment, datetime):
        raise BadArgument(f"{name}: give a datetime or None, not {moment!r}")
    return moment.astimezone().isoformat()
