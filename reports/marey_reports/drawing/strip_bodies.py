"""Bodies in the cells of a strip: the lines of a body are joined to one shape per side.

This keeps the file of a drawing of a hundred bodies small.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from marey_motion.arrays import Floats, Indices
from marey_reports.drawing.paper import COLOURS, INK, PAPER, QUIET, REFERENCE
from marey_reports.drawing.stick_figures import CENTRE, LEFT, RIGHT, Camera, StickFigure, runs_of

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.path import Path
    from matplotlib.transforms import BboxBase

SIDE_COLOURS = {LEFT: COLOURS[0], CENTRE: INK, RIGHT: COLOURS[1]}
FLOOR_SHARE = 0.09  # of a cell's height: the floor's distance from its lower edge
HEAD_SHARE = 0.055  # radius of the head, of the height of the highest point
LINE_POINTS = 1.7
RIM_STOPS = 0.05  # inches before a bone's ends
DOT_IN = 0.03  # radius of a skeleton of one joint


@dataclass(frozen=True)
class StripCell:
    """Cell of a strip: lower left corner and size in inches, (x, z) in metres at its centre, and inches per metre."""

    corner: tuple[float, float]
    size: tuple[float, float]
    middle: Floats
    camera: Camera
    scale: float

    def placed(self, points: Floats) -> Floats:
        """Project points (..., 3) to (right, up, towards the viewer) in inches on the page."""
        seen = self.camera.seen(points - np.array((self.middle[0], 0.0, self.middle[1]))) * self.scale
        below = np.array((self.corner[0] + 0.5 * self.size[0], self.corner[1] + FLOOR_SHARE * self.size[1], 0.0))
        return np.asarray(seen + below, dtype=np.float64)


class BodyStyle(NamedTuple):
    """Style of the lines of a body.

    If `colour` is None, each side of the body has its own colour. A `rim` is a light edge that separates overlapping
    sides of the body.
    """

    width: float
    alpha: float = 1.0
    colour: str | None = None
    rim: bool = False


GHOST = BodyStyle(LINE_POINTS, 0.55, REFERENCE)


def draw_path(axes: Axes, path: Floats, frame: BboxBase) -> None:
    """Draw a path (N, 2) on the floor, in inches on the page."""
    if len(path):
        (line,) = axes.plot(path[:, 0], path[:, 1], color=QUIET, lw=0.9, alpha=0.8)
        line.set_clip_box(frame)


class BodyShapes(NamedTuple):
    """Shapes of a body, as indices of points.

    `runs` are the lines of joined bones, and `bones` the single bones (n, 2), both by side of the body. `head` contains
    the points of the head's bone, and the place of the head's centre on this bone as in `StickFigure`; None without a
    head. `head_m` is the radius of the head in metres.
    """

    runs: dict[int, list[Indices]]
    bones: dict[int, Indices]
    head: tuple[Indices, float] | None
    head_m: float


def shapes_of(body: StickFigure, drawn: Iterable[Floats]) -> BodyShapes:
    """Return the shapes of a body; the size of the head is computed from the drawn points (m, T, P, 3) of each row."""
    shown = np.ones(len(body.bones), dtype=bool)
    if body.head is not None and body.head[1] < 1.0:
        shown[body.head[0]] = False  # the circle stands for it
    sides = sorted({int(side) for side in body.sides})
    bones = {side: body.bones[shown & (body.sides == side)] for side in sides}
    outer = np.append(body.bones[:, 0], body.pelvis)  # the pelvis, because a skeleton of one joint has no bones
    heights = np.concatenate([np.ptp(points[..., outer, 1], axis=-1).ravel() for points in drawn])
    return BodyShapes(
        {side: runs_of(bones[side]) for side in sides},
        bones,
        None if body.head is None else (body.bones[body.head[0]], body.head[1]),
        HEAD_SHARE * float(np.median(heights)),
    )


def draw_body(
    axes: Axes, shapes: BodyShapes, stage: StripCell, points: Floats, look: BodyStyle, frame: BboxBase
) -> None:
    """Draw the bones of a body with points (P, 3): each side as one shape, the far side before the near one.

    A skeleton of one joint, such as that of a tracked prop, is drawn as a dot.
    """
    from matplotlib.patches import Circle, PathPatch

    seen = stage.placed(points)
    if not shapes.bones:
        dot = Circle(tuple(seen[0, :2]), DOT_IN, color=look.colour or INK, alpha=look.alpha, linewidth=0.0)
        _add(axes, dot, frame)
    options: dict[str, Any] = {"facecolor": "none", "capstyle": "round", "joinstyle": "round"}
    sides = sorted(shapes.bones, key=lambda side: float(seen[shapes.bones[side], 2].mean()))
    for place, side in enumerate(sides):
        if look.rim and place:
            rim = _path(_middles(seen[shapes.bones[side], :2]))
            _add(axes, PathPatch(rim, edgecolor=PAPER, lw=look.width + 1.8, **{**options, "capstyle": "butt"}), frame)
        lines = _path([seen[run, :2] for run in shapes.runs[side]])
        colour = look.colour or SIDE_COLOURS[side]
        _add(axes, PathPatch(lines, edgecolor=colour, lw=look.width, alpha=look.alpha, **options), frame)
    if shapes.head is not None:
        (outer, inner), share = shapes.head
        centre = share * seen[outer, :2] + (1.0 - share) * seen[inner, :2]
        fill = PAPER if look.rim else "none"
        circle = Circle(tuple(centre), shapes.head_m * stage.scale, facecolor=fill, edgecolor=look.colour or INK)
        circle.set(linewidth=0.75 * look.width, alpha=look.alpha)
        _add(axes, circle, frame)


def _add(axes: Axes, artist: Artist, frame: BboxBase) -> None:
    """Add an artist, then clip it to `frame`. This order matters: `add_artist` replaces the box."""
    axes.add_artist(artist).set_clip_box(frame)


def _middles(bones: Floats) -> list[Floats]:
    """Shorten bones (n, 2, 2) at both ends, where their rims would cover the neighbouring bones."""
    middle = bones.mean(axis=1, keepdims=True)
    length = np.linalg.norm(bones[:, 1] - bones[:, 0], axis=-1)[:, None, None]
    return list(middle + (bones - middle) * np.maximum(1.0 - 2.0 * RIM_STOPS / np.maximum(length, RIM_STOPS), 0.0))


def _path(runs: Sequence[Floats]) -> Path:
    from matplotlib.path import Path

    codes = [np.append(Path.MOVETO, np.full(len(run) - 1, Path.LINETO)) for run in runs]
    return Path(np.concatenate(runs), np.concatenate(codes))
