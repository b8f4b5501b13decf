"""Figure 1 of Abichequer Sangalli et al. (2022): the speeds and turn rates of every clip.

Up to `MOST_COLOURED` clips differ by colour and marker in one panel. More clips get a small panel each, with
the name above it, because a reader cannot match more colours with a legend.
"""

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
    SMALL,
    TEXT,
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
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

MOST_POINTS = 6_000  # per subject; more only cover each other
DRAWN_AS_SHAPES = 800  # beyond, the points are one image inside the SVG
MOST_COLOURED = len(COLOURS)
MOST_PANELS = 24
BEHIND = 700  # grey points in each small panel, which show all clips
SMALL_NAME = 22  # characters of a name above a small panel
ACROSS = 5  # small panels side by side


Limits = tuple[tuple[float, float], tuple[float, float]]
"""Ends of the horizontal axis, in degrees per second, and of the vertical axis, in metres per second."""


class _Points(NamedTuple):
    """Indices of the windows of a subject's coverage that are drawn, and of the clips that have their own colours."""

    windows: NDArray[np.int64]
    named: list[int]


def draw_points(subjects: Sequence[Subject], _trial: str | None, options: FigureOptions) -> Sketch:
    """Draw a point for each window of one second; of more than `MOST_POINTS` windows, only some at even intervals."""
    chosen = _choose(subjects, min(options.most_clips, MOST_PANELS))
    limits = _limits(subjects)
    sketched = (
        _draw_small(subjects, chosen, limits)
        if _named(subjects, chosen)[MOST_COLOURED:]
        else _draw_together(subjects, chosen, limits)
    )
    return Sketch(sketched, {"points": _table(subjects, chosen)}, _caption(subjects, chosen, limits))


def _named(subjects: Sequence[Subject], chosen: Sequence[_Points]) -> list[tuple[str, str]]:
    """Return the uid and the name of each clip with its own colour or panel, those with most data first."""
    found = {
        subject.result.clips[clip].uid: subject.result.clips[clip].name
        for subject, points in reversed(list(zip(subjects, chosen, strict=True)))
        for clip in points.named
    }
    order = {subject.result.clips[clip].uid: place for subject, points in zip(subjects, chosen, strict=True)
             for place, clip in enumerate(points.named)}  # fmt: skip
    return sorted(found.items(), key=lambda item: (order[item[0]], item[0]))


def _draw_together(subjects: Sequence[Subject], chosen: Sequence[_Points], limits: Limits) -> Figure:
    """Draw a panel for each subject, in which clips have colours and markers."""
    width = 9.6 if len(subjects) > 1 else 8.6
    keys = 2.5
    each = (width - 0.75 - keys - 0.45 * (len(subjects) - 1)) / len(subjects)
    figure = new_figure(width, 4.9 if len(subjects) > 1 else 4.65)
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
    return figure


