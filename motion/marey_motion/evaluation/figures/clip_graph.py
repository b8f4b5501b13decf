"""Figure 10: clips as circles of frames, larger where they are popular, with lines for the transitions."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from marey_motion.evaluation.figures.clip_graph_layout import Circle, arrange
from marey_motion.evaluation.figures.drawn import Sketch
from marey_motion.evaluation.figures.paper import (
    COLOURS,
    HAIRLINE,
    QUIET,
    Place,
    add_panel,
    new_figure,
    shortened,
    write,
)
from marey_motion.evaluation.figures.subjects import FigureOptions, Subject, view_trial
from marey_motion.matching.record import Status

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

MOST_CLIPS = 24
MOST_LINES = 500
BOW = 0.45  # how far a line is drawn towards the middle of the ring
SMALLEST_DOT, LARGEST_DOT = 1.5, 90.0  # area in square points


class _Walk(NamedTuple):
    """What a subject displayed: ticks of every frame by clip, and (S, 3) rows left and entered and how often."""

    popularity: dict[str, Ints]
    names: dict[str, str]
    switches: Ints


class _Line(NamedTuple):
    """Transitions from a dot to a dot: uids, dots, how many."""

    source: str
    source_dot: int
    target: str
    target_dot: int
    count: int


def draw_clip_graph(subjects: Sequence[Subject], trial: str | None, options: FigureOptions) -> Sketch:
    """Of the suite, or of one trial; two subjects have the same clips in the same places."""
    walks = [_walk(subject, trial) for subject in subjects]
    uids = _most_used(walks, min(options.most_clips, MOST_CLIPS))
    frames = {uid: max(len(walk.popularity.get(uid, ())) for walk in walks) for uid in uids}
    links: dict[tuple[str, str], int] = {}
    for subject, walk in zip(subjects, walks, strict=True):
        _count_links(links, subject, walk)
    circles = arrange(frames, links)
    lines = [_lines(subject, walk, circles) for subject, walk in zip(subjects, walks, strict=True)]
    totals = [{uid: _per_dot(walk.popularity[uid], circle) for uid, circle in circles.items() if uid in walk.popularity}
              for walk in walks]  # fmt: skip
    most = max([1, *(int(total.max()) for each in totals for total in each.values())])
    side = 6.4 if len(subjects) == 1 else 4.6
    width = 8.2 if len(subjects) == 1 else 9.6
    figure = new_figure(width, side + 0.5)
    for number, subject in enumerate(subjects):
        share = width / len(subjects)
        panel = add_panel(figure, Place(number * share, 0.1, share, side), title="", grid=False)
        panel.axis("off")
        write(panel, (0.02, 1.02), subject.label, transform=panel.transAxes, fontsize=10.5, fontweight="bold")
        _frame(panel, circles, share / side)
        _draw_lines(panel, circles, lines[number])
        _draw_circles(panel, circles, totals[number], walks[number].names, most, options.logarithmic)
    tables = {"frames": _frame_table(subjects, totals, circles), "transitions": _line_table(subjects, lines, circles)}
    return Sketch(figure, tables, _caption(subjects, walks, circles, lines))


def _walk(subject: Subject, trial: str | None) -> _Walk:
    result = subject.result
    names = {clip.uid: clip.name for clip in result.clips}
    if trial is None:
        popularity = {result.clips[usage.clip].uid: usage.popularity for usage in result.usage}
        return _Walk(popularity, names, result.switches.reshape(-1, 3))
    record = view_trial(subject, trial).record
    ticks = np.bincount(record.rows, minlength=result.clips[-1].stop)
    entered = np.flatnonzero(record.status == Status.REPLACING)
    entered = entered[entered > 0]
    pairs = np.stack((record.rows[entered - 1], record.rows[entered]), axis=1).astype(np.int64)
    rows, counts = np.unique(pairs, axis=0, return_counts=True)
    return _Walk(
        {clip.uid: ticks[clip.start : clip.stop] for clip in result.clips},
        names,
        np.concatenate((rows, counts[:, None]), axis=1).reshape(-1, 3),
    )


def _most_used(walks: Sequence[_Walk], most: int) -> list[str]:
    totals: dict[str, int] = {}
    for walk in walks:
        for uid, popularity in walk.popularity.items():
            totals[uid] = totals.get(uid, 0) + int(popularity.sum())
    return sorted((uid for uid, total in totals.items() if total), key=lambda uid: (-totals[uid], uid))[:most]


def _count_links(links: dict[tuple[str, str], int], subject: Subject, walk: _Walk) -> None:
    if not len(walk.switches):
        return
    clips = subject.clips_of(walk.switches[:, :2])
    pairs, inverse = np.unique(clips, axis=0, return_inverse=True)
    counts = np.bincount(inverse.ravel(), weights=walk.switches[:, 2])
    for (source, target), count in zip(pairs.tolist(), counts, strict=True):
        key = subject.result.clips[source].uid, subject.result.clips[target].uid
        links[key] = links.get(key, 0) + int(count)


def _lines(subject: Subject, walk: _Walk, circles: dict[str, Circle]) -> list[_Line]:
    """The transitions between the circles, those from dot to dot as one; the most frequent `MOST_LINES`."""
    clips = subject.clips_of(walk.switches[:, :2])
    found: dict[tuple[str, int, str, int], int] = {}
    for (left, entered, count), (source, target) in zip(walk.switches.tolist(), clips.tolist(), strict=True):
        first, second = subject.result.clips[source], subject.result.clips[target]
        if first.uid in circles and second.uid in circles:
            key = (
                first.uid, int(circles[first.uid].dot_of(np.int64(left - first.start))),
                second.uid, int(circles[second.uid].dot_of(np.int64(entered - second.start))),
            )  # fmt: skip
            found[key] = found.get(key, 0) + count
    order = sorted(found.items(), key=lambda item: (-item[1], item[0]))
    return [_Line(*key, count) for key, count in order[:MOST_LINES]]


def _per_dot(popularity: Ints, circle: Circle) -> Ints:
    dots = circle.dot_of(np.arange(len(popularity)))
    return np.bincount(dots, weights=popularity, minlength=circle.dots).astype(np.int64)


def _frame(panel: Axes, circles: dict[str, Circle], aspect: float) -> None:
    """Limits that hold all circles and their names, at one scale in both directions."""
    reach = max([1.0, *(float(np.linalg.norm(circle.centre)) + circle.radius for circle in circles.values())])
    high = 1.22 * reach
    across = max(high * aspect, 1.0)
    if aspect < 1.25:
        across, high = 1.55 * reach, 1.55 * reach / aspect
    panel.set(xlim=(-across, across), ylim=(-high, high))


def _draw_lines(panel: Axes, circles: dict[str, Circle], lines: Sequence[_Line]) -> None:
    """Each in the colour of the clip it leaves; thicker and fuller where it was taken often."""
    from matplotlib.collections import PathCollection
    from matplotlib.path import Path

    if not lines:
        return
    colour_of = {uid: COLOURS[number % len(COLOURS)] for number, uid in enumerate(circles)}
    most = max(line.count for line in lines)
    codes = [Path.MOVETO, Path.CURVE3, Path.CURVE3]
    paths, colours, widths = [], [], []
    for line in reversed(lines):
        first = circles[line.source].place_of(np.int64(line.source_dot))
        last = circles[line.target].place_of(np.int64(line.target_dot))
        same = line.source == line.target
        middle = circles[line.source].centre if same else np.zeros(2)
        bend = (1.0 - BOW) * 0.5 * (first + last) + BOW * middle
        paths.append(Path(np.stack((first, bend, last)), codes))
        strength = (line.count / most) ** 0.5
        colours.append((colour_of[line.source], 0.15 + 0.65 * strength))
        widths.append(0.5 + 1.6 * strength)
    panel.add_collection(PathCollection(paths, facecolors="none", edgecolors=colours, linewidths=widths, zorder=2))


def _draw_circles(
    panel: Axes,
    circles: dict[str, Circle],
    totals: dict[str, Ints],
    names: dict[str, str],
    most: int,
    logarithmic: bool,
) -> None:
    from matplotlib.patches import Arc

    many = len(circles) > 1
    for number, (uid, circle) in enumerate(circles.items()):
        start = 90 - 360 * (1 - 0.035)
        size = 2 * circle.radius
        known = uid in totals
        outline = Arc(circle.centre, size, size, theta1=start, theta2=90 - 360 * 0.035, color=HAIRLINE, lw=1.2)
        outline.set_linestyle("-" if known else (0, (2, 3)))
        panel.add_patch(outline)
        if known:
            total = totals[uid]
            used = np.flatnonzero(total)
            share = np.log1p(total[used]) / np.log1p(most) if logarithmic else total[used] / most
            sizes = SMALLEST_DOT + (LARGEST_DOT - SMALLEST_DOT) * share
            colour = COLOURS[number % len(COLOURS)]
            panel.scatter(*circle.place_of(used).T, s=sizes, color=colour, lw=0, alpha=0.9, zorder=3)
        away = circle.centre / np.linalg.norm(circle.centre) if many else np.array([0.0, 1.0])
        place = circle.centre + (circle.radius + 0.16) * away
        side = "left" if away[0] > 0.25 else "right" if away[0] < -0.25 else "center"
        level = "bottom" if away[1] > 0.7 else "top" if away[1] < -0.7 else "center"
        name = shortened(names.get(uid, "not in this one"), 20)
        write(panel, (float(place[0]), float(place[1])), name, ha=side, va=level, color=QUIET, zorder=5)


def _frame_table(
    subjects: Sequence[Subject], totals: Sequence[dict[str, Ints]], circles: dict[str, Circle]
) -> dict[str, list[object]]:
    table: dict[str, list[object]] = {name: [] for name in ("dataset", "clip", "first_frame", "stop_frame", "ticks")}
    for subject, each in zip(subjects, totals, strict=True):
        for uid, total in each.items():
            first = _first_frames(circles[uid])
            table["dataset"] += [subject.label] * len(total)
            table["clip"] += [uid] * len(total)
            table["first_frame"] += first[:-1].tolist()
            table["stop_frame"] += first[1:].tolist()
            table["ticks"] += total.tolist()
    return table


def _first_frames(circle: Circle) -> Ints:
    """(dots + 1,) first frame of each dot, and the number of frames."""
    return np.asarray(-(-np.arange(circle.dots + 1) * circle.frames // circle.dots), dtype=np.int64)


def _line_table(
    subjects: Sequence[Subject], lines: Sequence[Sequence[_Line]], circles: dict[str, Circle]
) -> dict[str, list[object]]:
    names = ("dataset", "from_clip", "from_frame", "to_clip", "to_frame", "count")
    table: dict[str, list[object]] = {name: [] for name in names}
    for subject, each in zip(subjects, lines, strict=True):
        for line in each:
            left = int(_first_frames(circles[line.source])[line.source_dot])
            entered = int(_first_frames(circles[line.target])[line.target_dot])
            row = (subject.label, line.source, left, line.target, entered, line.count)
            for name, value in zip(names, row, strict=True):
                table[name].append(value)
    return table


def _caption(
    subjects: Sequence[Subject],
    walks: Sequence[_Walk],
    circles: dict[str, Circle],
    lines: Sequence[Sequence[_Line]],
) -> str:
    parts = []
    for subject, walk, each in zip(subjects, walks, lines, strict=True):
        made, drawn = int(walk.switches[:, 2].sum()), sum(line.count for line in each)
        used = sum(1 for popularity in walk.popularity.values() if popularity.any())
        name = f"{subject.label}: " if subject.label else ""
        parts.append(f"{name}{min(len(circles), used)} of {used} used clips, {drawn:,} of {made:,} transitions drawn.")
    return (
        "Each circle is a clip that runs clockwise from the gap above; a dot is larger the more its frames were shown. "
        f"A line is a transition, in the colour of the clip it leaves. {' '.join(parts)}"
    )
