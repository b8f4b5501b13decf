"""Picture of the difference between two revisions of a motion or of an annotation.

The picture of motions shows corresponding frames, changed rotations over time, and the paths of the root. The picture
of annotations shows the segments and keyframes.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from marey_reports.drawing.paper import (
    COLOURS,
    HEADING,
    INK,
    MORE_IS_WORSE,
    QUIET,
    REFERENCE,
    SMALL,
    Place,
    add_colour_bar,
    add_keys,
    add_panel,
    labels_of,
    new_figure,
    nice_ceiling,
    plain,
    shortened,
    to_png,
    to_svg,
    write,
)
from marey_schemas.documents.annotations import Annotation
from marey_schemas.documents.differences import Difference, DifferencePlot, MotionDifference

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FileType = Literal["png", "svg"]

MOST_JOINTS = 40
"""Greatest number of joints in the picture; the joints with the largest changes are drawn."""
LEAST_DEG = 0.1
"""Change of a rotation in degrees that a joint must exceed to be drawn."""
BEFORE, AFTER = REFERENCE, COLOURS[0]
REMOVED, INSERTED = COLOURS[1], COLOURS[2]
MATCHED = "#c9ced8"
MOST_LABELS = 60
"""Greatest number of segments, or of keyframes, of an annotation whose labels are written in the picture."""

UNKNOWN = "#c4e3dc"
"""Background colour of frames that correspond to no frame of the other revision."""

MOST_SIGNS = 16
"""Greatest length of a keyframe's label, in characters; longer labels are shortened."""

_WIDTH, _LEFT, _TIMES, _PATHS = 12.8, 1.7, 6.2, 2.5
_ROW, _HIGHEST_ROW, _LEAST_ROWS, _ABOVE, _BELOW = 0.21, 0.36, 2.0, 2.35, 0.6
_UPPER, _LOWER = (0.74, 0.74, 1.0, 1.0), (0.0, 0.0, 0.26, 0.26)
"""Heights of the four corners of the upper bar, and of the lower bar, as shares of the height of the panel."""
_THINNEST, _NAME_WIDTH = 0.004, 0.16
"""Least width of a bar, and width of a text such as `12 removed`, as shares of the duration of the longer motion."""


def draw_difference(difference: Difference, file_type: FileType) -> bytes:
    """Draw the difference between two motions or two annotations.

    Parameters
    ----------
    difference : has `motion` and `plot`, or `annotations`; `plot` is computed only on request
    file_type : type of the file

    Returns
    -------
    bytes    the content of the file

    Raises
    ------
    ValueError    if the difference is not between two motions or annotations, or has a `motion` without `plot`
    """
    if difference.motion is not None and difference.plot is not None:
        figure = _draw_motions(difference, difference.motion, difference.plot)
    elif difference.annotations is not None:
        figure = _draw_annotations(difference, *difference.annotations)
    elif difference.motion is not None:
        raise ValueError("the difference lacks the values to draw; request it again with plot=True")
    else:
        raise ValueError("only differences between two motions or between two annotations can be drawn")
    return to_png(figure) if file_type == "png" else to_svg(figure, _title(difference)).encode()


def _title(difference: Difference) -> str:
    before, after = difference.before, difference.after
    if before.item == after.item:
        return f"{before.name}: revision {before.revision} → {after.revision}"
    return f"{before.name} revision {before.revision} → {after.name} revision {after.revision}"


