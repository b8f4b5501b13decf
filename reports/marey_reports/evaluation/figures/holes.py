"""Map of missing data: the seconds that each cell of speed and turn rate lacks."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from marey_reports.drawing.drawn import Sketch
from marey_reports.drawing.paper import (
    DARK,
    INK,
    LIGHT,
    QUIET,
    SMALL,
    Place,
    add_colour_bar,
    add_panel,
    luminance,
    new_figure,
    plain,
    warm_colours,
    write,
)
from marey_reports.evaluation.figures.axes import SPEED, TURN_RATE, mark_sides
from marey_reports.evaluation.figures.subjects import FigureOptions, Subject

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.cm import ScalarMappable


def draw_holes(subjects: Sequence[Subject], _trial: str | None, _options: FigureOptions) -> Sketch:
    """Draw the grid of trials; each cell shows the seconds of data that it lacks, and is empty if it lacks none."""
    two = len(subjects) > 1
    width, height, gap = (4.0, 3.3, 0.4) if two else (6.2, 3.9, 0.0)
    figure = new_figure(9.9 if two else 7.8, height + (1.15 if two else 0.85))
    least = max([subject.result.options.coverage_least_s for subject in subjects])
    drawn = None
    for number, subject in enumerate(subjects):
        place = Place(0.65 + number * (width + gap), 0.58, width, height)
        panel = add_panel(figure, place, x=TURN_RATE, y=SPEED if number == 0 else "", grid=False)
        panel.tick_params(labelleft=number == 0)
        panel.set_title(plain(subject.label), pad=17, loc="left", fontweight="bold", color=INK, parse_math=False)
        drawn = _draw(panel, subject, least, SMALL if not two else 6.5)
        mark_sides(panel)
    if drawn is not None:
        place = Place(0.65 + len(subjects) * (width + gap) - gap + 0.12, 0.58, 0.14, height)
        add_colour_bar(figure, drawn, place, f"seconds missing of {least:g}")
    return Sketch(figure, {"holes": _table(subjects)}, _caption(subjects))


def _draw(panel: Axes, subject: Subject, least: float, size: float) -> ScalarMappable:
    coverage = subject.result.coverage
    missing = np.ma.masked_less_equal(coverage.deficit_s, 0.0)
    edges = coverage.turn_rate_edges_deg_s, coverage.speed_edges_m_s
    drawn = panel.pcolormesh(*edges, missing, cmap=warm_colours(), vmin=0.0, vmax=least, edgecolors="none")
    turn, speed = (0.5 * (each[:-1] + each[1:]) for each in edges)
    for row, column in np.argwhere(coverage.deficit_s > 0.0):
        value = float(coverage.deficit_s[row, column])
        light = bool(luminance(np.asarray(drawn.to_rgba(np.array(value)))) > 0.3)
        text = f"{value:.1f}" if value < 9.95 else f"{value:.0f}"
        place = float(turn[column]), float(speed[row])
        write(panel, place, text, ha="center", fontsize=size, color=DARK if light else LIGHT)
    for row, column in np.argwhere(coverage.deficit_s <= 0.0):
        panel.plot(turn[column], speed[row], ".", color=QUIET, ms=3)
    panel.set_xticks(turn[:: max(1, len(turn) // 8)])
    panel.set_yticks(speed[:: max(1, len(speed) // 8)])
    panel.set(xlim=edges[0][[0, -1]], ylim=edges[1][[0, -1]])
    return drawn


def _table(subjects: Sequence[Subject]) -> dict[str, list[object]]:
    names = ("dataset", "speed_m_s", "turn_rate_deg_s", "seconds_s", "missing_s")
    table: dict[str, list[object]] = {name: [] for name in names}
    for subject in subjects:
        coverage = subject.result.coverage
        edges = coverage.speed_edges_m_s, coverage.turn_rate_edges_deg_s
        speed, turn = np.meshgrid(*(0.5 * (each[:-1] + each[1:]) for each in edges), indexing="ij")
        table["dataset"] += [subject.label] * speed.size
        for name, values in (
            ("speed_m_s", speed),
            ("turn_rate_deg_s", turn),
            ("seconds_s", coverage.seconds),
            ("missing_s", coverage.deficit_s),
        ):
            table[name] += values.ravel().tolist()
    return table


def _caption(subjects: Sequence[Subject]) -> str:
    parts = []
    for subject in subjects:
        missing = subject.result.coverage.deficit_s
        parts.append(
            f"{subject.prefix}{np.count_nonzero(missing > 0)} of {missing.size} cells lack data, "
            f"{missing.sum():.1f} s in all."
        )
    return f"Seconds of data that each cell lacks; a dot marks a cell with enough data. {' '.join(parts)}"
