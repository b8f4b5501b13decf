"""Motion maps of two clips: with the period and the registration curve, and by component.

The figures follow figures 1 and 6 of Pražák et al.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from marey_motion.arrays import Floats
from marey_motion.perception.cycles import Period
from marey_motion.perception.maps import component_map, motion_map
from marey_motion.perception.measuring import MeasuredClip
from marey_motion.perception.metric import PerceptualMetric
from marey_motion.perception.registration import RegistrationCurve
from marey_reports.drawing.drawn import Sketch
from marey_reports.drawing.paper import (
    LIGHT,
    MORE_IS_WORSE,
    SIDE,
    Place,
    add_colour_bar,
    add_keys,
    add_panel,
    differing_parts,
    new_figure,
    shortened,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.image import AxesImage

PATH, PERIOD = "#d7191c", "#2c7fb8"
_LEFT, _BOTTOM, _GAP, _BAR = 0.75, 0.72, 0.62, 0.12
_HIGHEST = 0.98
_LONGEST = 22


class NamedClip(NamedTuple):
    """Measured clip, with the name that readers see."""

    name: str
    clip: MeasuredClip


def draw_registration(
    one: NamedClip,
    other: NamedClip,
    metric: PerceptualMetric,
    period: Period | None,
    curve: RegistrationCurve,
    *,
    recorded: NamedClip | None = None,
    rate_hz: float | None = None,
) -> Sketch:
    """Draw two motion maps: of a clip and itself, with its period, and of two clips, with their registration curve.

    The figure follows figure 1 of Pražák et al.

    `recorded` is the clip in which the period was found, by default the clip `one`. Without a period, only the map of
    the two clips is drawn. `rate_hz` is the frame rate of period and curve, by default the frame rate of the clip
    `one`; the clips may have lower frame rates.
    """
    rate = rate_hz or one.clip.rate_hz
    pairs = [(one, other)] if period is None else [(recorded or one, recorded or one), (one, other)]
    maps = [motion_map(first.clip, second.clip, metric) for first, second in pairs]
    figure, panels, images = _panels(maps, pairs, [""] * len(pairs))
    for panel in panels:
        panel.autoscale(enable=False)
    tables: dict[str, dict[str, Floats]] = {}
    caption = f"Perceptual distance of every pair of moments, by the metric {metric.name}. "
    if period is not None:
        own = pairs[0][0]
        _draw_period(panels[0], own, period, rate)
        tables["lags"] = {"lag_s": period.lags / rate, "distance": period.differences}
        caption += (
            f"Left: {own.name} with itself; moments that are a period of {period.frames / rate:.2f} s apart look "
            "alike. Right: "
        )
    frames = np.arange(len(curve.times))
    there = curve.times % (other.clip.frame_count * rate / other.clip.rate_hz) if other.clip.cyclic else curve.times
    # A curve that goes on over the seam of a cycle is drawn in parts.
    parts = np.split(frames, np.flatnonzero(np.diff(there) < 0) + 1)
    for number, part in enumerate(parts):
        _line(panels[-1], part / rate, there[part] / rate, PATH, "same moment" if number == 0 else "")
    for panel in panels:
        add_keys(panel, loc="upper left", bbox_to_anchor=(-0.02, -0.17), ncols=2, handlelength=1.4, columnspacing=1.2)
    _bar(figure, images[-1], len(maps) - 1)
    caption += (
        f"{one.name} and {other.name}; the curve joins moments of the same phase. The mean over the steps of the "
        f"alignment, of which the curve is a smooth form, is {curve.mean_cost:.2f}; the distance of the two clips is "
        "another quantity, the mean along the curves of both directions."
    )
    tables["curve"] = {"first_s": frames / rate, "second_s": curve.times / rate}
    return Sketch(figure, tables, caption)


def _draw_period(panel: Axes, own: NamedClip, period: Period, rate: float) -> None:
    length_s, last_s = period.frames / rate, (own.clip.frame_count - 1) / own.clip.rate_hz
    _line(panel, [0.0, last_s - length_s], [length_s, last_s], PATH, "one period apart")
    start_s = period.start / rate
    _line(panel, [start_s, start_s], [start_s, start_s + length_s], PERIOD, "period")


def draw_components(one: NamedClip, other: NamedClip, metric: PerceptualMetric) -> Sketch:
    """Draw the motion map of each component of a metric, and of the whole metric (figure 6 of Pražák et al.)."""
    maps = [component_map(one.clip, other.clip, metric, component) for component in metric.components]
    maps.append(motion_map(one.clip, other.clip, metric))
    titles = [component.measurement for component in metric.components] + ["all together"]
    figure, _, images = _panels(maps, [(one, other)] * len(maps), titles)
    _bar(figure, images[-1], len(maps) - 1)
    caption = (
        f"Perceptual distance of every pair of moments of {one.name} and {other.name}, by each component of the metric "
        f"{metric.name} and by all of them. All maps have one scale: the component with the greatest distances has the "
        "greatest influence on the whole."
    )
    shares = [*metric.shares, 1.0]
    table = {"component": titles, "share": shares, "mean_distance": [float(each.mean()) for each in maps]}
    return Sketch(figure, {"components": table}, caption)


def _panels(
    maps: list[Floats], clips: list[tuple[NamedClip, NamedClip]], titles: list[str]
) -> tuple[Figure, list[Axes], list[AxesImage]]:
    """Draw maps side by side on one scale; time of the first clip runs to the right, time of the second one upwards."""
    ceiling = max(float(np.quantile(each, _HIGHEST)) for each in maps) or 1.0
    figure = new_figure(_LEFT + len(maps) * (SIDE + _GAP) + 0.45, _BOTTOM + SIDE + 0.5)
    panels, images = [], []
    known = list(dict.fromkeys(each.name for pair in clips for each in pair))
    labels = dict(zip(known, (shortened(name, _LONGEST) for name in differing_parts(known)), strict=True))
    for number, (values, pair, title) in enumerate(zip(maps, clips, titles, strict=True)):
        names = [labels[each.name] for each in pair]
        place = Place(_LEFT + number * (SIDE + _GAP), _BOTTOM, SIDE, SIDE)
        panel = add_panel(figure, place, title=title, grid=False, x=f"{names[0]} (s)", y=f"{names[1]} (s)")
        ends = [(each.clip.frame_count - 0.5) / each.clip.rate_hz for each in pair]
        begins = [-0.5 / each.clip.rate_hz for each in pair]
        images.append(
            panel.imshow(values.T, origin="lower", aspect="auto", cmap=MORE_IS_WORSE, vmin=0.0, vmax=ceiling,
                         extent=(begins[0], ends[0], begins[1], ends[1]), interpolation="antialiased")
        )  # fmt: skip
        panels.append(panel)
    return figure, panels, images


def _bar(figure: Figure, image: AxesImage, last: int) -> None:
    place = Place(_LEFT + last * (SIDE + _GAP) + SIDE + 0.15, _BOTTOM, _BAR, SIDE)
    add_colour_bar(figure, image, place, "perceptual distance")


def _line(panel: Axes, x: Floats | list[float], y: Floats | list[float], colour: str, label: str) -> None:
    """Draw a line that is visible on light and dark backgrounds."""
    panel.plot(x, y, color=LIGHT, lw=3.4, solid_capstyle="round")
    panel.plot(x, y, color=colour, lw=1.7, solid_capstyle="round", label=label or None)
