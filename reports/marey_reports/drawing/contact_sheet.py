"""Pictures of motion: contact sheets that show takes and their results side by side.

Matplotlib is loaded when the first picture is drawn, and only its object interface is used, so that threads may draw
at the same time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from marey_motion.arrays import AnyFloats
from marey_motion.clip import Clip
from marey_motion.errors import MotionError
from marey_reports.drawing.paper import HAIRLINE, INK, shortened, to_png
from marey_reports.drawing.stick_figures import CENTRE, LEFT, RIGHT, Camera, Stances, StickFigure, body_of, stances_at
from marey_schemas.wording import counted, part_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes


MAX_TAKES = 100
MAX_MOMENTS = 12
SIDE_COLOURS = {LEFT: "#1f6fb2", CENTRE: "#39414f", RIGHT: "#e07b1a"}
QUIET, TINT, FLOOR = "#6f7786", "#f1f4f8", "#e1e6ec"

# The page, in inches.
PAGE_WIDTH, MARGIN, HEADER = 15.0, 0.45, 1.10
TITLE, STAGE, CAPTION, GAP = 0.40, 2.30, 0.30, 0.25
ROW = TITLE + STAGE + CAPTION + GAP
DPI = 110
BONE_POINTS, EDGE_POINTS = 2.6, 5.0
EDGE_STOPS = 0.07  # inches before a bone's ends
PAD = 0.10  # inches between what is drawn and the border of its cell, more than half of the widest line

CAMERA_TURN_RAD = np.radians(40.0)  # from where the body faces at first to where it is seen from, to its left
CAMERA_TILT_RAD = np.radians(12.0)
FLOOR_SHARE = 0.26  # radius of the spot of floor under a figure, of its height
HEAD_SHARE = 0.052  # radius of the head, of the body's height
LONGEST_TITLE = 80
ARROW = {"arrowstyle": "-|>,head_length=0.35,head_width=0.18", "color": QUIET, "lw": 1.3, "shrinkA": 0, "shrinkB": 0}


class TakePair(NamedTuple):
    """Source clip of a take and the clip that was made from it, for example by retargeting, with a title."""

    title: str
    source: Clip
    result: Clip


def contact_sheet(
    takes: Sequence[TakePair],
    *,
    heading: str = "Retargeting",
    moments: int = 6,
    total: int | None = None,
    choice: str = "",
    sides: tuple[str, str] = ("source", "result"),
) -> bytes:
    """Draw a PNG with one row per take: at each of several times, the source and the result side by side.

    The result has a tinted background. The figures of a take have the same scale, and are seen from the front left of
    the source in its first frame. No part of a figure leaves its cell. Each figure is drawn over its own patch of the
    floor y = 0, with an arrow in its facing direction.

    Parameters
    ----------
    takes : takes to draw, at most `MAX_TAKES`
    heading : title of the page
    moments : number of evenly spaced times at which a take is drawn, at most `MAX_MOMENTS` and one per frame
    total : number of takes from which the drawn takes were chosen; None if all takes are drawn
    choice : order in which they were chosen, such as "the worst first"; written only if not all takes are drawn
    sides : names, for the header, of the clips on the white and on the tinted background

    Raises
    ------
    MotionError    if there are no takes or no moments, or too many
    """
    from matplotlib.figure import Figure

    if not (1 <= len(takes) <= MAX_TAKES and 1 <= moments <= MAX_MOMENTS):
        raise MotionError(
            f"a sheet shows 1 to {MAX_TAKES} takes at 1 to {MAX_MOMENTS} moments, not {len(takes)} takes at {moments}",
            code="figure-size",
        )
    rows = [_staged(take, moments) for take in takes]
    height = HEADER + ROW * len(rows)
    figure = Figure(figsize=(PAGE_WIDTH, height), dpi=DPI, facecolor="white")
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0), xlim=(0.0, PAGE_WIDTH), ylim=(0.0, height))
    axes.axis("off")
    _draw_header(axes, height, heading, f"{_shown_of(len(rows), total, choice)}, {_legend(sides)}")
    for number, row in enumerate(rows):
        _draw_row(axes, row, height - HEADER - number * ROW, (PAGE_WIDTH - 2 * MARGIN) / moments)
    return to_png(figure)


@dataclass(frozen=True)
class _SheetRow:
    """Take prepared for the page: bodies and stances of source and result, and the camera."""

    take: TakePair
    times_s: AnyFloats
    actors: tuple[tuple[StickFigure, Stances], tuple[StickFigure, Stances]]
    camera: Camera

    @property
    def extent_m(self) -> tuple[float, float]:
        """Heights of the lowest and the highest drawn point, extended to include the floor y = 0."""
        heights = np.concatenate(
            [stances.points[:, np.append(body.bones, body.pelvis), 1].ravel() for body, stances in self.actors]
        )
        return min(float(heights.min()), 0.0), max(float(heights.max()), 0.0)

    @property
    def height_m(self) -> float:
        """Height from the lowest to the highest drawn point of the row, including the floor y = 0.

        Heads and patches of floor are scaled by it.
        """
        low, high = self.extent_m
        return high - low

    @property
    def seen_extent_m(self) -> tuple[float, float, float]:
        """Extent of the row's figures in the picture, in metres from the point of the floor under the pelvis.

        The three numbers are the lowest point, the highest point, and the greatest distance to a side. They cover
        bones, heads, patches of floor and arrows. The lowest point can be below the floor line, because the camera
        looks down.
        """
        spot, head = FLOOR_SHARE * self.height_m, HEAD_SHARE * self.height_m
        corners = [np.array([[spot, spot * np.sin(self.camera.tilt_rad)]]), self._arrow_tips(spot)]
        corners[0] = np.concatenate((corners[0], -corners[0]))
        for body, stances in self.actors:
            bones = self.camera.seen(stances.points[:, body.bones])[..., :2]
            corners.append(bones.reshape(-1, 2))
            if body.head is not None:
                centres = _head_centre(body, bones)
                corners += [centres + head, centres - head]
        seen = np.concatenate(corners)
        return float(seen[:, 1].min()), float(seen[:, 1].max()), float(np.abs(seen[:, 0]).max())

    def _arrow_tips(self, spot_m: float) -> AnyFloats:
        facings = [stances.facing for _, stances in self.actors if stances.facing is not None]
        return np.concatenate([np.empty((0, 2)), *(_arrow_tip(self.camera, one, spot_m)[..., :2] for one in facings)])


def _head_centre(body: StickFigure, bones: AnyFloats) -> AnyFloats:
    """Return the centre (..., k) of the head, computed from the ends (..., n, 2, k) of all n bones."""
    assert body.head is not None
    bone, share = body.head
    return share * bones[..., bone, 0, :] + (1.0 - share) * bones[..., bone, 1, :]


def _arrow_tip(camera: Camera, facing: AnyFloats, spot_m: float) -> AnyFloats:
    """Return the tips (..., 3) of the arrows in the facing directions (..., 2), as the camera sees them, in metres.

    `spot_m` is the radius of the patch of floor under the body; the arrows end a little outside it.
    """
    ahead = np.stack((facing[..., 0], np.zeros_like(facing[..., 0]), facing[..., 1]), axis=-1)
    return camera.seen(1.15 * spot_m * ahead)


def _staged(take: TakePair, moments: int) -> _SheetRow:
    clips = (take.source, take.result)
    last_s = min((clip.frame_count - 1) / clip.frame_rate_hz for clip in clips)
    times = np.linspace(0.0, last_s, min(moments, *(clip.frame_count for clip in clips)))
    actors = []
    for clip in clips:
        body = body_of(clip.skeleton)
        actors.append((body, stances_at(clip, body, np.rint(times * clip.frame_rate_hz).astype(np.intp))))
    facing = next((stances.facing[0] for _, stances in actors if stances.facing is not None), (0.0, 1.0))
    camera = Camera(float(np.arctan2(*facing)) + CAMERA_TURN_RAD, CAMERA_TILT_RAD)
    return _SheetRow(take, times, (actors[0], actors[1]), camera)


@dataclass(frozen=True)
class _SheetCell:
    """Place of one figure on a contact sheet.

    Parameters
    ----------
    left, bottom, width : place and size of the background, inches
    centre : position of the floor under the pelvis, inches
    scale : inches per metre
    ground : colour of the background
    """

    left: float
    bottom: float
    width: float
    centre: tuple[float, float]
    scale: float
    ground: str

    def placed(self, seen: AnyFloats) -> AnyFloats:
        """Convert points (..., 3), as a camera sees them, to points (..., 2) on the page."""
        return seen[..., :2] * self.scale + self.centre


def _shown_of(shown: int, total: int | None, choice: str) -> str:
    """Return the number of takes in words, such as "8 of 130 takes, the worst first"."""
    if total is None or total == shown:
        return counted(shown, "take")
    return ", ".join(filter(None, (part_of(shown, total, "take"), choice)))


def _legend(sides: tuple[str, str]) -> str:
    white, tinted = (shortened(side) for side in sides)
    return f"each moment as {white} (white) and {tinted} (tinted)"


def _draw_header(axes: Axes, top: float, heading: str, legend: str) -> None:
    line = top - 0.50
    _write(axes, (MARGIN, line), heading, 21, weight="bold")
    _write(axes, (MARGIN, line - 0.31), legend, 10.5, QUIET)
    right, middle = PAGE_WIDTH - MARGIN, line + 0.08
    for place, (label, side) in enumerate((("left side", LEFT), ("right side", RIGHT))):
        start = right - 3.75 + 1.30 * place
        axes.plot([start, start + 0.3], [middle] * 2, color=SIDE_COLOURS[side], lw=3.5, solid_capstyle="round")
        _write(axes, (start + 0.4, middle), label, 10.5, QUIET, va="center")
    axes.annotate("", (right - 0.75, middle), (right - 1.15, middle), arrowprops=ARROW)
    _write(axes, (right - 0.65, middle), "facing", 10.5, QUIET, va="center")


def _draw_row(axes: Axes, row: _SheetRow, top: float, cell: float) -> None:
    """Draw the row of a take: its title, and for each time a cell with source and result. `top` is in inches."""
    _draw_titles(axes, row, top)
    lowest, highest, aside = row.seen_extent_m
    width = 0.5 * cell
    scale = min((STAGE - 2 * PAD) / max(highest - lowest, 1e-6), (0.5 * width - PAD) / max(aside, 1e-6))
    floor = max(0.12 * STAGE, PAD - lowest * scale)
    floor = min(floor, STAGE - PAD - highest * scale)
    bottom = top - TITLE - STAGE
    for moment, time_s in enumerate(row.times_s):
        left = MARGIN + moment * cell
        _write(axes, (left + width, bottom - 0.21), f"{time_s:.2f} s", 9.5, QUIET, ha="center")
        for side, ground in enumerate(("white", TINT)):
            start = left + side * width
            centre = (start + 0.5 * width, bottom + floor)
            stage = _SheetCell(start, bottom, width, centre, scale, ground)
            body, stances = row.actors[side]
            facing = None if stances.facing is None else stances.facing[moment]
            _draw_floor(axes, stage, row.camera, facing, FLOOR_SHARE * row.height_m)
            _draw_body(axes, stage, body, row.camera.seen(stances.points[moment]), HEAD_SHARE * row.height_m)


def _draw_titles(axes: Axes, row: _SheetRow, top: float) -> None:
    clips = (row.take.source, row.take.result)
    title = row.take.title if len(row.take.title) <= LONGEST_TITLE else f"{row.take.title[: LONGEST_TITLE - 1]}…"
    _write(axes, (MARGIN, top - 0.2), title, 12.5, weight="bold")
    joints = " → ".join(str(clip.skeleton.joint_count) for clip in clips)
    about = f"{counted(clips[0].frame_count, 'frame')} at {clips[0].frame_rate_hz:g} Hz, {joints} joints"
    _write(axes, (PAGE_WIDTH - MARGIN, top - 0.2), about, 9.5, QUIET, ha="right")


def _draw_floor(axes: Axes, stage: _SheetCell, camera: Camera, facing: AnyFloats | None, radius_m: float) -> None:
    """Draw the background, the floor line, the patch of floor under the figure and an arrow in its facing direction."""
    from matplotlib.patches import Ellipse, Rectangle

    size = (stage.width, STAGE)
    axes.add_patch(Rectangle((stage.left, stage.bottom), *size, facecolor=stage.ground, edgecolor=HAIRLINE, lw=0.6))
    axes.plot([stage.left, stage.left + stage.width], [stage.centre[1]] * 2, color=HAIRLINE, lw=0.8)
    diameter = 2.0 * radius_m * stage.scale
    spot = Ellipse(stage.centre, diameter, diameter * np.sin(camera.tilt_rad), facecolor=FLOOR, edgecolor="none")
    axes.add_patch(spot)
    if facing is not None:
        tip = stage.placed(_arrow_tip(camera, facing, radius_m))
        axes.annotate("", tuple(tip), stage.centre, arrowprops=ARROW)


def _draw_body(axes: Axes, stage: _SheetCell, body: StickFigure, seen: AnyFloats, head_m: float) -> None:
    """Draw bones from back to front, each with an edge in the background's colour, which separates bones that cross."""
    from matplotlib.collections import LineCollection
    from matplotlib.patches import Circle

    bones = seen[body.bones]
    order = np.argsort(bones[..., 2].mean(axis=1), kind="stable")
    if body.head is not None and body.head[1] < 1.0:
        order = order[order != body.head[0]]  # the circle stands for it
    lines = stage.placed(bones[order])
    # Edges end short of the joints, where they would cut off the neighbouring bones.
    middle = lines.mean(axis=1, keepdims=True)
    length = np.linalg.norm(lines[:, 1] - lines[:, 0], axis=-1)[:, None, None]
    edges = middle + (lines - middle) * np.maximum(1.0 - 2.0 * EDGE_STOPS / np.maximum(length, EDGE_STOPS), 0.0)
    segments = np.stack((edges, lines), axis=1).reshape(-1, 2, 2)
    colours = [colour for bone in order for colour in (stage.ground, SIDE_COLOURS[int(body.sides[bone])])]
    widths = [EDGE_POINTS, BONE_POINTS] * len(order)
    axes.add_collection(LineCollection(list(segments), colors=colours, linewidths=widths, capstyle="round"))
    if body.head is not None:
        centre = stage.placed(_head_centre(body, bones))
        colour = SIDE_COLOURS[CENTRE]
        circle = Circle(tuple(centre), head_m * stage.scale, facecolor=stage.ground, edgecolor=colour, lw=2.0, zorder=3)
        axes.add_patch(circle)


def _write(axes: Axes, place: tuple[float, float], text: str, size: float, colour: str = INK, **options: Any) -> None:
    """Write text literally: matplotlib would read text between dollar signs as mathematical notation."""
    axes.text(*place, text, fontsize=size, color=colour, parse_math=False, **options)
