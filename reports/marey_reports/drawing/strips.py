"""Strips of small figures: poses of motions in the same frames, one motion or one set of motions per row.

All cells of a column show the same patch of the floor, so that differences between rows are visible in place.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from textwrap import wrap
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from marey_motion.arrays import Floats
from marey_motion.clip import Clip
from marey_motion.errors import MotionError
from marey_motion.kinematics import forward_directions, global_positions
from marey_reports.drawing.paper import HAIRLINE, INK, QUIET, REFERENCE, TEXT, new_figure, shortened, to_svg, write
from marey_reports.drawing.stick_figures import LEFT, RIGHT, Camera, StickFigure, body_of
from marey_reports.drawing.strip_bodies import (
    FLOOR_SHARE,
    GHOST,
    HEAD_SHARE,
    LINE_POINTS,
    SIDE_COLOURS,
    BodyShapes,
    BodyStyle,
    StripCell,
    draw_body,
    draw_path,
    shapes_of,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


CAMERA_TILT_RAD = np.radians(10.0)

# In inches.
MARGIN, HEADER, ABOUT, MOMENT, GAP = 0.10, 0.42, 0.22, 0.40, 0.10
LABEL_LINE = 0.16
LABEL_LETTERS, MOST_LABEL_LINES = 26, 4
FILLED = 0.84  # of a cell's height, by the highest point

DEEP_M = 0.5
"""Depth below height 0, in metres, from which a motion is drawn with the floor at its lowest point.

