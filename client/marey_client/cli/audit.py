"""Command `audit`, which shows who changed access, and who deleted or restored something."""

from __future__ import annotations

import json
from datetime import UTC, datetime
from itertools import islice
from typing import TYPE_CHECKING, Annotated, Any

import typer

from marey_client.cli.terminal.failures import WrongUsage
from marey_client.cli.terminal.invocation import AsJson, connect
from marey_client.cli.terminal.output import print_json, print_message, print_table

if TYPE_CHECKING:
    from collections.abc import Iterator

    from marey_schemas.audit import AuditEntry
    from marey_schemas.event_kinds import AuditKind

NAMES_IN_BODY = frozenset({"name", "user", "path"})
"""Details with these keys are left out if their value is the name of the object that the entry is about."""

ONLY_AS_JSON = frozenset({"clips"})
"""Keys of details that are too long for a table."""


def add_to(app: typer.Typer) -> None:
    """Add the commands of this module to the application `app`."""
    app.command()(audit)


def audit(
    context: typer.Context,
    project: Annotated[
        str | None,
        typer.Argument(
            help="Name of the project. By default, the log of the whole server is shown, which only administrators "
            "may read."
        ),
    ] = None,
    kind: Annotated[
        str | None,
        typer.Option(
            help="Show only changes of this kind, such as member.added; an unknown kind prints the list of all kinds."
        ),
    ] = None,
    actor: Annotated[str | None, typer.Option(help="Show only changes that this user made.")] = None,
    subject: Annotated[
        str | None, typer.Option(help="Show only changes of this user or object, given by name or id.")
    ] = None,
    since: Annotated[
        str | None,
        typer.Option(
            help="Show only changes at this time, in UTC, or later, such as 2026-11-23 or 2026-11-23T15:04:05."
        ),
    ] = None,
    until: Annotated[str | None, typer.Option(help="Show only changes before this time, in UTC.")] = None,
    limit: Annotated[int, typer.Option("--limit", "-n", min=1, help="Greatest number of entries to list.")] = 50,
    as_json: AsJson = False,
) -> None:
    """Show who changed access, and who deleted or restored something, newest first.

    Only owners of a project may read its log, and only administrators the log of the server. Times are in UTC.
    """
    chosen: dict[str, Any] = {"kind": _kind(kind), "actor": actor, "subject": subject}
    chosen |= {"since": _time("--since", since), "until": _time("--until", until)}
    with connect(context) as marey:
        log = marey.audit(**chosen) if project is None else marey.project(project).audit(**chosen)
        found = list(islice(log, limit + 1))
    shown = found[:limit]
    if as_json:
        return print_json(shown)
    if project is None:
        columns = ("time", "project", "actor", "what", "about", "details")
        print_table(columns, [(one.at, one.project, *_cells(one)) for one in shown])
    else:
        print_table(("time", "actor", "what", "about", "details"), [(one.at, *_cells(one)) for one in shown])
    return print_message("there are older entries; list more with --limit") if len(found) > limit else None


def _cells(entry: AuditEntry) -> tuple[str, str, str, str]:
    return entry.actor or "(the server)", entry.words, entry.about, " ".join(_details(entry))


def _details(entry: AuditEntry) -> Iterator[str]:
    """Yield the details of an entry as `key=value`, without the name of the object that the entry is about."""
    for key, value in sorted(entry.body.items()):
        if value in (None, [], {}) or (key in NAMES_IN_BODY and value == entry.about):
            continue
        if key in ONLY_AS_JSON:
            continue
        if isinstance(value, list):
            value = ",".join(map(str, value))
        yield f"{key}={value if isinstance(value, str) else json.dumps(value)}"


def _kind(text: str | None) -> AuditKind | None:
    from marey_schemas.event_kinds import AUDIT_KINDS

    known = next((one for one in AUDIT_KINDS if one == text), None)
    if text is not None and known is None:
        raise WrongUsage(f"{text!r} is not a kind of entry; the kinds are {', '.join(AUDIT_KINDS)}")
    return known


def _time(option: str, text: str | None) -> datetime | None:
    """Parse the time that an option gives; a time without an offset is in UTC. Raises `WrongUsage` for other texts."""
    if text is None:
        return None
    try:
        moment = datetime.fromisoformat(text)
    except ValueError:
        raise WrongUsage(
            f"{option} is {text!r}, which is not a time; write it as 2026-11-23 or 2026-11-23T15:04:05"
        ) from None
    return moment if moment.tzinfo is not None else moment.replace(tzinfo=UTC)
