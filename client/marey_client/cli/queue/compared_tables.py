"""Tables of a comparison: one row for each run, or for each setting with the means of its runs."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

from marey_schemas.wording import without_formula

if TYPE_CHECKING:
    from marey_schemas.queue.comparisons import ComparedColumn, RunComparison
    from marey_schemas.queue.scripts import Value

BEST = " *"
"""Text that follows the best value of a column."""


class RunTable(NamedTuple):
    """Table of exact values.

    `numeric`: headings of the columns of numbers; `best`: the best cells, as (row, column).
    """

    heads: tuple[str, ...]
    rows: list[list[Value | None]]
    numeric: frozenset[str]
    best: frozenset[tuple[int, int]]

    def texts(self) -> list[list[str]]:
        """Return the cells as short texts for people; best values end with a mark."""
        return [
            [_short(cell) + BEST * ((place, column) in self.best) for column, cell in enumerate(row)]
            for place, row in enumerate(self.rows)
        ]

    def csv(self) -> str:
        """Return the table as CSV with exact numbers; an apostrophe is put before texts that look like formulas."""
        buffer = io.StringIO()
        writer = csv.writer(buffer, lineterminator="\n")
        writer.writerow(map(_safe, self.heads))
        writer.writerows([[_safe(cell) for cell in row] for row in self.rows])
        return buffer.getvalue()


def shown_columns(comparison: RunComparison, *, every: bool) -> tuple[ComparedColumn, ...]:
    """Return the columns in which the runs differ; with `every` or for a single run, all columns."""
    every = every or len(comparison.runs) < 2
    return tuple(column for column in comparison.columns if every or column.differs)


def table_of_runs(comparison: RunComparison, columns: Sequence[ComparedColumn]) -> RunTable:
    """Return a table with one row for each run: its job, its seed if the seeds differ, and the columns."""
    seeds = len({run.seed for run in comparison.runs}) > 1
    rows = [[run.job, *([run.seed] * seeds), *(run.cell(column) for column in columns)] for run in comparison.runs]
    heads = ("job", *(["seed"] * seeds), *comparison.titles(columns))
    first = len(heads) - len(columns)
    best = {
        (place, first + number)
        for number, column in enumerate(columns)
        for place, run in enumerate(comparison.runs)
        if column.best is not None and run.cell(column) == column.best
    }
    return RunTable(heads, rows, _numeric(heads[first:], columns) | {"seed"}, frozenset(best))


def table_of_means(comparison: RunComparison, columns: Sequence[ComparedColumn]) -> RunTable:
    """Return a table with one row for each setting: number of runs, and mean and interval of each numeric field."""
    fixed = [column for column in columns if column.of != "field"]
    fields = [column for column in columns if column.of == "field" and column.numeric]
    titles = comparison.titles(fields)
    heads = (
        *comparison.titles(fixed), "n", *(f"{title}.{part}" for title in titles for part in ("mean", "low", "high"))
    )  # fmt: skip
    rows: list[list[Value | None]] = []
    best = set()
    for place, setting in enumerate(comparison.settings):
        first = comparison.runs[setting.runs[0]]
        row: list[Value | None] = [*(first.cell(column) for column in fixed), len(setting.runs)]
        for column in fields:
            summary = setting.fields.get(column.name)
            if summary is not None and summary.mean == column.best_mean:
                best.add((place, len(row)))
            row += [None] * 3 if summary is None else [summary.mean, summary.low, summary.high]
        rows.append(row)
    return RunTable(heads, rows, _numeric(heads, fixed) | set(heads[len(fixed) :]), frozenset(best))


def texts_of_means(comparison: RunComparison, columns: Sequence[ComparedColumn]) -> RunTable:
    """Return the table of means with each mean and its interval in one cell, such as `0.52 (0.4 to 0.64)`."""
    table = table_of_means(comparison, columns)
    fixed = sum(column.of != "field" for column in columns) + 1
    heads = (*table.heads[:fixed], *(head.removesuffix(".mean") for head in table.heads[fixed::3]))
    rows: list[list[Value | None]] = [
        [*row[:fixed], *(_interval(*row[place : place + 3]) for place in range(fixed, len(row), 3))]
        for row in table.rows
    ]
    best = frozenset((row, column if column < fixed else fixed + (column - fixed) // 3) for row, column in table.best)
    return RunTable(heads, rows, table.numeric & set(heads), best)


def _interval(mean: Value | None, low: Value | None, high: Value | None) -> str | None:
    if mean is None:
        return None
    return _short(mean) if low is None or high is None else f"{_short(mean)} ({_short(low)} to {_short(high)})"


def _numeric(heads: Sequence[str], columns: Sequence[ComparedColumn]) -> frozenset[str]:
    return frozenset(head for head, column in zip(heads, columns, strict=False) if column.numeric)


def _short(cell: Value | None) -> str:
    if isinstance(cell, bool):
        return str(cell).lower()
    if isinstance(cell, float):
        return f"{cell:.6g}"
    return "" if cell is None else str(cell)


def _safe(cell: Value | None) -> Value | None:
    if isinstance(cell, bool):
        return str(cell).lower()
    return without_formula(cell) if isinstance(cell, str) else cell
