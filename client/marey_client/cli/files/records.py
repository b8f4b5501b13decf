"""Command `record`: sets the take records of clips, from options or from a table."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer

from marey_client.cli.addresses import REQUESTS_AT_ONCE, Address
from marey_client.cli.files.csv_files import rows_of
from marey_client.cli.terminal.failures import Refused, WrongUsage, sentence
from marey_client.cli.terminal.invocation import QueryText, connect
from marey_client.cli.terminal.output import print_message
from marey_client.progress import progress
from marey_schemas.validation.reasons import plain_reason
from marey_schemas.wording import counted

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from marey_client.handles.clips import ClipHandle

KEYS = ("clip", "file")
"""Columns of a table that identify clips: by path or name, or by the name of the imported file."""
ERRORS_SHOWN = 20


class _RecordChange(NamedTuple):
    """Values to set in the take record of a clip, and their origin for error texts: an option or a row of the table."""

    clip: ClipHandle
    values: Mapping[str, Any]
    place: str


def add_to(app: typer.Typer) -> None:
    """Add the command of this module to the application `app`."""
    app.command()(record)


def record(
    context: typer.Context,
    place: Annotated[str, typer.Argument(help="A clip or a folder of clips: project/folder[/name].")],
    values: Annotated[
        list[str] | None,
        typer.Option(
            "--set", help="Field and value, as in action=walk; an empty value removes the field; may be repeated."
        ),
    ] = None,
    table: Annotated[
        Path | None,
        typer.Option(
            help="CSV file with one row for each clip. A column `clip` (name, or path below PLACE) or `file` "
            "(name of the imported file) identifies the clip; each other column sets the field of its name. "
            "Empty cells change nothing."
        ),
    ] = None,
    column: Annotated[
        list[str] | None,
        typer.Option(
            help="Column of the table and the field that it fills, as in 'Shoot Date=shoot_day'; may be repeated."
        ),
    ] = None,
    query: QueryText = None,
) -> None:
    """Set the take records of clips: performer, action, take, day, choice, licence, capture system, consent.

    If a value, or a row of the table, is wrong, no clip is changed.
    """
    address = Address.parse(place)
    if (values is None) == (table is None):
        raise WrongUsage("give either values with --set FIELD=VALUE, or a table with --table FILE")
    with connect(context) as marey:
        clips = _clips_at(marey.project(address.project).clips, address, query)
        if not clips:
            raise WrongUsage(
                f"{place} has no clips, or none that --query selects; `marey ls {address.project}` lists the project"
            )
        if table is not None:
            changes = list(_from_table(table, clips, address.path, _pairs(column or ())))
        else:
            wanted = _checked(_pairs(values or ()), "--set")
            changes = [_RecordChange(clip, wanted, clip.path) for clip in clips]
        _apply(changes)


def _clips_at(clips: Any, address: Address, query: str | None) -> list[ClipHandle]:
    """Return the clip at an address, or the clips in the folder at the address and below."""
    found = [] if address.is_folder or not address.path else list(clips.list(path=address.path, query=query))
    return found or list(clips.list(collection=address.path, query=query))


def _pairs(texts: Sequence[str]) -> dict[str, str]:
    """Parse texts such as `action=walk`, and return the values by name."""
    pairs = {}
    for text in texts:
        name, sign, value = text.partition("=")
        if not sign or not name.strip():
            raise WrongUsage(f"{text!r} has no name and value; write them as in action=walk")
        pairs[name.strip()] = value.strip()
    return pairs


def _checked(given: Mapping[str, str], place: str) -> dict[str, Any]:
    """Return the checked value of each field, None for a field to remove. Raises `WrongUsage` for an invalid value."""
    from pydantic import ValidationError

    from marey_schemas.documents.clips import TakeRecord

    if unknown := [name for name in given if name not in TakeRecord.model_fields]:
        raise WrongUsage(
            f"{place}: there is no field {unknown[0]!r}; the fields are {', '.join(TakeRecord.model_fields)}"
        )
    try:
        checked = TakeRecord.model_validate({name: value or None for name, value in given.items()})
    except ValidationError as error:
        first = error.errors()[0]
        raise WrongUsage(
            f"{place}, {'.'.join(map(str, first['loc']))}: {plain_reason(first)}, not {first['input']!r}"
        ) from None
    return {name: getattr(checked, name) for name in given}


def _from_table(
    table: Path, clips: Sequence[ClipHandle], path: str, columns: Mapping[str, str]
) -> Iterator[_RecordChange]:
    """Yield the change that each row of a table makes. Raises `WrongUsage`, which lists all wrong rows."""
    rows = rows_of(table)
    fields = {
        name: columns.get(name, name.strip().lower().replace(" ", "_")) for name in next(iter(rows.values())) if name
    }
    key = next((name for name, field in fields.items() if field in KEYS), None)
    if key is None:
        raise WrongUsage(f"{table} needs a column `clip` or `file`; its columns are {', '.join(fields)}")
    if missing := [name for name in columns if name not in fields]:
        raise WrongUsage(f"{table} has no column {missing[0]!r}; its columns are {', '.join(fields)}")
    from marey_schemas.documents.clips import TakeRecord

    for name, field in fields.items():
        if name != key and field not in TakeRecord.model_fields:
            raise WrongUsage(
                f"{table}: the column {name!r} is not a field; give the field that the column fills with --column "
                f"'{name}=FIELD', or remove the column; the fields are {', '.join(TakeRecord.model_fields)}"
            )
    known = _keyed(clips, path, fields[key])
    wrong: list[str] = []
    changes: dict[str, _RecordChange] = {}
    for number, row in rows.items():
        place = f"row {number}"
        try:
            change = _of_row(row, fields, key, known, place)
            if change.clip.id in changes:
                first = changes[change.clip.id].place
                raise WrongUsage(f"{place}: the clip {row[key]!r} is also in {first}; keep one of the rows")
            changes[change.clip.id] = change
        except WrongUsage as error:
            wrong.append(str(error))
    if wrong:
        more = [f"and {len(wrong) - ERRORS_SHOWN} more"] if len(wrong) > ERRORS_SHOWN else []
        heading = f"{table}: {counted(len(wrong), 'row')} must be corrected first, so no record was changed"
        raise WrongUsage("\n  ".join([heading, *wrong[:ERRORS_SHOWN], *more]))
    return iter(changes.values())


def _keyed(clips: Sequence[ClipHandle], path: str, key: str) -> dict[str, list[ClipHandle]]:
    """Group clips by the texts that can identify them in the column `key` of a table."""
    known: dict[str, list[ClipHandle]] = {}
    for clip in clips:
        if key == "clip":
            below = clip.path.removeprefix(f"{path}/")
            texts = {clip.name, below, clip.path}
        else:
            source = _info_of(clip).source
            texts = {source.file_name} if source is not None and source.file_name else set()
        for text in texts:
            known.setdefault(text, []).append(clip)
    return known


def _of_row(
    row: Mapping[str, Any],
    fields: Mapping[str, str],
    key: str,
    known: Mapping[str, list[ClipHandle]],
    place: str,
) -> _RecordChange:
    if None in row:
        raise WrongUsage(f"{place}: the row has more cells than the table has columns")
    named = (row[key] or "").strip()
    found = known.get(named, [])
    if len(found) != 1:
        several = f"{counted(len(found), 'clip')} are called {named!r}; give the path" if found else ""
        raise WrongUsage(f"{place}: {several or f'there is no clip {named!r}'}")
    given = {field: row[name].strip() for name, field in fields.items() if name != key and (row[name] or "").strip()}
    return _RecordChange(found[0], _checked(given, place), place)


def _info_of(clip: ClipHandle) -> Any:
    from marey_client.errors import NotFound
    from marey_schemas.documents.clips import ClipInfo

    try:
        return clip.info()
    except NotFound:
        return ClipInfo()


def _apply(changes: Sequence[_RecordChange]) -> None:
    """Make the changes, several at a time; a clip that already has the new values gets no new revision."""
    from marey_client.errors import MareyError

    def change(one: _RecordChange) -> str | bool:
        try:
            info = _info_of(one.clip)
            changed = info.model_copy(update=dict(one.values))
            if changed == info:
                return False
            one.clip.put_info(changed)
        except MareyError as error:
            return f"{one.clip.path}: {sentence(error)}"
        return True

    outcomes: list[str | bool] = []
    with progress() as advance, ThreadPoolExecutor(REQUESTS_AT_ONCE) as pool:
        for outcome in pool.map(change, changes):
            outcomes.append(outcome)
            advance("changing records", len(outcomes), len(changes))
    failed = [outcome for outcome in outcomes if isinstance(outcome, str)]
    print_message(f"{counted(outcomes.count(True), 'record')} changed, {outcomes.count(False)} unchanged")
    if failed:
        print_message("\n".join([f"{counted(len(failed), 'clip')} not changed:", *failed]))
        raise Refused
