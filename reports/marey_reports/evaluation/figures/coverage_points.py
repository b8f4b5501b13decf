"""Figure 1: the speeds and turn rates of every clip, distinguished by colour and marker."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from marey_reports.drawing.drawn import Sketch
from marey_reports.drawing.paper import (
    COLOURS,
    INK,
    MARKERS,
    QUIET,
    REFERENCE,
    Place,
    add_keys,
    add_panel,
    labels_of,
    new_figure,
    plain,
    reach,
)
from marey_reports.evaluation.figures.axes import SPEED, TURN_RATE, mark_sides
from marey_reports.evaluation.figures.subjects import FigureOptions, Subject
from marey_schemas.wording import counted

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MOST_POINTS = 6_000  # per subject; more only cover each other
DRAWN_AS_SHAPES = 800  # beyond, the points are one image inside the SVG
CATEGORIES = len(COLOURS) * len(MARKERS)


class _Points(NamedTuple):
    """Indices of the windows of a subject's coverage that are drawn, and of the clips that have their own colours."""

    windows: NDArray[np.int64]
    named: list[int]


def draw_points(subjects: Sequence[Subject], _trial: str | None, options: FigureOptions) -> Sketch:
    """Draw a point for each window of one second; of more than `MOST_POINTS` windows, only some at even intervals."""
    chosen = _choose(subjects, min(options.most_clips, CATEGORIES))
    width = 9.6 if len(subjects) > 1 else 8.6
    keys = 2.5
    each = (width - 0.75 - keys - 0.45 * (len(subjects) - 1)) / len(subjects)
    figure = new_figure(width, 4.9 if len(subjects) > 1 else 4.65)
    limits = _limits(subjects)
    styles: dict[str, int] = {}  # a clip looks the same in both panels
    for number, (subject, points) in enumerate(zip(subjects, chosen, strict=True)):
        place = Place(0.65 + number * (each + 0.45), 0.55, each, 3.85)
        panel = add_panel(figure, place, title=subject.label, x=TURN_RATE, y=SPEED if number == 0 else "")
        panel.tick_params(labelleft=number == 0)
        panel.set_title(plain(subject.label), pad=17, loc="left", fontweight="bold", color=INK, parse_math=False)
        _draw(panel, subject, points, styles)
        panel.set(xlim=limits[0], ylim=limits[1])
        mark_sides(panel)
    _draw_keys(figure.axes[-1], subjects, chosen, styles)
    return Sketch(figure, {"points": _table(subjects, chosen)}, _caption(subjects, chosen, limits))