In some files, height 0 is at the hips; with the floor there, bodies would be drawn tiny.
"""

EVEN_POSES = 6
"""Number of poses of each motion in a strip of motions of different durations."""
POSE_CELL_IN = (1.15, 1.7)
"""Width and height of a cell in the strip of a clip, inches."""
CAMERA_TURN_RAD = np.radians(40.0)  # from where the body faces at first to where it is seen from, to its left


@dataclass(frozen=True, eq=False)
class StripRow:
    """Content of one row.

    Parameters
    ----------
    label, note : texts to the left of the row; `note` is written below `label`, in small letters
    bodies : (m, T, P, 3) points of m motions in T frames, metres, drawn on top of each other
    paths : (m, N, 3) paths of the root in metres, drawn on the floor; N may be 0
    ghost : (T, P, 3) points of a motion for comparison, drawn in grey behind the bodies
    """

    label: str
    note: str
    bodies: Floats
    paths: Floats
    ghost: Floats | None = None


class StripMoments(NamedTuple):
    """Columns of a strip: for each of T columns, its centre (T, 2) as x and z in metres, its title and its label."""

    middles: Floats
    names: Sequence[str]
    labels: Sequence[str]


def draw_strips(
    body: StickFigure,
    rows: Sequence[StripRow],
    moments: StripMoments,
    direction_rad: float,
    *,
    cell_in: tuple[float, float],
    legend: Sequence[tuple[str, str]] = (),
    about: str = "",
    whole: bool = False,
) -> Figure:
    """Draw a page of strips, seen from `direction_rad` about +Y (0 is a view from +z).

    Parameters
    ----------
    cell_in : width and height of a cell, inches
    legend : further elements to name in the legend, besides the left and right sides: their names and colours
    about : text above the rows, such as "5 of 162 trials, the worst first"
    whole : whether every body fits its cell; otherwise, the sides of cells cut off bodies that are far from the others
    """
    width, height = cell_in
    columns = len(moments.names)
    labels = _label_width(rows)
    header = HEADER + (ABOUT if about else 0.0)
    page = (labels + columns * width + MARGIN, header + len(rows) * (height + GAP) + MOMENT)
    figure = new_figure(*page)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0), xlim=(0.0, page[0]), ylim=(0.0, page[1]))
    axes.axis("off")
    camera = Camera(direction_rad, float(CAMERA_TILT_RAD))
    scale = _scale(body, rows, moments, camera, cell_in, whole=whole)
    shapes = shapes_of(body, (row.bodies for row in rows))
    _draw_legend(axes, labels, page[1], legend)
    if about:
        write(axes, (labels + 0.05, page[1] - 0.17 - ABOUT), about, color=QUIET)
    for number, row in enumerate(rows):
        bottom = page[1] - header - (number + 1) * (height + GAP) + GAP
        _draw_label(axes, row, bottom + 0.5 * height)
        for column in range(columns):
            stage = StripCell((labels + column * width, bottom), cell_in, moments.middles[column], camera, scale)
            _draw_cell(axes, stage, shapes, row, column)
    for column, (name, label) in enumerate(zip(moments.names, moments.labels, strict=True)):
        middle = labels + (column + 0.5) * width
        write(axes, (middle, MOMENT - 0.10), name, ha="center", color=QUIET)
        write(axes, (middle, MOMENT - 0.26), label, ha="center", color=INK)
    return figure


def draw_clip_strip(poses: Sequence[Clip], frames: Sequence[int], frame_rate_hz: float, *, title: str) -> str:
    """Draw a clip at some moments as SVG.

    Parameters
    ----------
    poses : one frame of the clip for each moment
    frames : the indices of these frames in the clip
    frame_rate_hz : frames per second of the clip
    title : title of the picture, for readers who do not see it
    """
    body = body_of(poses[0].skeleton)
    points = _points_of(poses)
    floor = _floor_m(points)
    points -= (0.0, floor, 0.0)
    middles = points[:, body.pelvis][:, (0, 2)]
    labels = [f"{frame / frame_rate_hz:.2f} s" for frame in frames]
    moments = StripMoments(middles, [f"frame {frame}" for frame in frames], labels)
    row = StripRow("", "", points[None], np.empty((0, 0, 3)))
    direction = _camera_direction(points, body.facing)
    figure = draw_strips(body, [row], moments, direction, cell_in=POSE_CELL_IN, about=_floor_text(floor), whole=True)
    return to_svg(figure, title)


@dataclass(frozen=True, eq=False)
class PoseRow:
    """Content of a row of a strip: poses of one motion.

    Parameters
    ----------
    label, note : texts to the left of the row
    poses : one frame of the motion for each moment
    ghost : one frame of another motion for each moment, drawn in grey behind the poses
    headings_rad : (T,) headings to which the poses are turned, about +Y, 0 for +z; if None, poses are not turned
    """

    label: str
    note: str
    poses: Sequence[Clip]
    ghost: Sequence[Clip] = ()
    headings_rad: Floats | None = None


def draw_pose_rows(
    rows: Sequence[PoseRow], names: Sequence[str], labels: Sequence[str], *, ghost: str = "", about: str = ""
) -> Figure:
    """Draw motions of one skeleton at T moments, one in each row; each body is in the middle of its cell.

    A ghost (a body of another motion, drawn in grey behind) has the same offset from the body in front as in the data.

    Parameters
    ----------
    names, labels : two texts for each of the T columns, written below the column
    ghost : name of the ghosts in the legend; empty if there are none
    about : text above the rows
    """
    body = body_of(rows[0].poses[0].skeleton)
    drawn = []
    for row in rows:
        points = _points_of(row.poses)
        floor = _floor_m(points)
        origin = points[:, body.pelvis] * (1.0, 0.0, 1.0) + (0.0, floor, 0.0)
        behind = _points_of(row.ghost) - origin[:, None] if row.ghost else None
        points = points - origin[:, None]
        if row.headings_rad is not None:
            points = _turned(points, body.facing, row.headings_rad)
        note = ", ".join(text for text in (row.note, _floor_text(floor)) if text)
        drawn.append(StripRow(row.label, note, points[None], np.empty((0, 0, 3)), behind))
    moments = StripMoments(np.zeros((len(names), 2)), names, labels)
    direction = _camera_direction(drawn[0].bodies[0], body.facing)
    legend = [(ghost, REFERENCE)] if ghost else []
    return draw_strips(body, drawn, moments, direction, cell_in=POSE_CELL_IN, legend=legend, about=about, whole=True)


def even_frames(count: int) -> list[int]:
    """Return `EVEN_POSES` indices of `count` frames at even intervals, from the first to the last frame."""
    return [round(place) for place in np.linspace(0, count - 1, EVEN_POSES)]


def draw_even_poses(rows: Sequence[PoseRow]) -> Figure:
    """Draw motions of different durations, each by its poses at `even_frames`, which are turned to one heading."""
    turned = [replace(row, headings_rad=np.zeros(EVEN_POSES)) for row in rows]
    return draw_pose_rows(
        turned, ["after"] * EVEN_POSES, [f"{share:.0f} %" for share in np.linspace(0.0, 100.0, EVEN_POSES)]
    )


def _floor_m(points: Floats) -> float:
    """Return the height at which the floor is drawn: 0, or the lowest of points that are far below 0."""
    lowest = float(points[..., 1].min())
    return lowest if lowest < -DEEP_M else 0.0


def _floor_text(floor_m: float) -> str:
    return f"floor drawn at {floor_m:.2f} m" if floor_m else ""


def _points_of(poses: Sequence[Clip]) -> Floats:
    return np.concatenate([global_positions(one, end_sites=True) for one in poses]).astype(np.float64)


def _turned(points: Floats, facing: tuple[tuple[int, ...], tuple[int, ...]], headings_rad: Floats) -> Floats:
    """Turn points (T, P, 3) about the vertical through the origin until each pose faces its heading, if it is known."""
    try:
        ahead = forward_directions(points, *facing)
    except MotionError:
        return points
    angle = headings_rad - np.arctan2(ahead[:, 0], ahead[:, 1])
    cos, sin = np.cos(angle)[:, None], np.sin(angle)[:, None]
    x, z = points[..., 0], points[..., 2]
    return np.stack((cos * x + sin * z, points[..., 1], cos * z - sin * x), axis=-1)


def _camera_direction(points: Floats, facing: tuple[tuple[int, ...], tuple[int, ...]]) -> float:
    try:
        ahead = forward_directions(points, *facing)[0]
    except MotionError:
        return float(CAMERA_TURN_RAD)
    return float(np.arctan2(*ahead) + CAMERA_TURN_RAD)


def _scale(
    body: StickFigure,
    rows: Sequence[StripRow],
    moments: StripMoments,
    camera: Camera,
    cell_in: tuple[float, float],
    *,
    whole: bool,
) -> float:
    """Compute the scale in inches per metre at which the highest point fits, and most figures fit in width.

    If `whole`, every point of every body fits, with its head.
    """
    middles = np.stack((moments.middles[:, 0], np.zeros(len(moments.middles)), moments.middles[:, 1]), axis=1)
    drawn = np.unique(np.append(body.bones, body.pelvis))
    seen = np.concatenate([camera.seen(row.bodies[:, :, drawn] - middles[:, None]).reshape(-1, 3) for row in rows])
    highest = max(float(np.quantile(seen[:, 1], 1.0 if whole else 0.999)), 1e-6)
    widest = max(2.0 * float(np.quantile(np.abs(seen[:, 0]), 1.0 if whole else 0.995)), 1e-6)
    if not whole:
        return min(FILLED * cell_in[1] / highest, 0.96 * cell_in[0] / widest)
    below = max(-float(seen[:, 1].min()), 1e-6)
    head = HEAD_SHARE * highest
    return min(
        FILLED * cell_in[1] / highest, 0.92 * cell_in[0] / (widest + head), FLOOR_SHARE * cell_in[1] / (below + 1e-9)
    )


def _label_width(rows: Sequence[StripRow]) -> float:
    """Return the width in inches that the labels of the rows need."""
    lines = [(1.15 * len(line), 0.9 * len(row.note)) for row in rows for line in _lines(row.label)]
    return 0.2 + 0.078 * max([0, *(max(pair) for pair in lines)])


def _draw_legend(axes: Axes, left: float, top: float, legend: Sequence[tuple[str, str]]) -> None:
    keys = [("left side", SIDE_COLOURS[LEFT]), ("right side", SIDE_COLOURS[RIGHT]), *legend]
    start, line = left + 0.05, top - 0.17
    for name, colour in keys:
        axes.plot([start, start + 0.26], [line] * 2, color=colour, lw=2.6, solid_capstyle="round")
        write(axes, (start + 0.34, line), name, color=QUIET)
        start += 0.34 + 0.072 * len(name) + 0.28


def _draw_label(axes: Axes, row: StripRow, middle: float) -> None:
    lines = _lines(row.label)
    top = middle + 0.5 * LABEL_LINE * (len(lines) - 1) + (0.09 if row.note else 0.0)
    for number, line in enumerate(lines):
        write(axes, (0.05, top - number * LABEL_LINE), line, fontsize=TEXT, fontweight="bold")
    if row.note:
        write(axes, (0.05, top - (len(lines) - 1) * LABEL_LINE - 0.19), row.note, color=QUIET)


def _lines(label: str) -> list[str]:
    """Break a label into lines; a label that does not fit on these lines is shortened in its middle."""
    return wrap(shortened(label, MOST_LABEL_LINES * LABEL_LETTERS), LABEL_LETTERS) or [""]


def _draw_cell(axes: Axes, stage: StripCell, shapes: BodyShapes, row: StripRow, column: int) -> None:
    """Draw the floor, the root's paths on it, the ghost and the bodies, clipped at the sides of the cell."""
    from matplotlib.transforms import Bbox, TransformedBbox

    (left, bottom), (width, height) = stage.corner, stage.size
    floor = bottom + FLOOR_SHARE * height
    # One box for all artists: each `set_clip_path` would make another one, which takes a tenth of the time of a strip.
    frame = TransformedBbox(Bbox.from_bounds(left, bottom - GAP, width, height + 2 * GAP), axes.transData)
    axes.plot([left + 0.03, left + width - 0.03], [floor] * 2, color=HAIRLINE, lw=0.8)
    for path in row.paths:
        draw_path(axes, stage.placed(path * (1.0, 0.0, 1.0)), frame)
    if row.ghost is not None:
        draw_body(axes, shapes, stage, row.ghost[column], GHOST, frame)
    count = len(row.bodies)
    faint = BodyStyle(0.6 * LINE_POINTS, max(0.25, 1.0 / np.sqrt(count)))
    look = BodyStyle(LINE_POINTS, rim=True) if count == 1 else faint
    for points in row.bodies[:, column]:
        draw_body(axes, shapes, stage, points, look, frame)