def _draw_motions(difference: Difference, motion: MotionDifference, plot: DifferencePlot) -> Figure:
    largest = plot.rotation_deg.max(axis=0, initial=-1.0)
    order = np.argsort(-largest, kind="stable")
    shown = np.sort(order[:MOST_JOINTS][largest[order[:MOST_JOINTS]] > LEAST_DEG])
    rows = max(_LEAST_ROWS, _ROW * len(shown))
    figure = new_figure(_WIDTH, rows + _ABOVE + _BELOW)
    top = rows + _BELOW
    figure.text(0.25 / _WIDTH, 1.0 - 0.3 / (top + _ABOVE), plain(_title(difference)), fontsize=HEADING + 1.5, color=INK,
                va="center", fontweight="bold", parse_math=False)  # fmt: skip
    bars = add_panel(figure, Place(_LEFT, top + 0.8, _TIMES, 0.7), grid=False)
    bars.set_title("corresponding frames", fontsize=HEADING, color=INK, loc="left", fontweight="bold", pad=21)
    _draw_runs(bars, motion)
    height = min(rows, _HIGHEST_ROW * max(len(shown), 1))
    place = Place(_LEFT, top - height, _TIMES, height)
    heat = add_panel(figure, place, title="change of rotations", x="time in the later revision (s)", grid=False)
    _draw_changes(figure, heat, plot, shown, top)
    place = Place(_LEFT + _TIMES + 1.9, top + 1.45 - _PATHS, _PATHS, _PATHS)
    name = f"path of {motion.path.joint}" if motion.path is not None else "path"
    _draw_paths(add_panel(figure, place, title=f"{shortened(name, 26)}, from above", x="x (m)", y="z (m)"), plot)
    bars.set_xlim(0.0, max(motion.duration_s))
    heat.set_xlim(0.0, max(motion.duration_s))
    return figure


def _draw_runs(panel: Axes, motion: MotionDifference) -> None:
    """Draw both revisions as bars; grey areas connect frames that correspond to each other."""
    rates, longest_s = motion.frame_rate_hz, max(motion.duration_s)
    for run in motion.runs:
        old, new = (np.array(frames) / rate for frames, rate in zip((run.before, run.after), rates, strict=True))
        if run.change == "matched":
            panel.fill([*old, *old[::-1]], _UPPER, color=BEFORE, lw=0)
            panel.fill([*new, *new[::-1]], _LOWER, color=AFTER, lw=0)
            panel.fill([*old, *new[::-1]], [*_UPPER[:2], *_LOWER[2:]], color=MATCHED, lw=0)
            continue
        removed = run.change == "removed"
        (start, stop), bar, colour = (old, _UPPER, REMOVED) if removed else (new, _LOWER, INSERTED)
        stop = max(stop, start + _THINNEST * longest_s)
        panel.fill([start, stop, stop, start], bar, color=colour, lw=0, zorder=2)
    panel.set(ylim=(0.0, 1.0))
    panel.set_yticks([0.87, 0.13], [f"before, {motion.frames[0]:,}", f"after, {motion.frames[1]:,}"])
    panel.tick_params(axis="y", length=0, labelcolor=INK)
    panel.tick_params(axis="x", bottom=False, labelbottom=False)
    for spine in panel.spines.values():
        spine.set_visible(False)
    _name_runs(panel, motion)


def _name_runs(panel: Axes, motion: MotionDifference) -> None:
    """Write the numbers of removed frames above the bars and of inserted frames below, unless they would overlap."""
    width = _NAME_WIDTH * max(motion.duration_s)
    free = {"removed": 0.0, "inserted": 0.0}
    for run in motion.runs:
        if run.change == "matched":
            continue
        removed = run.change == "removed"
        start, stop = (one / motion.frame_rate_hz[not removed] for one in (run.before if removed else run.after))
        left = min(max((start + stop - width) / 2.0, 0.0), max(motion.duration_s) - width)
        if left < free[run.change]:
            continue
        free[run.change] = left + width
        count = (run.before[1] - run.before[0]) or (run.after[1] - run.after[0])
        place, side = (1.06, "bottom") if removed else (-0.06, "top")
        look = {"color": REMOVED if removed else INSERTED, "ha": "center", "va": side}
        write(panel, (left + width / 2.0, place), f"{count:,} {run.change}", **look)


