"""Which stretches of the most used clips the character displayed, and how often."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from marey_motion.evaluation.figures.drawn import Sketch
from marey_motion.evaluation.figures.paper import (
    MISSING,
    QUIET,
    SMALL,
    Place,
    add_colour_bar,
    add_panel,
    name_ticks,
    new_figure,
    nice_ceiling,
)
from marey_motion.evaluation.figures.subjects import FigureOptions, Subject

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.cm import ScalarMappable

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

STRETCHES = 200
ROW = 0.235


class _Strip(NamedTuple):
    """A clip: ticks per frame, averaged over each of its stretches, and how many of its frames were shown at all."""

    uid: str
    name: str
    duration_s: float
    ticks_per_frame: Floats
    shown: float


def draw_frame_use(subjects: Sequence[Subject], trial: str | None, options: FigureOptions) -> Sketch:
    """One strip per clip from its beginning to its end, the most used first; two subjects side by side."""
    strips = [_strips(subject, trial, options.most_clips) for subject in subjects]
    rows = max([1, *(len(each) for each in strips)])
    width = 5.0 if len(subjects) == 1 else 1.55
    figure = new_figure(9.0 if len(subjects) == 1 else 9.6, ROW * rows + (1.6 if trial or len(subjects) > 1 else 1.3))
    ceiling = nice_ceiling(max([0.0, *(float(strip.ticks_per_frame.max()) for each in strips for strip in each)]))
    drawn = None
    for number, (subject, each) in enumerate(zip(subjects, strips, strict=True)):
        left = 2.45 + number * (width + 3.2)
        title = subject.label or trial or ""
        panel = add_panel(
            figure, Place(left, 1.2, width, ROW * rows), title=title, x="time in the clip (% of its length)", grid=False
        )
        drawn = _draw(panel, each, rows, ceiling) or drawn
    if drawn is not None:
        place = Place(2.45, 0.5, figure.get_size_inches()[0] - 2.45 - 1.15, 0.12)
        add_colour_bar(figure, drawn, place, "times each frame was displayed")
    return Sketch(figure, {"stretches": _table(subjects, strips)}, _caption(subjects, strips))


def _strips(subject: Subject, trial: str | None, most: int) -> list[_Strip]:
    used = sorted((each for each in subject.usage(trial) if each.ticks), key=lambda each: -each.ticks)
    return [
        _Strip(
            subject.result.clips[each.clip].uid,
            subject.result.clips[each.clip].name,
            len(each.popularity) * subject.seconds_per_row,
            _averaged(each.popularity),
            float(np.mean(each.popularity > 0)),
        )
        for each in used[:most]
    ]


def _averaged(popularity: Ints) -> Floats:
    count = min(STRETCHES, len(popularity))
    starts = np.arange(count) * len(popularity) // count
    sizes = np.diff(np.append(starts, len(popularity)))
    return np.asarray(np.add.reduceat(popularity, starts) / sizes, dtype=np.float64)


def _draw(panel: Axes, strips: Sequence[_Strip], rows: int, ceiling: float) -> ScalarMappable | None:
    from matplotlib.colors import PowerNorm

    drawn: ScalarMappable | None = None
    for row, strip in enumerate(strips):
        edges = np.linspace(0.0, 100.0, len(strip.ticks_per_frame) + 1)
        values = np.ma.masked_equal(strip.ticks_per_frame[None], 0.0)
        drawn = panel.pcolormesh(
            edges,
            [row - 0.42, row + 0.42],
            values,
            cmap=MISSING,
            norm=PowerNorm(0.5, 0.0, ceiling),
            rasterized=True,
        )
        panel.annotate(
            f"{strip.duration_s:.1f} s, {100 * strip.shown:.0f} % shown", (100.0, row), (4, 0), va="center",
            textcoords="offset points", fontsize=SMALL, color=QUIET, annotation_clip=False,
        )  # fmt: skip
    name_ticks(panel, range(len(strips)), [strip.name for strip in strips])
    panel.set(xlim=(0.0, 100.0), ylim=(rows - 0.4, -0.6))
    return drawn


def _table(subjects: Sequence[Subject], strips: Sequence[Sequence[_Strip]]) -> dict[str, list[object]]:
    names = ("dataset", "clip", "name", "start_percent", "stop_percent", "ticks_per_frame")
    table: dict[str, list[object]] = {name: [] for name in names}
    for subject, each in zip(subjects, strips, strict=True):
        for strip in each:
            edges = np.linspace(0.0, 100.0, len(strip.ticks_per_frame) + 1)
            count = len(strip.ticks_per_frame)
            for name, values in zip(
                names,
                ([subject.label] * count, [strip.uid] * count, [strip.name] * count, edges[:-1].tolist(),
                 edges[1:].tolist(), strip.ticks_per_frame.tolist()),
                strict=True,
            ):  # fmt: skip
                table[name] += values
    return table


def _caption(subjects: Sequence[Subject], strips: Sequence[Sequence[_Strip]]) -> str:
    parts = []
    for subject, each in zip(subjects, strips, strict=True):
        frames = sum(len(usage.popularity) for usage in subject.result.usage)
        shown = sum(int(np.count_nonzero(usage.popularity)) for usage in subject.result.usage)
        share = f"{100 * shown / frames:.0f} %" if frames else "none"
        parts.append(
            f"{subject.prefix}{share} of all frames were displayed at least once in the suite; {len(each)} clips drawn."
        )
    return "Darker stretches were displayed more often, blank ones never. " + " ".join(parts)
