"""Reading of CSV files that people write with spreadsheets."""

from __future__ import annotations

import csv
from collections import Counter
from pathlib import Path

from marey_client.cli.terminal.failures import WrongUsage

_BEYOND = "\0"
"""Key of a row under which the CSV reader stores the cells beyond the last column."""


def rows_of(table: Path) -> dict[int, dict[str, str | None]]:
    """Return the rows of a CSV file by line number; a row maps the names of the columns to cells.

    Raises `WrongUsage` if the file has no rows, two columns with the same name, or a row with more cells than columns.
    """
    try:
        with table.open(newline="", encoding="utf-8-sig") as file:
            reader = csv.DictReader(file, strict=True, restkey=_BEYOND)
            rows = {}
            for row in reader:
                rows[reader.line_num] = row
            names = Counter(name for name in reader.fieldnames or () if name)
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise WrongUsage(f"{table} cannot be read as a CSV file: {error}") from None
    if not rows:
        raise WrongUsage(f"{table} has no rows below its column names; add at least one row")
    if twice := [name for name, count in names.items() if count > 1]:
        raise WrongUsage(f"{table} has several columns named {twice[0]!r}; give each column its own name")
    for number, row in rows.items():
        if _BEYOND in row:
            raise WrongUsage(
                f"{table}, row {number}: the row has more cells than the table has columns; remove cells, or put "
                "texts with commas into quotes"
            )
    return rows