def _draw_small(subjects: Sequence[Subject], chosen: Sequence[_Points], limits: Limits) -> Figure:
    """Draw a small panel for each of the clips with most data, and one panel for all other clips.

    The points of a panel are drawn in colour on top of the grey points of all clips.
    """
    named = _named(subjects, chosen)
    rest = max(_other_clips(subject, points) for subject, points in zip(subjects, chosen, strict=True))
    labels = labels_of([name for _, name in named], SMALL_NAME)
    tiles: list[tuple[str, str | None]] = [(label, uid) for label, (uid, _) in zip(labels, named, strict=True)]
    tiles += [(counted(rest, "other clip"), None)] * bool(rest)
    bands = -(-len(tiles) // ACROSS)
    width, height, gap, between, top = 1.58, 1.18, 0.16, 0.32, 0.35 if len(subjects) == 1 else 0.62
    bottom = 0.62
    figure = new_figure(0.72 + ACROSS * (width + gap), bottom + bands * (height + between) - between + top)
    for number, (label, uid) in enumerate(tiles):
        band, column = divmod(number, ACROSS)
        place = Place(0.66 + column * (width + gap), bottom + (bands - 1 - band) * (height + between), width, height)
        panel = add_panel(figure, place)
        panel.set_title(plain(label), fontsize=SMALL, color=INK, loc="left", parse_math=False, pad=4)
        panel.tick_params(labelleft=column == 0, labelbottom=number + ACROSS >= len(tiles))
        _draw_tile(panel, subjects, chosen, uid)
        panel.set(xlim=limits[0], ylim=limits[1])
        panel.locator_params(nbins=4)
    figure.text(0.5, 0.16 / figure.get_figheight(), TURN_RATE, ha="center", fontsize=TEXT, color=INK)
    figure.text(0.2 / figure.get_figwidth(), 0.5, SPEED, va="center", rotation=90, fontsize=TEXT, color=INK)
    if len(subjects) > 1:
        keys = [_key(COLOURS[number], "o") for number in range(len(subjects))]
        add_keys(figure.axes[0], handles=keys, labels=[plain(subject.label) for subject in subjects], loc="lower left",
                 bbox_to_anchor=(-0.05, 1.13), ncols=len(subjects), handletextpad=0.2)  # fmt: skip
    return figure


def _draw_tile(panel: Axes, subjects: Sequence[Subject], chosen: Sequence[_Points], uid: str | None) -> None:
    """Draw windows in colour, on top of some windows of all clips in grey.

    The coloured windows are those of the clip `uid` or, if `uid` is None, those of all clips without their own panel.
    """
    for number, (subject, points) in enumerate(zip(subjects, chosen, strict=True)):
        coverage = subject.result.coverage
        step = max(1, -(-len(points.windows) // BEHIND))
        behind = points.windows[::step]
        turn_deg_s, speed = np.degrees(coverage.turn_rate_rad_s), coverage.speed_m_s
        grey: dict[str, Any] = {"s": 2, "c": REFERENCE, "alpha": 0.4, "lw": 0, "rasterized": True, "zorder": 2}
        panel.scatter(turn_deg_s[behind], speed[behind], **grey)
        clips = coverage.clip[points.windows]
        uids = [clip.uid for clip in subject.result.clips]
        mine = ~np.isin(clips, points.named) if uid is None else clips == (uids.index(uid) if uid in uids else -1)
        own = points.windows[mine]
        look: dict[str, Any] = {"s": 5, "c": COLOURS[number], "alpha": 0.8, "lw": 0, "zorder": 3}
        panel.scatter(turn_deg_s[own], speed[own], rasterized=len(own) > BEHIND, **look)


def _key(colour: str, marker: str, size: float = 5.0) -> Line2D:
    from matplotlib.lines import Line2D

    return Line2D([], [], ls="", color=colour, marker=marker, markersize=size, markeredgewidth=0)


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


def _limits(subjects: Sequence[Subject]) -> Limits:
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
        style = styles.setdefault(subject.result.clips[clip].uid, len(styles))
        panel.scatter(turn[mine], speed[mine], s=13, alpha=0.75, lw=0, rasterized=as_image, zorder=3, **_look(style))


def _look(style: int) -> dict[str, Any]:
    return {"c": COLOURS[style], "marker": MARKERS[style]}


def _draw_keys(panel: Axes, subjects: Sequence[Subject], chosen: Sequence[_Points], styles: dict[str, int]) -> None:
    keys, labels = [], []
    named = _named(subjects, chosen)
    names = dict(zip((uid for uid, _ in named), labels_of([name for _, name in named]), strict=True))
    for uid, style in styles.items():
        look = _look(style)
        keys.append(_key(look["c"], look["marker"]))
        labels.append(plain(names[uid]))
    rest = max(_other_clips(subject, points) for subject, points in zip(subjects, chosen, strict=True))
    if rest:
        keys.append(_key(REFERENCE, "o", 3.5))
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
    limits: Limits,
) -> str:
    parts = []
    for subject, points in zip(subjects, chosen, strict=True):
        held, total = len(np.unique(subject.result.coverage.clip)), len(subject.result.coverage.clip)
        drawn = "all of them" if len(points.windows) == total else f"{len(points.windows):,} of them, evenly spaced"
        turn, speed = np.degrees(subject.result.coverage.turn_rate_rad_s), subject.result.coverage.speed_m_s
        beyond = int(np.count_nonzero((np.abs(turn) > limits[0][1]) | (speed > limits[1][1])))
        outside = f"; {beyond:,} are outside the axes" if beyond else ""
        parts.append(f"{subject.prefix}{total:,} windows from {counted(held, 'clip')}, {drawn} drawn{outside}.")
    many = len(_named(subjects, chosen)) > MOST_COLOURED
    panels = " Each panel shows one clip, with the windows of all clips in grey." if many else ""
    return f"Each point shows the mean speed and turn rate of a window of one second.{panels} {' '.join(parts)}"
