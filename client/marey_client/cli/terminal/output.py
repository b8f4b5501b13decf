"""Output of commands: tables for people, JSON for programs."""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import typer

from marey_schemas.wording import printable

if TYPE_CHECKING:
    from datetime import datetime

    from pydantic import BaseModel


_OTHER_CONTROLS = re.compile("[\x7f-\x9f]")
COPIED = ("id", "job")
"""Columns that are never wrapped on a narrow terminal, because people copy their cells into the next command."""


def print_json(value: Any) -> None:
    """Print as JSON: a model, or lists and dicts of models and plain values; all control characters are escaped."""
    text = json.dumps(_plain(value), indent=2, ensure_ascii=False)  # escapes those below U+0020
    typer.echo(_OTHER_CONTROLS.sub(lambda found: f"\\u{ord(found[0]):04x}", text))


def print_table(columns: Sequence[str], rows: Iterable[Sequence[object]], *, right: Sequence[str] = ()) -> None:
    """Print rows under headings, as plain text; the columns named in `right` are aligned to the right."""
    from rich import box
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    for column in columns:
        head = Text(_shown(column))  # some are names that other users wrote
        table.add_column(
            head, justify="right" if column in right else "left", overflow="fold", no_wrap=column in COPIED
        )
    for row in rows:
        table.add_row(*(Text(_shown(cell)) for cell in row))
    width = None if sys.stdout.isatty() else 200
    Console(width=width, highlight=False).print(table)


def _shown(cell: object) -> str:
    """Return a cell as text; times are in UTC, to the second, and control characters are escaped."""
    from datetime import datetime

    if isinstance(cell, datetime):
        return cell.strftime("%Y-%m-%d %H:%M:%SZ")
    return printable("" if cell is None else str(cell))


def ago(moment: datetime, now: datetime) -> str:
    """Return the time from `moment` to `now` in one unit, such as "3 h ago"; "0 s ago" if `moment` is after `now`."""
    seconds = max(0, int((now - moment).total_seconds()))
    for unit, length_s in (("d", 86_400), ("h", 3_600), ("min", 60)):
        if seconds >= length_s:
            return f"{seconds // length_s} {unit} ago"
    return f"{seconds} s ago"


def print_rows(rows: Iterable[tuple[str, str, str]]) -> None:
    """Print rows, each of a name, a number aligned to the right, and the unit of the number."""
    rows = list(rows)
    widths = [max(len(row[place]) for row in rows) for place in range(2)]
    for name, figure, meaning in rows:
        typer.echo(f"{name:<{widths[0]}}  {figure:>{widths[1]}}  {meaning}".rstrip())


def print_pairs(pairs: Iterable[tuple[str, object]]) -> None:
    """Print names and values, one pair on each line; pairs without a value are skipped."""
    shown = [(name, value) for name, value in pairs if value not in (None, "", ())]
    width = max((len(name) for name, _ in shown), default=0)
    for name, value in shown:
        typer.echo(f"{name:<{width}}  {_shown(value) if isinstance(value, str) else value}")


def print_message(text: str) -> None:
    """Print a message that is not a result to standard error."""
    typer.echo(printable(text), err=True)


def print_refused(refused: Sequence[Mapping[str, Any]], *, most: int | None = None) -> None:
    """Print the refused inputs of a job with their reasons to standard error, at most `most` lines."""
    for one in refused[:most]:
        name, detail = str(one.get("name")), str(one.get("detail"))
        print_message(f"{detail if detail.startswith(name) else f'{name}: {detail}'} ({one.get('code')})")
    if most is not None and len(refused) > most:
        print_message(f"and {len(refused) - most} more")


def _plain(value: Any) -> Any:
    if hasattr(value, "model_dump"):
        model: BaseModel = value
        return model.model_dump(mode="json", by_alias=True)
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    return value
