"""Reading of CSV files that people write with spreadsheets."""

from __future__ import annotations

import csv
from pathlib import Path

from marey_client.cli.terminal.failures import WrongUsage

_BEYOND = "\0"
"""Name under which the reader stores cells beyond the columns."""


def rows_of(table: Path) -> list[dict[str, str | None]]:
    """Return the rows of a CSV file by the names of its columns.

    Raises `WrongUsage` if it has no rows, or a row has more cells than there are columns.
    """
    try:
        with table.open(newline="", encoding="utf-8-sig") as file:
            rows = list(csv.DictReader(file, strict=True, restkey=_BEYOND))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise WrongUsage(f"{table} cannot be read as a CSV file: {error}") from None
    if not rows:
        raise WrongUsage(f"{table} has no rows below its column names")
    for number, row in enumerate(rows, 2):
        if _BEYOND in row:
            raise WrongUsage(f"{table}, row {number}: the row has more cells than the file has columns")
    return rows
