"""Table of perceptual distances as a picture, with similar clips as neighbours (figure 4 of Pražák et al.)."""

from __future__ import annotations

from marey_motion.perception.ordering import order_motions
from marey_reports.drawing.drawn import Sketch
from marey_reports.drawing.paper import (
    INK,
    LIGHT,
    MORE_IS_WORSE,
    Place,
    add_colour_bar,
    add_panel,
    labels_of,
    name_ticks,
    new_figure,
    plain,
    write,
)
from marey_reports.perception.compared import ComparedSet

MOST_WRITTEN = 24
"""Greatest number of clips for which the distances are written in the cells as numbers."""
MOST_NAMED = 60
_CELL, _SMALL_CELL, _SIGN, _BAR = 0.34, 0.13, 0.075, 0.14
_MOST_SIDE = 16.0
"""Greatest length of a side of the table, in inches."""
_DARK_FROM = 0.43


def draw_distance_table(subject: ComparedSet) -> Sketch:
    """Draw the distances of all pairs of at least three clips."""
    order = order_motions(subject.distances.totals).order
    totals = subject.distances.totals[order][:, order]
    names = [subject.clips[index].name for index in order]
    count = len(names)
    side = min(count * (_CELL if count <= MOST_WRITTEN else _SMALL_CELL), _MOST_SIDE)
    named = count <= MOST_NAMED
    labels = labels_of(names)
    left = 0.35 + (_SIGN * max(map(len, labels)) if named else 0.1)
    below = left if named else 0.35
    figure = new_figure(left + side + 1.0, below + side + 0.25)
    panel = add_panel(figure, Place(left, below, side, side), grid=False)
    highest = float(totals.max()) or 1.0
    image = panel.imshow(totals, cmap=MORE_IS_WORSE, vmin=0.0, vmax=highest, interpolation="nearest")
    if named:
        name_ticks(panel, range(count), names)
        panel.set_xticks(range(count), [plain(label) for label in labels], rotation=90, parse_math=False)
        panel.tick_params(axis="x", length=0, labelcolor=INK)
    else:
        panel.set_xticks([])
        panel.set_yticks([])
    if count <= MOST_WRITTEN:
        for row in range(count):
            for column in range(count):
                value = float(totals[row, column])
                colour = LIGHT if value > _DARK_FROM * highest else INK
                if row != column:
                    text = f"{value:.2f}".removeprefix("0")
                    write(panel, (column, row), text, ha="center", color=colour, fontsize=6.5)
    add_colour_bar(figure, image, Place(left + side + 0.15, below, _BAR, side), "perceptual distance")
    caption = (
        f"Perceptual distances of {count} clips by the metric {subject.metric.name}. The clips are in the order of the "
        "first principal component of the table, so similar clips tend to be neighbours."
    )
    columns = {"clip": names, **{f"to {place + 1}": totals[:, place] for place in range(count)}}
    return Sketch(figure, {"distances": columns}, caption)
