"""Axes that several figures of an evaluation share: speed, and turn rate to the left and right."""

from __future__ import annotations

from typing import TYPE_CHECKING

from marey_reports.drawing.paper import QUIET, SMALL, write

ROW = 0.235
"""Height in inches of a row that shows one clip."""

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SPEED = "speed (m/s)"
TURN_RATE = "turn rate (deg/s, left positive)"
COLUMNS = 4
"""Greatest number of small multiples side by side."""
LONGEST_TITLE = 19
"""Greatest number of letters in the title of a small multiple."""


def mark_sides(axes: Axes) -> None:
    """Label the left and right halves of an axis of turn rates, in the corners above the panel."""
    look = {"transform": axes.transAxes, "color": QUIET, "fontsize": SMALL, "va": "bottom"}
    write(axes, (0.0, 1.005), "← right turns", ha="left", **look)
    write(axes, (1.0, 1.005), "left turns →", ha="right", **look)
