"""Figure 10 of Abichequer Sangalli et al. (2022): the displayed clips, and the transitions between them.

Each clip is a circle of dots, one dot per range of frames. Transitions between clips are lines. Dots are larger for
frames that are displayed more often.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from marey_motion.arrays import Ints
from marey_motion.evaluation.relevance import clips_of_rows
from marey_reports.drawing.drawn import Sketch
from marey_reports.drawing.paper import (
    HEADING,
    QUIET,
    REFERENCE,
    Place,
    add_panel,
    distinct_colours,
    labels_of,
    new_figure,
    write,
)
from marey_reports.evaluation.figures.clip_graph_layout import OPEN, Circle, arrange
from marey_reports.evaluation.figures.subjects import FigureOptions, Subject

if TYPE_CHECKING:
    from matplotlib.axes import Axes


MOST_CLIPS = 24
MOST_LINES = 400
BOW = 0.45  # how far a line is drawn towards the middle of the ring
SIZES, LARGEST_DOT = 8, 90.0  # number of sizes of dots; area in square points
LONGEST_NAMES, LETTER_IN = (18, 13), 0.066  # characters of a name with one panel and with two; width of a character
ABSENT = "(absent)"
RADIAL_NAMES = 8  # more names than this are written radially, so that they do not overlap


class _Line(NamedTuple):
    """Jumps from one range of frames to another: uids of both clips, middle frames of both ranges, number of jumps."""

    source: str
    left: int
    target: str
    entered: int
    times: int


def draw_clip_graph(subjects: Sequence[Subject], trial: str | None, options: FigureOptions) -> Sketch:
    """Draw the graph of clips for the suite or one trial; two subjects have their clips at the same places."""
    popularity = [_popularity(subject, trial) for subject in subjects]
    switches = [subject.switches(trial) for subject in subjects]
    uids = _most_used(popularity, min(options.most_clips, MOST_CLIPS))
    circles = arrange(
        {uid: max(len(each.get(uid, ())) for each in popularity) for uid in uids}, _links(subjects, switches)
    )
    lines = [_lines(subject, each, circles) for subject, each in zip(subjects, switches, strict=True)]
    dots = [{uid: _per_dot(each[uid], circles[uid]) for uid in uids if uid in each} for each in popularity]
    most = max([1, *(int(total.max()) for each in dots for total in each.values())])
    width, height = (8.6, 6.6) if len(subjects) == 1 else (9.6, 4.7)
    figure = new_figure(width, height + 0.3 * (len(subjects) > 1))
    across = width / len(subjects)
    names = _labels(subjects, uids, LONGEST_NAMES[len(subjects) - 1])
    longest = max([0, *(len(each.get(uid, ABSENT)) for each in names for uid in uids)])
    for number, subject in enumerate(subjects):
        panel = add_panel(figure, Place(number * across, 0.0, across, height), grid=False)
        panel.axis("off")
        write(panel, (0.03, 1.01), subject.label, transform=panel.transAxes, fontsize=HEADING, fontweight="bold")
        _fit(panel, circles, longest, (across, height))
        _draw_lines(panel, circles, lines[number])
        _draw_dots(panel, circles, dots[number], most, options.logarithmic)
        _draw_rings(panel, circles, names[number])
    tables = {"frames": _frame_table(subjects, dots, circles), "transitions": _line_table(subjects, lines)}
    return Sketch(figure, tables, _caption(subjects, popularity, switches, circles, lines))


def _popularity(subject: Subject, trial: str | None) -> dict[str, Ints]:
    """Count, for each clip by uid, the ticks at which each of its frames was displayed."""
    return {subject.result.clips[usage.clip].uid: usage.popularity for usage in subject.usage(trial)}


def _most_used(popularity: Sequence[dict[str, Ints]], most: int) -> list[str]:
    totals: dict[str, int] = {}
    for each in popularity:
        for uid, ticks in each.items():
            totals[uid] = totals.get(uid, 0) + int(ticks.sum())
    return sorted((uid for uid, total in totals.items() if total), key=lambda uid: (-totals[uid], uid))[:most]


def _links(subjects: Sequence[Subject], switches: Sequence[Ints]) -> dict[tuple[str, str], int]:
    """Count the transitions from clip to clip, by the uids of both clips."""
    links: dict[tuple[str, str], int] = {}
    for subject, each in zip(subjects, switches, strict=True):
        clips = subject.result.clips
        pairs, inverse = np.unique(clips_of_rows(clips, each[:, :2]), axis=0, return_inverse=True)
        counts = np.bincount(inverse.ravel(), weights=each[:, 2], minlength=len(pairs))
        for (source, target), count in zip(pairs.tolist(), counts.tolist(), strict=True):
            key = clips[source].uid, clips[target].uid
            links[key] = links.get(key, 0) + int(count)
    return links


def _lines(subject: Subject, switches: Ints, circles: dict[str, Circle]) -> list[_Line]:
    """Combine the jumps between clips into lines, the line with most jumps first.

    All jumps from one range of frames to another range form one line. Each range is one dot of a circle, or several
    neighbouring dots if there would otherwise be more than `MOST_LINES` lines.
    """
    clips = subject.result.clips
    owners = clips_of_rows(clips, switches[:, :2])
    shown = np.array([clip.uid in circles for clip in clips], dtype=np.bool_)
    kept = shown[owners].all(axis=1)
    starts = np.array([clip.start for clip in clips], dtype=np.int64)
    owners, frames, counts = owners[kept], (switches[:, :2] - starts[owners])[kept], switches[kept, 2]
    factor = 1
    while True:
        coarse = {index: circles[clip.uid].coarser(factor) for index, clip in enumerate(clips) if shown[index]}
        dots = np.zeros_like(frames)
        for index, circle in coarse.items():
            mine = owners == index
            dots[mine] = circle.dot_of(frames[mine])
        keys, inverse = np.unique(np.concatenate((owners, dots), axis=1), axis=0, return_inverse=True)
        if len(keys) <= MOST_LINES or all(circle.dots == 1 for circle in coarse.values()):
            break
        factor *= 2
    totals = np.bincount(inverse.ravel(), weights=counts, minlength=len(keys)).astype(np.int64)
    order = np.lexsort((*keys.T[::-1], -totals))[:MOST_LINES]
    return [
        _Line(clips[a].uid, int(coarse[a].middle_of(p)), clips[b].uid, int(coarse[b].middle_of(q)), int(totals[index]))
        for index, (a, b, p, q) in zip(order, keys[order].tolist(), strict=True)
    ]


def _per_dot(popularity: Ints, circle: Circle) -> Ints:
    dots = circle.dot_of(np.arange(len(popularity)))
    return np.bincount(dots, weights=popularity, minlength=circle.dots).astype(np.int64)


def _fit(panel: Axes, circles: dict[str, Circle], longest_name: int, size_in: tuple[float, float]) -> None:
    """Set axis limits that contain all circles and their names, with the same scale in both directions."""
    reach = max([1.0, *(float(np.linalg.norm(circle.centre)) + circle.radius for circle in circles.values())])
    aside = 0.2 + longest_name * LETTER_IN
    above = aside if len(circles) > RADIAL_NAMES else 0.4
    unit = min(0.5 * size_in[0] - aside, 0.5 * size_in[1] - above) / reach  # inches
    panel.set(xlim=(-0.5 * size_in[0] / unit, 0.5 * size_in[0] / unit))
    panel.set(ylim=(-0.5 * size_in[1] / unit, 0.5 * size_in[1] / unit))


def _draw_lines(panel: Axes, circles: dict[str, Circle], lines: Sequence[_Line]) -> None:
    """Draw lines in the colour of the clip that the jump leaves; more frequent jumps have thicker and darker lines."""
    from matplotlib.collections import PathCollection
    from matplotlib.path import Path

    colours = _colours(circles)
    most = max([1, *(line.times for line in lines)])
    codes = [Path.MOVETO, Path.CURVE3, Path.CURVE3]
    paths, edges, widths = [], [], []
    for line in reversed(lines):
        first, last = circles[line.source].place_of(line.left), circles[line.target].place_of(line.entered)
        middle = circles[line.source].centre if line.source == line.target else np.zeros(2)
        paths.append(Path(np.stack((first, (1.0 - BOW) * 0.5 * (first + last) + BOW * middle, last)), codes))
        strength = (line.times / most) ** 0.5
        edges.append((colours[line.source], round(0.15 + 0.65 * strength, 2)))
        widths.append(round(0.4 + 2.2 * strength, 1))
    panel.add_collection(PathCollection(paths, facecolors="none", edgecolors=edges, linewidths=widths, zorder=2))


def _draw_dots(panel: Axes, circles: dict[str, Circle], dots: dict[str, Ints], most: int, logarithmic: bool) -> None:
    """Draw a dot for each displayed range of frames. Few sizes are used, because an SVG stores a shape per size."""
    colours = _colours(circles)
    places, levels, looks = [np.empty((0, 2))], [np.empty(0, np.int64)], []
    for uid, total in dots.items():
        used = np.flatnonzero(total)
        share = np.log1p(total[used]) / np.log1p(most) if logarithmic else total[used] / most
        places.append(circles[uid].place_of(circles[uid].middle_of(used)))
        levels.append(np.ceil(SIZES * share).astype(np.int64))
        looks += [colours[uid]] * len(used)
    place, level, look = np.concatenate(places), np.concatenate(levels), np.array(looks)
    for size in range(1, SIZES + 1):
        mine = level == size
        if mine.any():
            area = LARGEST_DOT * size / SIZES
            panel.scatter(place[mine, 0], place[mine, 1], s=area, c=look[mine], lw=0, alpha=0.9, zorder=3)


def _labels(subjects: Sequence[Subject], uids: Collection[str], longest: int) -> list[dict[str, str]]:
    """Return the labels of clips by uid for each subject, at most `longest` characters long, equal for all subjects."""
    held = [{clip.uid: clip.name for clip in subject.result.clips if clip.uid in uids} for subject in subjects]
    names = {uid: name for each in reversed(held) for uid, name in each.items()}
    labels = dict(zip(names, labels_of(list(names.values()), longest), strict=True))
    return [{uid: labels[uid] for uid in each} for each in held]


def _draw_rings(panel: Axes, circles: dict[str, Circle], names: dict[str, str]) -> None:
    """Draw the outline of each clip, open at the top, with its name outside.

    The outline is dotted if the evaluation does not contain the clip.
    """
    from matplotlib.patches import Arc

    for uid, circle in circles.items():
        ends = 90 - 180 * OPEN
        centre = float(circle.centre[0]), float(circle.centre[1])
        ring = Arc(centre, 2 * circle.radius, 2 * circle.radius, theta1=ends + 360 * OPEN, theta2=ends + 360,
                   color=REFERENCE, lw=0.7, ls="-" if uid in names else (0, (1, 3)))  # fmt: skip
        panel.add_patch(ring)
        distance = float(np.linalg.norm(circle.centre))
        away = circle.centre / distance if distance else np.array([0.0, 1.0])
        x, y = circle.centre + (circle.radius + 0.16) * away
        look: dict[str, Any] = {"color": QUIET, "zorder": 5}
        if len(circles) > RADIAL_NAMES:
            angle = float(np.degrees(np.arctan2(away[1], away[0])))
            left = abs(angle) > 90
            look |= {"rotation": angle + 180 * left, "rotation_mode": "anchor", "ha": "right" if left else "left"}
        else:
            look["ha"] = "left" if away[0] > 0.3 else "right" if away[0] < -0.3 else "center"
            look["va"] = "bottom" if away[1] > 0.3 else "top" if away[1] < -0.3 else "center"
        write(panel, (float(x), float(y)), names.get(uid, ABSENT), **look)


def _colours(circles: dict[str, Circle]) -> dict[str, str]:
    return dict(zip(circles, distinct_colours(len(circles)), strict=True))


def _frame_table(
    subjects: Sequence[Subject], dots: Sequence[dict[str, Ints]], circles: dict[str, Circle]
) -> dict[str, list[object]]:
    table: dict[str, list[object]] = {name: [] for name in ("dataset", "clip", "first_frame", "stop_frame", "ticks")}
    for subject, each in zip(subjects, dots, strict=True):
        for uid, total in each.items():
            bounds = circles[uid].bounds
            table["dataset"] += [subject.label] * len(total)
            table["clip"] += [uid] * len(total)
            table["first_frame"] += bounds[:-1].tolist()
            table["stop_frame"] += bounds[1:].tolist()
            table["ticks"] += total.tolist()
    return table


def _line_table(subjects: Sequence[Subject], lines: Sequence[Sequence[_Line]]) -> dict[str, list[object]]:
    names = ("dataset", "from_clip", "from_frame", "to_clip", "to_frame", "count")
    rows = [(subject.label, *line) for subject, each in zip(subjects, lines, strict=True) for line in each]
    return {name: [row[column] for row in rows] for column, name in enumerate(names)}


def _caption(
    subjects: Sequence[Subject],
    popularity: Sequence[dict[str, Ints]],
    switches: Sequence[Ints],
    circles: dict[str, Circle],
    lines: Sequence[Sequence[_Line]],
) -> str:
    parts = []
    for subject, ticks, each, drawn in zip(subjects, popularity, switches, lines, strict=True):
        used = [uid for uid, own in ticks.items() if own.any()]
        shown = sum(1 for uid in used if uid in circles)
        jumps = f"{sum(line.times for line in drawn):,} of {int(each[:, 2].sum()):,} jumps"
        parts.append(f"{subject.prefix}{shown} of {len(used)} used clips and {jumps} between frames drawn.")
    return (
        "Each circle is a clip, which runs clockwise from the gap at the top; dots are larger for frames that were "
        f"displayed more often. Each line is a jump, in the colour of the clip where it starts. {' '.join(parts)}"
    )
