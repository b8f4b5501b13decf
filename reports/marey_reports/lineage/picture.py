"""Picture of a lineage graph as SVG or PNG, or as a document in the language of Graphviz."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from marey_reports.drawing.paper import COLOURS, DPI, HAIRLINE, INK, PAPER, QUIET, SMALL, new_figure, to_png, to_svg
from marey_reports.lineage.layers import Layout, lay_out
from marey_reports.lineage.nodes import Arrow, Box, Sort, boxes_of
from marey_schemas.formats.pictures import LineageFile
from marey_schemas.lineage import CUT_OFF, LineageGraph

if TYPE_CHECKING:
    from matplotlib.axes import Axes

GROUND = {Sort.START: "#e3eef6", Sort.ITEMS: "#f4f6f8", Sort.JOB: "#ffffff", Sort.COMMIT: "#eaf5f0"}
"""Background colours of boxes."""
EDGE = {Sort.START: COLOURS[0], Sort.ITEMS: "#9aa3af", Sort.JOB: "#9aa3af", Sort.COMMIT: COLOURS[2]}
"""Colours of the borders of boxes."""
WARNING = COLOURS[1]
"""Colour of the border of a box with outdated, deleted or purged revisions."""

_SIGN, _BOLD_SIGN, _LINE, _PADDING = 0.071, 0.08, 0.16, 0.09
"""Widths of a plain and a bold character, height of a line, and space around the text of a box, in inches."""
_BETWEEN_LAYERS, _BETWEEN_BOXES, _PASSING, _MARGIN = 1.15, 0.22, 0.1, 0.3
_AT_LABEL = 0.35
"""Place of an arrow's label on the first piece of the arrow's curve: 0 is the start of the piece, 1 its end."""
MOST_PIXELS = 60_000_000
"""Greatest number of pixels of a PNG."""


class _Rectangle(NamedTuple):
    """Place of a node in inches from the lower left corner: left edge, centre, width and height."""

    left: float
    middle: float
    width: float
    height: float


def draw_lineage(graph: LineageGraph, file_type: LineageFile) -> bytes:
    """Draw a lineage graph: boxes for revisions, jobs and commits, with arrows from inputs to results.

    Parameters
    ----------
    graph : the lineage graph, as the server returns it
    file_type : `svg`, `png`, or `dot`, the language of Graphviz

    Returns
    -------
    bytes    the content of the file

    Raises
    ------
    ValueError    if the graph is too large for a picture
    """
    boxes, arrows = boxes_of(graph)
    if file_type == "dot":
        return as_dot(boxes, arrows).encode()
    layout = lay_out(len(boxes), [(arrow.source, arrow.target) for arrow in arrows])
    places = _places(boxes, layout)
    width = max(one.left + one.width for one in places.values()) + _MARGIN
    height = max(one.middle + one.height / 2 for one in places.values()) + _MARGIN + (0.0 if graph.complete else _LINE)
    if file_type == "png" and width * height * DPI**2 > MOST_PIXELS:
        raise ValueError("the lineage has too many boxes for a PNG; choose a smaller depth, or write an SVG")
    figure = new_figure(width, height)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0), facecolor=PAPER)
    axes.set(xlim=(0.0, width), ylim=(0.0, height))
    axes.set_axis_off()
    for arrow, route in zip(arrows, layout.routes, strict=True):
        _draw_arrow(axes, arrow, [places[node] for node in route])
    for node, box in enumerate(boxes):
        _draw_box(axes, box, places[node])
    if not graph.complete:
        axes.text(_MARGIN, height - _LINE, CUT_OFF, fontsize=SMALL, color=WARNING, va="center")
    return to_png(figure) if file_type == "png" else to_svg(figure, f"Lineage of {boxes[0].lines[0]}").encode()


def as_dot(boxes: list[Box], arrows: list[Arrow]) -> str:
    """Return the boxes and arrows of a graph as a document in the language of Graphviz."""
    lines = ["digraph lineage {", "  rankdir=LR;", '  node [shape=box, style="filled", fontname="sans-serif"];']
    for node, box in enumerate(boxes):
        border = WARNING if box.warning else EDGE[box.sort]
        shape = {Sort.JOB: ", shape=ellipse", Sort.COMMIT: ", shape=note"}.get(box.sort, "")
        text = r"\n".join(map(_escaped, box.lines))
        lines.append(f'  n{node} [label="{text}", fillcolor="{GROUND[box.sort]}", color="{border}"{shape}];')
    for arrow in arrows:
        label = f' [label="{_escaped(arrow.label)}"]' if arrow.label else ""
        lines.append(f"  n{arrow.source} -> n{arrow.target}{label};")
    return "\n".join([*lines, "}", ""])


def _escaped(text: str) -> str:
    return text.replace("\\", "\\\\").replace('"', '\\"')


def _places(boxes: list[Box], layout: Layout) -> dict[int, _Rectangle]:
    """Place the layers from left to right, and the nodes of each layer from top to bottom, centred vertically."""

    def size(node: int) -> tuple[float, float]:
        if node >= len(boxes):
            return 0.0, _PASSING
        lines = boxes[node].lines
        widest = max(len(lines[0]) * _BOLD_SIGN, max(map(len, lines)) * _SIGN)
        return widest + 2 * _PADDING, len(lines) * _LINE + 2 * _PADDING

    columns = [[size(node) for node in layer] for layer in layout.layers]
    heights = [sum(height for _, height in column) + (len(column) - 1) * _BETWEEN_BOXES for column in columns]
    highest = max(heights)
    places = {}
    left = _MARGIN
    for layer, column, height in zip(layout.layers, columns, heights, strict=True):
        widest = max(width for width, _ in column)
        top = _MARGIN + highest - (highest - height) / 2
        for node, (width, tall) in zip(layer, column, strict=True):
            # A place that an arrow passes is as wide as the layer, so that the arrow passes between the boxes.
            own = width if node < len(boxes) else widest
            places[node] = _Rectangle(left + (widest - own) / 2, top - tall / 2, own, tall)
            top -= tall + _BETWEEN_BOXES
        left += widest + _BETWEEN_LAYERS
    return places


def _draw_box(axes: Axes, box: Box, place: _Rectangle) -> None:
    from matplotlib.patches import FancyBboxPatch

    style = "round,pad=0,rounding_size=0.12" if box.sort is Sort.JOB else "square,pad=0"
    border = WARNING if box.warning else EDGE[box.sort]
    bottom = place.middle - place.height / 2
    axes.add_patch(
        FancyBboxPatch(
            (place.left, bottom), place.width, place.height, boxstyle=style, facecolor=GROUND[box.sort],
            edgecolor=border, linewidth=1.0, zorder=3,
        )
    )  # fmt: skip
    for number, line in enumerate(box.lines):
        height = place.middle + place.height / 2 - _PADDING - (number + 0.5) * _LINE
        axes.text(
            place.left + _PADDING, height, line, fontsize=SMALL, color=INK if number == 0 else QUIET, va="center",
            parse_math=False, zorder=4, fontweight="bold" if number == 0 else "normal",
        )  # fmt: skip


def _draw_arrow(axes: Axes, arrow: Arrow, route: list[_Rectangle]) -> None:
    """Draw an arrow as a smooth line through the nodes of its route, with the label near the start of the line."""
    from matplotlib.patches import FancyArrowPatch
    from matplotlib.path import Path

    start = route[0]
    points, codes = [(start.left + start.width, start.middle)], [Path.MOVETO]
    for place in route[1:]:
        x, y = points[-1]
        bend = (place.left - x) / 2
        points += [(x + bend, y), (place.left - bend, place.middle), (place.left, place.middle)]
        codes += [Path.CURVE4] * 3
        if place is not route[-1]:
            points.append((place.left + place.width, place.middle))
            codes.append(Path.LINETO)
    line = Path(points, codes)
    axes.add_patch(FancyArrowPatch(path=line, arrowstyle="-|>", mutation_scale=8, color=QUIET, linewidth=0.8, zorder=2))
    if arrow.label:
        x, y = (_on_curve([point[axis] for point in points[:4]], _AT_LABEL) for axis in (0, 1))
        axes.text(
            x, y, arrow.label, fontsize=SMALL - 1, color=QUIET, va="center", ha="center", parse_math=False, zorder=5,
            bbox={"facecolor": PAPER, "edgecolor": HAIRLINE, "linewidth": 0.4, "pad": 1.2},
        )  # fmt: skip


def _on_curve(controls: list[float], t: float) -> float:
    """Return a coordinate of a cubic Bézier curve from the coordinates of its four control points."""
    a, b, c, d = controls
    return a * (1 - t) ** 3 + 3 * b * t * (1 - t) ** 2 + 3 * c * t**2 * (1 - t) + d * t**3
