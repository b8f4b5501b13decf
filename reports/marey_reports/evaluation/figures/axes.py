"""The axes that figures of an evaluation have in common: speed, and turn rate with its two sides."""

from __future__ import annotations

from typing import TYPE_CHECKING

from marey_reports.drawing.paper import QUIET, SMALL, write

ROW = 0.235
"""Inches of the row of a clip."""

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SPEED = "speed (m/s)"
TURN_RATE = "turn rate (deg/s, left positive)"


def mark_sides(axes: Axes) -> None:
    """Label the left and right halves of an axis of turn rates, in the corners above the panel."""
    look = {"transform": axes.transAxes, "color": QUIET, "fontsize": SMALL, "va": "bottom"}
    write(axes, (0.0, 1.005), "← right turns", ha="left", **look)
    write(axes, (1.0, 1.005), "left turns →", ha="right", **look)
