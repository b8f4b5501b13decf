"""Figures of the quality of clips: bars of the worst clips beside the totals, and seconds by speed and turn rate."""

from __future__ import annotations

from collections.abc import Sequence
from textwrap import wrap
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from marey_reports.drawing.drawn import Sketch
from marey_reports.drawing.paper import (
    COLOURS,
    INK,
    QUIET,
    SMALL,
    Place,
    add_keys,
    add_panel,
    labels_of,
    new_figure,
    plain,
    write,
)
from marey_schemas.documents.quality import (
    MAIN_MEASURE,
    MEASURES,
    MeasuredSet,
    QualityDocument,
    QualityTotal,
    worst_clips_first,
)
from marey_schemas.wording import counted

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MOST_CLIPS_DRAWN = 30
DRAWN_MEASURES = {
    MAIN_MEASURE: 0.05,
    "skate_contact_m_s": 0.05,
    "skate_ratio": 0.1,
    "penetration_m": 0.01,
    "jitter_m_s3": 50.0,
    "limit_excess_deg": 2.0,
}
"""Drawn measures, each with the least upper end of its axis. The bound keeps the bars of tiny values short."""
_WIDTH, _ROW, _ABOVE, _UNDER, _GAP, _LETTER = 9.6, 0.24, 0.78, 0.42, 0.16, 0.068
_TITLE_LETTERS = 18
_GROUND_TRUTH = "reference (ground truth)"


class _Bar(NamedTuple):
    """Row of the figure: a total with its interval, or a clip."""

    label: str
    values: dict[str, float | None]
    total: dict[str, QualityTotal] | None
    is_reference: bool


def draw_clips(document: QualityDocument) -> Sketch:
    """Draw the totals and the worst clips as bars, with a line at the total of the reference."""
    ordered = worst_clips_first(document.measured.clips)
    shown = ordered[:MOST_CLIPS_DRAWN]
    bars = [*_totals(document)]
    labels = labels_of([clip.name for clip in shown])
    bars += [_Bar(label, clip.values, None, False) for label, clip in zip(labels, shown, strict=True)]
    left = 0.2 + _LETTER * max(len(bar.label) for bar in bars)
    width = (_WIDTH - left - 0.15) / len(DRAWN_MEASURES) - _GAP
    height = _ROW * len(bars)
    figure = new_figure(_WIDTH, height + _ABOVE + _UNDER)
    for column, name in enumerate(DRAWN_MEASURES):
        place = Place(left + column * (width + _GAP), _UNDER, width, height)
        panel = add_panel(figure, place)
        _draw_column(panel, bars, name)
        panel.set_yticks(range(len(bars)), [plain(bar.label) for bar in bars] if column == 0 else [], parse_math=False)
        panel.tick_params(axis="y", length=0, labelcolor=INK)
    words = f"{counted(len(ordered), 'clip')} by {MEASURES[MAIN_MEASURE].title}, the worst first"
    if len(ordered) > len(shown):
        words += f"; the worst {len(shown)} are drawn"
    if document.reference is not None:
        words += f"; the orange row and the dashed line are the {_GROUND_TRUTH}"
    words += "; lines on totals are 95 % intervals over takes, and a dash means that the measure is undefined"
    columns = {name: [clip.values[name] for clip in ordered] for name in MEASURES}
    return Sketch(figure, {"clips": {"clip": [clip.name for clip in ordered], **columns}}, f"{words}.")


def _totals(document: QualityDocument) -> list[_Bar]:
    sets: list[tuple[str, MeasuredSet | None]] = [("all clips", document.measured), (_GROUND_TRUTH, document.reference)]
    return [
        _Bar(label, {name: total.value for name, total in one.totals.items()}, one.totals, one is document.reference)
        for label, one in sets
        if one is not None
    ]


def _draw_column(panel: Axes, bars: Sequence[_Bar], name: str) -> None:
    measure = MEASURES[name]
    values = [bar.values[name] for bar in bars]
    highest = max((DRAWN_MEASURES[name], *(value for value in values if value is not None)))
    for row, (bar, value) in enumerate(zip(bars, values, strict=True)):
        if value is None:
            write(panel, (0.0, row), "–", color=QUIET)
            continue
        colour = COLOURS[1] if bar.is_reference else COLOURS[0]
        panel.barh([row], [value], height=0.7, color=colour, alpha=0.95 if bar.total else 0.6, lw=0)
        total = None if bar.total is None else bar.total[name]
        if total is not None and total.low is not None and total.high is not None:
            highest = max(highest, total.high)
            panel.plot([total.low, total.high], [row, row], color=INK, lw=1.4, solid_capstyle="butt")
        if bar.is_reference:
            panel.axvline(value, color=COLOURS[1], lw=1.0, ls=(0, (4, 3)), zorder=0.5)
    panel.set_ylim(len(bars) - 0.4, -0.6)
    panel.set_xlim(0.0, 1.05 * highest)
    panel.locator_params(axis="x", nbins=3, prune="upper")
    panel.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
    panel.grid(visible=False, axis="y")
    title = f"{measure.title} ({measure.unit})" if measure.unit else measure.title
    panel.set_title("\n".join(wrap(title, _TITLE_LETTERS)), fontsize=SMALL, color=INK, loc="left", pad=6)


def draw_travel(document: QualityDocument) -> Sketch:
    """Draw the shares of time by speed and by turn rate, with outlines for the reference."""
    figure = new_figure(_WIDTH, 3.0)
    tables = {}
    parts = (
        ("speed", "speed (m/s)", document.speed_edges_m_s, "speed_seconds"),
        ("turn", "turn rate (°/s), left positive", document.turn_edges_deg_s, "turn_seconds"),
    )
    for column, (name, label, edges, member) in enumerate(parts):
        panel = add_panel(figure, Place(0.7 + 4.6 * column, 0.55, 3.9, 2.1), x=label, y="share of windows (%)")
        own = _shares(getattr(document.measured, member))
        panel.stairs(own, edges, fill=True, color=COLOURS[0], alpha=0.6, label="clips")
        tables[name] = {"from": list(edges[:-1]), "to": list(edges[1:]), "clips_percent": own}
        if document.reference is not None:
            other = _shares(getattr(document.reference, member))
            panel.stairs(other, edges, color=COLOURS[1], lw=1.6, label="reference")
            tables[name]["reference_percent"] = other
            add_keys(panel, loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2)
    caption = (
        "Windows of one second by their mean speed and turn rate. Windows beyond the ends of an axis count in its "
        "outermost bins; clips shorter than a second have none."
    )
    return Sketch(figure, tables, caption)


def _shares(seconds: Sequence[float]) -> list[float]:
    total = float(np.sum(seconds))
    return [100.0 * value / total if total > 0.0 else 0.0 for value in seconds]
