"""Picture of a difference: which frames correspond, rotations over time, paths of the root, and segments."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Literal

import numpy as np

from marey_reports.drawing.paper import (
    COLOURS,
    HAIRLINE,
    HEADING,
    INK,
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
    warm_colours,
    write,
)
from marey_schemas.documents.annotations import Annotation
from marey_schemas.documents.differences import Difference, DifferencePlot, MotionDifference

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FileType = Literal["png", "svg"]

MOST_JOINTS = 40
"""Most joints in the picture: those with the largest changes."""
LEAST_DEG = 0.01
"""Least change of a joint that is drawn."""
BEFORE, AFTER = REFERENCE, COLOURS[0]
REMOVED, INSERTED = COLOURS[1], COLOURS[2]
MATCHED = "#c9ced8"
MOST_LABELS = 60
"""Most segments of a row whose labels are written."""

_WIDTH, _LEFT, _TIMES, _PATHS = 12.6, 1.7, 6.1, 2.9
_ROW = 0.21


def draw_difference(difference: Difference, file_type: FileType) -> bytes:
    """Draw a difference between motions or annotations that was requested with values to draw.

    Parameters
    ----------
    difference : with `plot` or `annotations`
    file_type : type of the file

    Returns
    -------
    bytes    the content of the file

    Raises
    ------
    ValueError    if the difference has nothing to draw
    """
    if difference.motion is not None and difference.plot is not None:
        figure = _draw_motions(difference, difference.motion, difference.plot)
    elif difference.annotations is not None:
        figure = _draw_annotations(difference, *difference.annotations)
    else:
        raise ValueError("only differences between motions and between annotations have a picture")
    return to_png(figure) if file_type == "png" else to_svg(figure, _title(difference)).encode()


def _title(difference: Difference) -> str:
    before, after = difference.before, difference.after
    if before.item == after.item:
        return f"{before.name}: revision {before.revision} → {after.revision}"
    return f"{before.name} revision {before.revision} → {after.name} revision {after.revision}"


def _draw_motions(difference: Difference, motion: MotionDifference, plot: DifferencePlot) -> Figure:
    largest = plot.rotation_deg.max(axis=0, initial=-1.0)
    order = np.argsort(-largest, kind="stable")
    shown = np.sort([joint for joint in order[:MOST_JOINTS].tolist() if largest[joint] > LEAST_DEG])
    height = max(2.6, _ROW * len(shown))
    figure = new_figure(_WIDTH, height + 2.9)
    figure.text(0.02, 1.0 - 0.25 / (height + 2.9), plain(_title(difference)), fontsize=HEADING + 1.5, color=INK,
                va="center", fontweight="bold", parse_math=False)  # fmt: skip
    _draw_runs(add_panel(figure, Place(_LEFT, height + 1.35, _TIMES, 0.75), title="frames", grid=False), motion)
    heat = add_panel(
        figure, Place(_LEFT, 0.55, _TIMES, height), title="change of rotations", x="time after (s)", grid=False
    )
    _draw_changes(figure, heat, plot, shown.astype(np.int64), height)
    paths = add_panel(
        figure, Place(_LEFT + _TIMES + 1.75, 0.55, _PATHS, _PATHS), title="path of the root, from above", x="x (m)",
        y="z (m)",
    )  # fmt: skip
    _draw_paths(paths, plot)
    return figure


def _draw_runs(panel: Axes, motion: MotionDifference) -> None:
    """Draw both revisions as bars; grey areas connect the frames that correspond."""
    rates = motion.frame_rate_hz
    for run in motion.runs:
        old, new = (np.array(frames) / rate for frames, rate in zip((run.before, run.after), rates, strict=True))
        if run.change == "matched":
            panel.fill([*old, *old[::-1]], [0.74, 0.74, 1.0, 1.0], color=BEFORE, lw=0)
            panel.fill([*new, *new[::-1]], [0.0, 0.0, 0.26, 0.26], color=AFTER, lw=0)
            panel.fill([*old, *new[::-1]], [0.74, 0.74, 0.26, 0.26], color=MATCHED, lw=0, alpha=0.6)
        elif run.change == "removed":
            panel.fill([*old, *old[::-1]], [0.74, 0.74, 1.0, 1.0], color=REMOVED, lw=0)
            _name_run(panel, f"{run.before[1] - run.before[0]} removed", float(old.mean()), 1.02, "bottom", REMOVED)
        else:
            panel.fill([*new, *new[::-1]], [0.0, 0.0, 0.26, 0.26], color=INSERTED, lw=0)
            _name_run(panel, f"{run.after[1] - run.after[0]} inserted", float(new.mean()), -0.02, "top", INSERTED)
    panel.set(xlim=(0.0, max(motion.duration_s)), ylim=(0.0, 1.0))
    panel.set_yticks([0.87, 0.13], [f"before ({motion.frames[0]:,})", f"after ({motion.frames[1]:,})"])
    panel.tick_params(axis="y", length=0, labelcolor=INK)
    panel.tick_params(axis="x", bottom=False, labelbottom=False)
    for spine in panel.spines.values():
        spine.set_visible(False)


def _name_run(panel: Axes, text: str, at: float, y: float, side: str, colour: str) -> None:
    write(panel, (at, y), text, color=colour, ha="center", va=side)


def _draw_changes(figure: Figure, panel: Axes, plot: DifferencePlot, shown: np.ndarray, height: float) -> None:
    """Draw the changes of the joints over time; where no frame corresponds, the page is grey."""
    times = np.array(plot.frames) / plot.frame_rate_hz
    panel.set_facecolor(HAIRLINE)
    if not len(shown):
        panel.set(xlim=(times[0], times[-1]), yticks=[])
        write(panel, (0.5, 0.5), "no rotation changed", transform=panel.transAxes, ha="center", color=QUIET)
        return
    values = np.ma.masked_less(plot.rotation_deg[:, shown].T, 0.0)
    top = nice_ceiling(float(values.max()))
    mesh = panel.pcolormesh(times, np.arange(len(shown) + 1), values, cmap=warm_colours(), vmin=0.0, vmax=top,
                            rasterized=True)  # fmt: skip
    panel.invert_yaxis()
    names = [plain(name) for name in labels_of([plot.joints[joint] for joint in shown], 22)]
    panel.set_yticks(np.arange(len(shown)) + 0.5, names, parse_math=False)
    panel.tick_params(axis="y", length=0, labelcolor=INK)
    place = Place(_LEFT + _TIMES + 0.12, 0.55, 0.13, min(height, 2.6))
    add_colour_bar(figure, mesh, place, "change (°)")


def _draw_paths(panel: Axes, plot: DifferencePlot) -> None:
    styles = ((plot.path_before_m, BEFORE, "before", 2.6), (plot.path_after_m, AFTER, "after", 1.2))
    for path, colour, name, width in styles:
        panel.plot(path[:, 0], path[:, 1], color=colour, lw=width, label=name)
        panel.plot(*path[0], marker="o", ms=4.5, color=colour, ls="none")
    both = np.concatenate((plot.path_before_m, plot.path_after_m))
    centre, side = (both.min(axis=0) + both.max(axis=0)) / 2.0, max(0.2, 1.1 * float(np.ptp(both, axis=0).max()))
    panel.set(xlim=(centre[0] + side / 2, centre[0] - side / 2), ylim=(centre[1] - side / 2, centre[1] + side / 2))
    panel.set_aspect("equal")
    add_keys(panel, loc="upper left", bbox_to_anchor=(-0.02, -0.18), ncols=2)


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
            room = int((one.end - one.start) / end * 150)
            if room > 2 and len(layer.segments) <= MOST_LABELS:
                middle = (one.start + one.end) / 2.0
                write(panel, (middle, bottom + 0.46), shortened(one.label, room), ha="center", fontsize=SMALL)
        for mark in layer.keyframes:
            panel.plot([mark.frame + 0.5], [bottom + 0.84], marker="v", ms=5, color=INK)
    panel.set(xlim=(0, end), ylim=(0.0, 2.0))
    panel.set_yticks([1.46, 0.46], ["before", "after"])
    panel.tick_params(axis="y", length=0, labelcolor=INK)
    return figure


def _last_frames(layer: Annotation) -> Sequence[int]:
    return [one.end for one in layer.segments] + [one.frame + 1 for one in layer.keyframes]
