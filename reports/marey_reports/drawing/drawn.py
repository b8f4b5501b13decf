"""Figures as PNG and as SVG, with the numbers that they show."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from marey_reports.drawing.paper import to_png, to_svg
from marey_schemas.wording import without_formula

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Column = Any
"""Sequence or array whose elements are numbers, texts or None."""
Tables = Mapping[str, Mapping[str, Column]]
"""Tables by name. A table maps the names of columns to columns of equal length; a name ends with the column's unit."""


class Sketch(NamedTuple):
    """Page with a figure, the numbers that it shows, and a description in one or two sentences."""

    figure: Figure
    tables: Tables
    caption: str


@dataclass(frozen=True, eq=False)
class DrawnFigure:
    """Figure of a report. The PNG and the SVG are written when they are first requested.

    Parameters
    ----------
    sketch : the page, the numbers that it shows, and its caption
    name : name by which callers request the figure
    number : number of the same figure in the published paper, or "" if no paper contains the figure
    """

    sketch: Sketch
    name: str
    number: str
    title: str

    @property
    def caption(self) -> str:
        """The description of the figure, which also serves people who cannot see the figure."""
        return self.sketch.caption

    @property
    def tables(self) -> Tables:
        """The numbers that the figure shows."""
        return self.sketch.tables

    @cached_property
    def png(self) -> bytes:
        """The picture as PNG."""
        return to_png(self.sketch.figure)

    @cached_property
    def svg(self) -> str:
        """The picture as SVG."""
        return to_svg(self.sketch.figure, self.title)

    @property
    def data(self) -> dict[str, Any]:
        """Name, number, title, caption and tables as plain values; None replaces NaN and infinite numbers."""
        tables = {
            name: {column: listed(values) for column, values in table.items()} for name, table in self.tables.items()
        }
        return {
            "figure": self.name,
            "number": self.number,
            "title": self.title,
            "caption": self.caption,
            "tables": tables,
        }

    def files(self) -> dict[str, bytes]:
        """Make the contents of all files by name: PNG, SVG, the data as JSON and one CSV per table."""
        files = {
            f"{self.name}.png": self.png,
            f"{self.name}.svg": self.svg.encode(),
            f"{self.name}.json": json.dumps(self.data, ensure_ascii=False, allow_nan=False).encode(),
        }
        for table, columns in self.tables.items():
            files[f"{self.name}-{table}.csv"] = as_csv(columns).encode()
        return files


def listed(values: Column) -> list[Any]:
    """Convert a column to a list of plain values; None replaces NaN and infinite numbers."""
    rows = values.tolist() if isinstance(values, np.ndarray) else [_plain(value) for value in values]
    return [None if isinstance(value, float) and not math.isfinite(value) else value for value in rows]


def _plain(value: Any) -> Any:
    return value.item() if isinstance(value, np.generic) else value


def as_csv(columns: Mapping[str, Column]) -> str:
    """Write a table as CSV with a header and LF at line ends; numbers are as short as possible, but exact.

    Texts that look like formulas get an apostrophe, because people open the tables with spreadsheets.
    """
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(map(without_formula, columns))
    rows = zip(*(listed(values) for values in columns.values()), strict=True)
    writer.writerows([without_formula(cell) if isinstance(cell, str) else cell for cell in row] for row in rows)
    return buffer.getvalue()
