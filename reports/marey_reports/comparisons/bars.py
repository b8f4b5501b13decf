"""Chart of a field by setting: bars for means, with each run as a dot, intervals and numbers of runs."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from marey_reports.comparisons.axes import add_chart, axis_title, beside, set_logarithmic, spread, widened
from marey_reports.comparisons.subjects import (
    ComparedSubject,
    Point,
    interval_words,
    missing_words,
    short,
)
from marey_reports.drawing.drawn import Sketch, Tables
from marey_reports.drawing.paper import COLOURS, INK, QUIET, Place, new_figure, plain, write
from marey_schemas.queue.comparisons import ComparedColumn

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MOST_BARS_DRAWN = 30
NARROW = 0.7
"""Limit for the ratio of the least to the greatest value.

Above it, bars from 0 would look equally long, so dots are drawn instead.
"""
_ROW, _ABOVE, _UNDER, _RIGHT, _PAGE = 0.27, 0.62, 0.6, 1.65, 9.6
_SIGN = 0.068
"""Width of a character in inches."""


def draw_bars(subject: ComparedSubject, column: ComparedColumn) -> Sketch | None:
    """Draw the mean of a field for each setting that has one, up to `MOST_BARS_DRAWN`; return None if there are none.

    If the axis does not contain zero (it is logarithmic, or the values are close together), dots replace the bars,
    because the lengths of bars would be misleading.
    """
    points = subject.points(column.name)
    if not points:
        return None
    shown = points[:MOST_BARS_DRAWN]
    low, high = min(one.ends[0] for one in shown), max(one.ends[1] for one in shown)
    log = subject.is_log([low])
    bars = not log and not (min(abs(low), abs(high)) > NARROW * max(abs(low), abs(high)) and low * high > 0.0)
    height = _ROW * max(len(shown), 2)
    figure = new_figure(_PAGE, height + _ABOVE + _UNDER)
    left_in = 0.35 + _SIGN * max(len(subject.labels[one.setting]) for one in shown)
    panel = add_chart(figure, Place(left_in, _UNDER, _PAGE - _RIGHT - left_in, height), title=axis_title(column.name),
                      x=axis_title(column.name, log=log))  # fmt: skip
    panel.grid(visible=False, axis="y")
    if bars:
        low, high = min(low, 0.0), max(high, 0.0)
    if not log:
        low, high = widened(low, high, [one.summary for one in shown])
    left, right = spread(low, high, log=log)
    if bars and low < high:
        left, right = (left if low < 0.0 else 0.0), (right if high > 0.0 else 0.0)
    panel.set_xlim(left, right)
    if log:
        set_logarithmic(panel.xaxis)
    for row, point in enumerate(shown):
        _draw_row(panel, row, point, bars=bars)
    panel.set_ylim(len(shown) - 0.4, -0.6)
    _name_rows(panel, subject, shown, column)
    return Sketch(figure, _tables(subject, points), _caption(subject, column, shown, bars=bars))


def _draw_row(panel: Axes, row: int, point: Point, *, bars: bool) -> None:
    summary = point.summary
    if bars:
        panel.barh([row], [summary.mean], height=0.62, color=COLOURS[5], alpha=0.55, lw=0)
    if summary.low is not None and summary.high is not None:
        panel.plot([summary.low, summary.high], [row, row], color=INK, lw=1.3, zorder=3, solid_capstyle="butt")
        panel.plot([summary.low, summary.high], [row, row], color=INK, ls="", marker="|", ms=7, mew=1.3, zorder=3)
    if summary.n > 1:
        panel.plot(point.numbers, np.full(summary.n, row), ls="", marker="o", ms=3.6, color=COLOURS[0], alpha=0.75,
                   mec=INK, mew=0.4, zorder=4)  # fmt: skip
        panel.plot([summary.mean] * 2, [row - 0.31, row + 0.31], color=INK, lw=1.8, zorder=5)
    else:
        panel.plot([summary.mean], [row], ls="", marker="o", ms=4.6, color=COLOURS[0], zorder=4)


def _name_rows(panel: Axes, subject: ComparedSubject, shown: list[Point], column: ComparedColumn) -> None:
    """Write the names of settings at the left, and mean and number of runs at the right."""
    panel.set_yticks(range(len(shown)), [plain(subject.labels[one.setting]) for one in shown], parse_math=False)
    panel.tick_params(axis="y", length=0, labelcolor=INK)
    _write_columns(panel, shown, column)


def _write_columns(panel: Axes, shown: list[Point], column: ComparedColumn) -> None:
    """Write mean and number of runs at the right of the panel, in columns with fixed distances in inches."""
    from matplotlib.transforms import blended_transform_factory

    across = blended_transform_factory(panel.transAxes, panel.transData)
    means, counts, marks = (beside(panel, across, inches) for inches in (0.7, 1.0, 1.08))
    head = "mean" if any(one.summary.n > 1 for one in shown) else "value"
    for transform, text in ((means, head), (counts, "n")):
        write(panel, (1.0, -1.0), text, transform=transform, ha="right", color=QUIET)
    for row, one in enumerate(shown):
        best = column.best_mean is not None and one.summary.mean == column.best_mean
        weight = "bold" if best else "normal"
        write(panel, (1.0, row), short(one.summary.mean), transform=means, ha="right", fontweight=weight)
        write(panel, (1.0, row), str(one.summary.n), transform=counts, ha="right", color=QUIET)
        if best and column.goal is not None:
            write(panel, (1.0, row), column.goal, transform=marks, fontweight="bold")


def _caption(subject: ComparedSubject, column: ComparedColumn, shown: list[Point], *, bars: bool) -> str:
    replicated = any(one.summary.n > 1 for one in shown)
    parts = [f"{column.name} by setting, {'the best first' if column.goal else 'in the order of the comparison'}"]
    if not bars:
        parts.append("the axis does not begin at 0, so there are no bars")
    if replicated:
        parts.append("dots are runs with different seeds, and a short upright line is their mean")
    if any(one.summary.low is not None for one in shown):
        parts.append(f"horizontal lines are {interval_words()}")
    if (number := len(subject.points(column.name))) > len(shown):
        parts.append(f"the first {len(shown)} of {number} settings are drawn")
    return f"{'; '.join([*parts, *missing_words(subject.left_out(column.name))])}."


def _tables(subject: ComparedSubject, points: list[Point]) -> Tables:
    return {
        "settings": {
            "setting": [subject.labels[one.setting] for one in points],
            **{name: [getattr(one.summary, name) for one in points] for name in ("n", "mean", "low", "high")},
        }
    }
