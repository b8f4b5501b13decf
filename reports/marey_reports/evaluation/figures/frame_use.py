"""Figure of the most used clips, each as a strip whose colours show how often each part was displayed."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from marey_motion.arrays import Floats, Ints
from marey_motion.evaluation.result import ClipUsage
from marey_reports.drawing.drawn import Sketch
from marey_reports.drawing.paper import (
    QUIET,
    SMALL,
    Place,
    add_colour_bar,
    add_panel,
    name_ticks,
    new_figure,
    nice_ceiling,
    square_root_ticks,
    warm_colours,
)
from marey_reports.evaluation.figures.axes import ROW
from marey_reports.evaluation.figures.subjects import FigureOptions, Subject

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.cm import ScalarMappable


STRETCHES = 200


class _Strip(NamedTuple):
    """Strip of a clip: mean ticks per frame in each of its ranges, and the share of its frames that were displayed."""

    uid: str
    name: str
    duration_s: float
    ticks_per_frame: Floats
    shown: float


def draw_frame_use(subjects: Sequence[Subject], trial: str | None, options: FigureOptions) -> Sketch:
    """Draw one strip per clip from beginning to end, the most used first.

    If two evaluations are compared, each row shows the strips of both side by side.
    """
    usage = [{subject.result.clips[each.clip].uid: each for each in subject.usage(trial)} for subject in subjects]
    uids = _most_used(usage, options.most_clips)
    strips = [_strips(subject, each, uids) for subject, each in zip(subjects, usage, strict=True)]
    rows, two = max(1, len(uids)), len(subjects) > 1
    width, between = (2.4, 1.45) if two else (5.0, 1.55)
    figure = new_figure(2.45 + len(subjects) * (width + between), ROW * rows + (1.6 if trial or two else 1.3))
    ceiling = nice_ceiling(
        max([0.0, *(float(strip.ticks_per_frame.max()) for each in strips for strip in each.values())])
    )
    drawn: ScalarMappable | None = None
    for number, (subject, each) in enumerate(zip(subjects, strips, strict=True)):
        place = Place(2.45 + number * (width + between), 1.2, width, ROW * rows)
        title = subject.label or trial or ""
        panel = add_panel(figure, place, title=title, x="time in the clip (% of its length)", grid=False)
        drawn = _draw(panel, uids, each, ceiling) or drawn
        names = [next(each[uid].name for each in strips if uid in each) for uid in uids]
        name_ticks(panel, range(len(uids)), names if number == 0 else [""] * len(uids))
        panel.set(xlim=(0.0, 100.0), ylim=(rows - 0.4, -0.6))
    if drawn is not None:
        place = Place(2.45, 0.5, len(subjects) * (width + between) - between, 0.12)
        add_colour_bar(figure, drawn, place, "times that a frame was displayed", square_root_ticks(ceiling))
    return Sketch(figure, {"stretches": _table(subjects, strips)}, _caption(subjects, strips))


def _most_used(usage: Sequence[dict[str, ClipUsage]], most: int) -> list[str]:
    totals: dict[str, int] = {}
    for each in usage:
        for uid, own in each.items():
            totals[uid] = totals.get(uid, 0) + own.ticks
    return sorted((uid for uid, ticks in totals.items() if ticks), key=lambda uid: (-totals[uid], uid))[:most]


def _strips(subject: Subject, usage: dict[str, ClipUsage], uids: Sequence[str]) -> dict[str, _Strip]:
    return {
        uid: _Strip(
            uid,
            subject.result.clips[own.clip].name,
            len(own.popularity) * subject.seconds_per_row,
            _averaged(own.popularity),
            float(np.mean(own.popularity > 0)),
        )
        for uid in uids
        if (own := usage.get(uid)) is not None and len(own.popularity)
    }


def _averaged(popularity: Ints) -> Floats:
    count = min(STRETCHES, len(popularity))
    starts = np.arange(count) * len(popularity) // count
    sizes = np.diff(np.append(starts, len(popularity)))
    return np.asarray(np.add.reduceat(popularity, starts) / sizes, dtype=np.float64)


def _draw(panel: Axes, uids: Sequence[str], strips: dict[str, _Strip], ceiling: float) -> ScalarMappable | None:
    from matplotlib.colors import PowerNorm

    drawn: ScalarMappable | None = None
    for row, strip in ((row, strips[uid]) for row, uid in enumerate(uids) if uid in strips):
        edges = np.linspace(0.0, 100.0, len(strip.ticks_per_frame) + 1)
        values = np.ma.masked_equal(strip.ticks_per_frame[None], 0.0)
        norm = PowerNorm(0.5, 0.0, ceiling)
        drawn = panel.pcolormesh(
            edges, [row - 0.42, row + 0.42], values, cmap=warm_colours(), norm=norm, rasterized=True
        )
        about = f"{strip.duration_s:.1f} s, {100 * strip.shown:.0f} % used"
        look: dict[str, Any] = {"va": "center", "textcoords": "offset points", "fontsize": SMALL, "color": QUIET}
        panel.annotate(about, (100.0, row), (4, 0), annotation_clip=False, **look)
    return drawn


def _table(subjects: Sequence[Subject], strips: Sequence[dict[str, _Strip]]) -> dict[str, list[object]]:
    names = ("dataset", "clip", "name", "start_percent", "stop_percent", "ticks_per_frame")
    table: dict[str, list[object]] = {name: [] for name in names}
    for subject, each in zip(subjects, strips, strict=True):
        for strip in each.values():
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


def _caption(subjects: Sequence[Subject], strips: Sequence[dict[str, _Strip]]) -> str:
    parts = []
    for subject, each in zip(subjects, strips, strict=True):
        frames = sum(len(usage.popularity) for usage in subject.result.usage)
        shown = sum(int(np.count_nonzero(usage.popularity)) for usage in subject.result.usage)
        share = f"{100 * shown / frames:.0f} %" if frames else "none"
        parts.append(
            f"{subject.prefix}{share} of all frames were displayed at least once in the suite; {len(each)} clips drawn."
        )
    return (
        "The stronger the colour of a part, the more often it was displayed; parts without colour never were. "
        + " ".join(parts)
    )