def _draw_changes(figure: Figure, panel: Axes, plot: DifferencePlot, shown: NDArray[np.intp], top: float) -> None:
    """Draw the changes of the joints over time; frames without a match in the other revision are coloured `UNKNOWN`."""
    times = np.array(plot.frames) / plot.frame_rate_hz
    if not len(shown):
        panel.set_yticks([])
        write(
            panel,
            (0.5, 0.5),
            f"no rotation changed by more than {LEAST_DEG:g}°",
            transform=panel.transAxes,
            ha="center",
            color=QUIET,
        )
        return
    values = np.ma.masked_less(plot.rotation_deg[:, shown].T, 0.0)
    panel.fill_between(times[[0, -1]], 0, len(shown), color=UNKNOWN, lw=0)
    most = nice_ceiling(float(values.max()))
    mesh = panel.pcolormesh(times, np.arange(len(shown) + 1), values, cmap=MORE_IS_WORSE, vmin=0.0, vmax=most,
                            rasterized=True)  # fmt: skip
    panel.set_ylim(len(shown), 0)
    names = [plain(name) for name in labels_of([plot.joints[joint] for joint in shown], 22)]
    panel.set_yticks(np.arange(len(shown)) + 0.5, names, parse_math=False)
    panel.tick_params(axis="y", length=0, labelcolor=INK)
    height = min(top - _BELOW, 2.2)
    add_colour_bar(figure, mesh, Place(_LEFT + _TIMES + 0.12, top - height, 0.13, height), "change (°)")


def _draw_paths(panel: Axes, plot: DifferencePlot) -> None:
    styles = ((plot.path_before_m, BEFORE, "before", 3.0), (plot.path_after_m, AFTER, "after", 1.3))
    for path, colour, name, width in styles:
        panel.plot(path[:, 0], path[:, 1], color=colour, lw=width, label=f"{name} (dot: start)")
        panel.plot(*path[0], marker="o", ms=width + 4.0, color=colour, ls="none")
    both = np.concatenate((plot.path_before_m, plot.path_after_m))
    centre, side = (both.min(axis=0) + both.max(axis=0)) / 2.0, max(0.2, 1.1 * float(np.ptp(both, axis=0).max()))
    # Seen from above with z upwards, x points to the left.
    panel.set(xlim=(centre[0] + side / 2, centre[0] - side / 2), ylim=(centre[1] - side / 2, centre[1] + side / 2))
    panel.set_aspect("equal")
    add_keys(panel, loc="upper left", bbox_to_anchor=(-0.02, -0.17))


def _draw_annotations(difference: Difference, before: Annotation, after: Annotation) -> Figure:
    """Draw the segments and keyframes of two annotations in two rows, with a colour for each label."""
    labels = list(dict.fromkeys(one.label for layer in (before, after) for one in layer.segments))
    colours = {label: COLOURS[place % len(COLOURS)] for place, label in enumerate(labels)}
    figure = new_figure(_WIDTH, 2.6)
    panel = add_panel(figure, Place(0.9, 0.6, _WIDTH - 1.3, 1.35), title=_title(difference), x="frame", grid=False)
    end = max((frame for layer in (before, after) for frame in _last_frames(layer)), default=1)
    changed = difference.annotation.segments if difference.annotation is not None else ()
    rows = ((before, 1.0, {one.before for one in changed}), (after, 0.0, {one.after for one in changed}))
    for layer, bottom, edited in rows:
        for one in layer.segments:
            panel.broken_barh([(one.start, one.end - one.start)], (bottom + 0.16, 0.6), facecolor=colours[one.label],
                              alpha=0.85 if one in edited else 0.3, edgecolor="white", lw=0.8)  # fmt: skip
            longest = int((one.end - one.start) / end * 150)
            if longest > 2 and len(layer.segments) <= MOST_LABELS:
                middle = (one.start + one.end) / 2.0
                write(panel, (middle, bottom + 0.46), shortened(one.label, longest), ha="center", fontsize=SMALL)
        for mark in layer.keyframes:
            panel.plot([mark.frame + 0.5], [bottom + 0.84], marker="v", ms=5, color=INK)
            if len(layer.keyframes) <= MOST_LABELS:
                place = (mark.frame + 0.5 + 0.005 * end, bottom + 0.86)
                write(panel, place, shortened(mark.label, MOST_SIGNS), color=QUIET)
    panel.set(xlim=(0, end), ylim=(0.0, 2.0))
    panel.set_yticks([1.46, 0.46], ["before", "after"])
    panel.tick_params(axis="y", length=0, labelcolor=INK)
    return figure


def _last_frames(layer: Annotation) -> Sequence[int]:
    return [one.end for one in layer.segments] + [one.frame + 1 for one in layer.keyframes]
