"""Axes of the charts of a comparison: titles with units, logarithmic scales and limits."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import TYPE_CHECKING

from marey_reports.drawing.paper import HAIRLINE, Place, add_panel, plain, shortened
from marey_schemas.queue.comparisons import FieldSummary

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure
    from matplotlib.transforms import Transform

UNITS = {
    "m": "m", "cm": "cm", "mm": "mm", "km": "km", "s": "s", "ms": "ms", "min": "min", "h": "h", "hz": "Hz", "kg": "kg",
    "deg": "°", "rad": "rad", "percent": "%", "mb": "MB", "gb": "GB", "bytes": "bytes", "mps": "m/s", "fps": "frames/s",
}  # fmt: skip
"""Symbols of units, by the last part of a field's name, such as `m` in `path_m`."""


_REACH = 0.4
"""Largest share of an axis's length by which each end of the axis is extended to show intervals."""


def add_chart(figure: Figure, place: Place, *, title: str, x: str, y: str = "") -> Axes:
    """Add a panel to a figure, and write its texts literally: dollar signs do not begin mathematical notation."""
    panel = add_panel(figure, place, title=title, x=plain(x), y=plain(y))
    for axis in (panel.xaxis, panel.yaxis):
        axis.label.set_parse_math(False)
    return panel


def axis_title(name: str, *, log: bool = False) -> str:
    """Return the title of an axis: `path_m` becomes `path (m)`."""
    stem, _, unit = name.rpartition("_")
    known = UNITS.get(unit.lower()) if stem else None
    title = shortened(name if known is None else f"{re.sub('_+', ' ', stem)} ({known})")
    return f"{title}, logarithmic" if log else title


def set_logarithmic(axis: Axis) -> None:
    """Make an axis logarithmic, with readable numbers at its ticks."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    axis._set_axes_scale("log")  # pyrefly: ignore[missing-attribute]  # matplotlib has no public function for one axis
    low, high = axis.get_view_interval()
    if high / low < 50.0:
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:.4g}"))
    axis.set_minor_formatter(NullFormatter())
    axis.set_tick_params(which="minor", color=HAIRLINE)


def spread(low: float, high: float, *, log: bool) -> tuple[float, float]:
    """Return the ends of an axis around the lowest and the highest number, with a margin."""
    if log:
        factor = max(high / low, 1.2) ** 0.06
        return low / factor, high * factor
    margin = 0.06 * (high - low) or 0.1 * abs(high) or 1.0
    return low - margin, high + margin


def widened(low: float, high: float, summaries: Sequence[FieldSummary]) -> tuple[float, float]:
    """Extend the ends of an axis so that the intervals of means fit; wide intervals may still be cut off."""
    ends = [end for one in summaries for end in (one.low, one.high) if end is not None]
    reach = _REACH * (high - low)
    return max(min([low, *ends]), low - reach), min(max([high, *ends]), high + reach)


def beside(axes: Axes, transform: Transform, inches: float) -> Transform:
    """Return `transform` followed by a shift of `inches` to the right on the page."""
    from matplotlib.transforms import ScaledTranslation

    figure = axes.get_figure(root=True)
    if figure is None:
        raise ValueError("the axes do not belong to a figure")
    return transform + ScaledTranslation(inches, 0.0, figure.dpi_scale_trans)
