"""Tables of a report, and the format of their numbers."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

from marey_reports.drawing.markup import Content, Html, coded, element

LEAST_PROSE = 40
"""Number of characters from which the text of a cell is prose, whose column is never very narrow."""
MOST_NAMES = 40
"""Greatest number of names that a list shows at once; longer lists are folded."""


class Number(NamedTuple):
    """Number in a table: its value, by which rows are sorted, and its text."""

    value: float | None
    written: str
    look: str = ""


Cell = Number | Content


def number(value: float | None, digits: int = 2, *, signed: bool = False, look: str = "") -> Number:
    """Format a number with the given number of decimals; None, NaN and infinite numbers give a dash.

    `look` is the CSS class of the table cell.
    """
    if value is None or not math.isfinite(value):
        return Number(None, "–")
    written = round(value, digits) + 0.0  # not -0.00
    return Number(value, f"{written:{'+' if signed else ''},.{digits}f}", look)


def share(value: float) -> Number:
    """Format a share, such as 0.25, in percent."""
    return Number(value, f"{100 * value:.1f} %")


def table(
    caption: str, heads: Sequence[str], rows: Iterable[Sequence[Cell]], *, numbers: Sequence[int], sortable: bool = True
) -> Html:
    """Make a table whose first column names its rows.

    Parameters
    ----------
    numbers : columns of numbers, which are aligned to the right
    sortable : whether a click on a column's head sorts the rows
    """
    look = dict.fromkeys(numbers, "number")
    head = element(
        "tr", [element("th", text, scope="col", class_=look.get(column)) for column, text in enumerate(heads)]
    )
    body = [element("tr", [_cell(cell, column) for column, cell in enumerate(row)]) for row in rows]
    content = element("caption", caption), element("thead", head), element("tbody", body)
    return element(
        "div",
        element("table", *content, class_="sortable" if sortable else None),
        class_="table",
        tabindex="0",
        role="group",
        aria_label=caption,
    )


def _cell(cell: Cell, column: int) -> Html:
    if isinstance(cell, Number):
        look = f"number {cell.look}".strip()
        value = "" if cell.value is None else f"{cell.value:.6g}"
        return element("td", cell.written, class_=look, data_value=value)
    if column == 0:
        return element("th", cell, scope="row")
    is_prose = isinstance(cell, str) and not isinstance(cell, Html) and len(cell) >= LEAST_PROSE
    return element("td", coded(cell) if is_prose else cell, class_="prose" if is_prose else None)


def facts(pairs: Iterable[tuple[str, Content, str]]) -> Html:
    """Make the summary at the top of a report: a few numbers, each with a title and a note below."""
    tiles = [
        element("div", element("dt", name), element("dd", value), element("dd", note, class_="note") if note else None)
        for name, value, note in pairs
    ]
    return element("dl", tiles, class_="tiles")


def folded(summary: str, content: Content) -> Html:
    """Make an HTML element that shows its content after a click."""
    return element("details", element("summary", summary), content)