def _choose(subjects: Sequence[Subject], most_clips: int) -> list[_Points]:
    """Select windows at even intervals, and the clips with most data, which get their own colour and marker."""
    held: dict[str, int] = {}
    for subject in subjects:
        for clip, windows in enumerate(np.bincount(subject.result.coverage.clip).tolist()):
            uid = subject.result.clips[clip].uid
            held[uid] = held.get(uid, 0) + windows
    named = sorted((uid for uid, windows in held.items() if windows), key=lambda uid: (-held[uid], uid))[:most_clips]
    chosen = []
    for subject in subjects:
        step = max(1, -(-len(subject.result.coverage.clip) // MOST_POINTS))
        index = {clip.uid: number for number, clip in enumerate(subject.result.clips)}
        windows = np.arange(0, len(subject.result.coverage.clip), step)
        chosen.append(_Points(windows, [index[uid] for uid in named if uid in index]))
    return chosen


def _limits(subjects: Sequence[Subject]) -> tuple[tuple[float, float], tuple[float, float]]:
    coverages = [subject.result.coverage for subject in subjects]
    turns = np.concatenate([np.abs(np.degrees(coverage.turn_rate_rad_s)) for coverage in coverages])
    speeds = np.concatenate([coverage.speed_m_s for coverage in coverages])
    turn = reach(turns, max(float(np.abs(coverage.turn_rate_edges_deg_s).max()) for coverage in coverages))
    speed = reach(speeds, max(float(coverage.speed_edges_m_s[-1]) for coverage in coverages))
    return (-1.04 * turn, 1.04 * turn), (0.0, 1.04 * speed)


def _draw(panel: Axes, subject: Subject, points: _Points, styles: dict[str, int]) -> None:
    coverage = subject.result.coverage
    clips = coverage.clip[points.windows]
    turn, speed = np.degrees(coverage.turn_rate_rad_s[points.windows]), coverage.speed_m_s[points.windows]
    as_image = len(points.windows) > DRAWN_AS_SHAPES
    others = ~np.isin(clips, points.named)
    panel.scatter(turn[others], speed[others], s=6, c=REFERENCE, alpha=0.5, lw=0, rasterized=as_image, zorder=2)
    for clip in reversed(points.named):  # the clip with most data lies below the others
        mine = clips == clip
        style = styles.setdefault(subject.result.clips[clip].uid, len(styles) % CATEGORIES)
        panel.scatter(turn[mine], speed[mine], s=13, alpha=0.75, lw=0, rasterized=as_image, zorder=3, **_look(style))


def _look(style: int) -> dict[str, Any]:
    """Return the colour and the marker for a style number; consecutive numbers differ in both."""
    row = style // len(COLOURS)
    return {"c": COLOURS[style % len(COLOURS)], "marker": MARKERS[(style + row) % len(MARKERS)]}


def _draw_keys(panel: Axes, subjects: Sequence[Subject], chosen: Sequence[_Points], styles: dict[str, int]) -> None:
    from matplotlib.lines import Line2D

    names = {
        subject.result.clips[clip].uid: subject.result.clips[clip].name
        for subject, points in zip(subjects, chosen, strict=True)
        for clip in points.named
    }
    keys, labels = [], []
    names = dict(zip(names, labels_of(list(names.values())), strict=True))
    for uid, style in styles.items():
        look = _look(style)
        keys.append(Line2D([], [], ls="", color=look["c"], marker=look["marker"], markersize=5, markeredgewidth=0))
        labels.append(plain(names[uid]))
    rest = max(_other_clips(subject, points) for subject, points in zip(subjects, chosen, strict=True))
    if rest:
        keys.append(Line2D([], [], ls="", color=REFERENCE, marker="o", markersize=3.5, markeredgewidth=0))
        labels.append(counted(rest, "other clip"))
    if not keys:
        panel.text(0.5, 0.5, "no clip of one second or more", transform=panel.transAxes, ha="center", color=QUIET)
        return
    add_keys(panel, handles=keys, labels=labels, loc="upper left", bbox_to_anchor=(1.01, 1.03), handletextpad=0.2)


def _other_clips(subject: Subject, points: _Points) -> int:
    return len(np.setdiff1d(subject.result.coverage.clip, points.named))


def _table(subjects: Sequence[Subject], chosen: Sequence[_Points]) -> dict[str, object]:
    table: dict[str, list[object]] = {"dataset": [], "clip": [], "name": [], "speed_m_s": [], "turn_rate_deg_s": []}
    for subject, points in zip(subjects, chosen, strict=True):
        coverage = subject.result.coverage
        clips = [subject.result.clips[clip] for clip in coverage.clip[points.windows]]
        table["dataset"] += [subject.label] * len(clips)
        table["clip"] += [clip.uid for clip in clips]
        table["name"] += [clip.name for clip in clips]
        table["speed_m_s"] += coverage.speed_m_s[points.windows].tolist()
        table["turn_rate_deg_s"] += np.degrees(coverage.turn_rate_rad_s[points.windows]).tolist()
    return dict(table)


def _caption(
    subjects: Sequence[Subject],
    chosen: Sequence[_Points],
    limits: tuple[tuple[float, float], tuple[float, float]],
) -> str:
    parts = []
    for subject, points in zip(subjects, chosen, strict=True):
        held, total = len(np.unique(subject.result.coverage.clip)), len(subject.result.coverage.clip)
        drawn = "all of them" if len(points.windows) == total else f"{len(points.windows):,} of them, evenly spaced"
        turn, speed = np.degrees(subject.result.coverage.turn_rate_rad_s), subject.result.coverage.speed_m_s
        beyond = int(np.count_nonzero((np.abs(turn) > limits[0][1]) | (speed > limits[1][1])))
        outside = f"; {beyond:,} are outside the axes" if beyond else ""
        parts.append(f"{subject.prefix}{total:,} windows from {counted(held, 'clip')}, {drawn} drawn{outside}.")
    return "Each point shows the mean speed and turn rate of a window of one second. " + " ".join(parts)
