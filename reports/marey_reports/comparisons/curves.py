"""Chart of a field over steps: thin lines of runs, and means of replicates with intervals."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from marey_motion.arrays import Floats
from marey_reports.comparisons.axes import add_chart, axis_title, set_logarithmic, spread
from marey_reports.comparisons.subjects import LARGEST, ComparedSubject, interval_words
from marey_reports.drawing.drawn import Sketch, Tables
from marey_reports.drawing.paper import (
    COLOURS,
    INK,
    MARKERS,
    REFERENCE,
    Place,
    add_keys,
    new_figure,
    plain,
    tick_whole_numbers,
)
from marey_schemas.documents.replicates import mean_interval
from marey_schemas.queue.comparisons import Curve
from marey_schemas.wording import counted

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MOST_OTHERS = 40
"""Greatest number of runs that are drawn in grey, behind the settings with colours."""
MOST_BEYOND = 0.1
"""Largest share of the range of the runs by which each end of the axis is extended to show intervals."""


class _MeanCurve(NamedTuple):
    """Means of replicates at their common steps; `low` and `high` are NaN without an interval."""

    steps: Floats
    mean: Floats
    low: Floats
    high: Floats


def draw_curves(subject: ComparedSubject, field: str) -> Sketch | None:
    """Draw a field over steps; return None if no run logged the field over steps.

    The first settings have colours, and the others are grey. A mean is drawn only at steps where all its runs have a
    number, because a mean of some of the runs would be misleading.
    """
    groups = _groups(subject, field)
    if not groups:
        return None
    coloured = list(groups.items())[: len(COLOURS)]
    others = [curve for curves in list(groups.values())[len(COLOURS) :] for curve in curves]
    drawn = [*(curve for _, curves in coloured for curve in curves), *others[:MOST_OTHERS]]
    numbers = np.concatenate([_values(curve) for curve in drawn])
    numbers = numbers[np.isfinite(numbers)]
    log = subject.is_log(numbers.tolist())
    figure = new_figure(9.6, 4.0)
    panel = add_chart(figure, Place(0.95, 0.6, 5.0, 2.95), title=axis_title(field), x="step",
                      y=axis_title(field, log=log))  # fmt: skip
    tick_whole_numbers(panel.xaxis)
    _draw_others(panel, others[:MOST_OTHERS])
    means = {}
    for number, (setting, curves) in enumerate(coloured):
        means[setting] = _mean_of(curves)
        _draw_setting(panel, number, subject.labels[setting], curves, means[setting])
    if len(numbers):
        panel.set_ylim(*_limits(numbers, list(means.values()), log=log))
    if log:
        set_logarithmic(panel.yaxis)
    add_keys(panel, loc="upper left", bbox_to_anchor=(1.02, 1.03), handlelength=2.2, labelspacing=0.75)
    return Sketch(figure, _tables(subject, groups, means), _caption(field, groups, means))


def _groups(subject: ComparedSubject, field: str) -> dict[int, list[Curve]]:
    found = {}
    for place in subject.order_of(field):
        runs = (subject.comparison.runs[run] for run in subject.comparison.settings[place].runs)
        if curves := [run.curves[field] for run in runs if field in run.curves]:
            found[place] = curves
    return found


def _values(curve: Curve) -> Floats:
    """Return the values, with NaN where there is no number that can be drawn."""
    values = np.array([np.nan if value is None else value for value in curve.values], dtype=np.float64)
    return np.where(np.abs(values) <= LARGEST, values, np.nan)


def _mean_of(curves: list[Curve]) -> _MeanCurve:
    known = [{step: float(value) for step, value in zip(one.steps, _values(one), strict=True) if np.isfinite(value)}
             for one in curves]  # fmt: skip
    steps = sorted(set.intersection(*(set(one) for one in known)))
    rows = [mean_interval([one[step] for one in known]) for step in steps]
    ends = [[np.nan if end is None else end for end in (row.mean, row.low, row.high)] for row in rows]
    columns = np.array(ends, dtype=np.float64).reshape(-1, 3).T
    return _MeanCurve(np.array(steps, dtype=np.float64), *columns)


def _draw_others(panel: Axes, others: list[Curve]) -> None:
    for place, curve in enumerate(others):
        label = f"{counted(len(others), 'run')} of other settings" if place == 0 else None
        panel.plot(curve.steps, _values(curve), color=REFERENCE, lw=0.7, alpha=0.45, label=label)
        _mark_break(panel, curve)


def _draw_setting(panel: Axes, number: int, label: str, curves: list[Curve], mean: _MeanCurve) -> None:
    colour, marker = COLOURS[number], MARKERS[number]
    for curve in curves:
        values = _values(curve)
        if len(curves) > 1:
            panel.plot(curve.steps, values, color=colour, lw=0.8, alpha=0.35, zorder=2)
        _mark_break(panel, curve)
    look: dict[str, Any] = {
        "color": colour,
        "marker": marker,
        "zorder": 3,
        "label": f"{plain(label)}\nn = {len(curves)}",
    }
    if len(curves) > 1 and np.isfinite(mean.low).any():
        panel.fill_between(mean.steps, mean.low, mean.high, color=colour, alpha=0.16, lw=0)
    steps, values = (mean.steps, mean.mean) if len(curves) > 1 else (curves[0].steps, _values(curves[0]))
    # Markers of each line at other steps, so that readers can distinguish the lines without colours.
    every = max(len(steps) // 7, 1)
    panel.plot(steps, values, lw=1.8, ms=5.5, markevery=(number * every // len(COLOURS), every), **look)


def _mark_break(panel: Axes, curve: Curve) -> None:
    """Mark the last number before the first value that is not finite."""
    values = _values(curve)
    broken = np.flatnonzero(~np.isfinite(values))[:1]
    last = broken[broken > 0] - 1
    panel.plot(np.array(curve.steps)[last], values[last], ls="", marker="x", ms=7, mew=1.6, color=INK, zorder=4)


def _limits(numbers: Floats, means: list[_MeanCurve], *, log: bool) -> tuple[float, float]:
    """Return the limits of the vertical axis. They contain all runs; wide intervals may be cut off."""
    low, high = float(numbers.min()), float(numbers.max())
    reach = MOST_BEYOND * (high - low)
    ends = np.concatenate([np.concatenate((mean.low, mean.high)) for mean in means])
    ends = ends[np.isfinite(ends) & (ends > 0.0 if log else True)]
    if len(ends) and not log:
        low, high = max(min(low, float(ends.min())), low - reach), min(max(high, float(ends.max())), high + reach)
    return spread(low, high, log=log)


def _caption(field: str, groups: dict[int, list[Curve]], means: dict[int, _MeanCurve]) -> str:
    parts = [f"{field} over the steps of each run"]
    numbers = [len(curves) for curves in groups.values()]
    if max(numbers) > 1:
        parts.append(
            "thin lines are runs with different seeds, and a thick line is the mean of n runs, where all of them have "
            "a number"
        )
    if any(np.isfinite(mean.low).any() for mean in means.values()):
        parts.append(f"areas are {interval_words()}, cut off where they are much wider")
    curves = [curve for group in groups.values() for curve in group]
    if any(np.isnan(_values(curve)).any() for curve in curves):
        parts.append("a cross is the last number before one that is not finite, or too large to be drawn")
    if thinned := sum(curve.logged > len(curve.steps) for curve in curves):
        most = max(curve.logged for curve in curves)
        parts.append(f"{counted(thinned, 'run')} logged more values than are drawn, at most {most:,}")
    if len(groups) > len(COLOURS):
        others = sum(numbers[len(COLOURS) :])
        cut = f", and the first {MOST_OTHERS} of {others:,} other runs are drawn" if others > MOST_OTHERS else ""
        parts.append(f"the first {len(COLOURS)} of {len(groups)} settings have colours{cut}")
    return f"{'; '.join(parts)}."


def _tables(subject: ComparedSubject, groups: dict[int, list[Curve]], means: dict[int, _MeanCurve]) -> Tables:
    rows = [
        (subject.labels[setting], len(groups[setting]), *row)
        for setting, mean in means.items()
        for row in zip(*mean, strict=True)
    ]
    names = ("setting", "n", "step", "mean", "low", "high")
    return {"means": {name: [row[place] for row in rows] for place, name in enumerate(names)}}
