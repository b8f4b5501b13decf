"""Figure 8 of Abichequer Sangalli et al. (2022): histograms of the errors of speed and turn rate.

One normal distribution, and a mixture of two, are fitted to the errors.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from marey_motion.arrays import AnyFloats
from marey_motion.errors import MotionError
from marey_motion.evaluation.scenario import demand
from marey_reports.drawing.drawn import Sketch
from marey_reports.drawing.paper import COLOURS, QUIET, REFERENCE, Place, add_keys, add_panel, new_figure
from marey_reports.evaluation.figures.mixtures import Normals, fit_one, fit_two
from marey_reports.evaluation.figures.subjects import FigureOptions, Subject, TrialView, choose_trial, view_trial

if TYPE_CHECKING:
    from matplotlib.axes import Axes


BINS = 48
LEAST_BIN = 0.001  # m/s or deg/s
FINE = 400
KEYS_POINTS = 32.0
"""Height of the keys between a panel and its title, in points."""


class _Errors(NamedTuple):
    """Errors of one quantity over a trial, and the two distributions fitted to them."""

    values: AnyFloats
    one: Normals
    two: Normals


def draw_errors(subjects: Sequence[Subject], trial: str | None, options: FigureOptions) -> Sketch:
    """Draw errors of speed on the left and of turn rate on the right: a row per subject, all with the same scales."""
    chosen = choose_trial(subjects, trial, ("switching", "circle"))
    views = [view_trial(subject, chosen) for subject in subjects]
    errors = [_errors(view, options.negate_errors) for view in views]
    meaning = "desired minus simulated" if options.negate_errors else "simulated minus desired"
    quantities = (
        (f"speed error (m/s), {meaning}", "m/s"),
        (f"turn rate error (deg/s, left positive), {meaning}", "deg/s"),
    )
    height, gap = (3.0, 0.0) if len(subjects) == 1 else (2.1, 1.0)
    figure = new_figure(9.6, len(subjects) * (height + gap) + 1.4 - gap)
    tables: dict[str, dict[str, list[object]]] = {
        "histogram": {name: [] for name in ("dataset", "quantity", "low", "high", "seconds")},
        "fits": {name: [] for name in ("dataset", "quantity", "components", "weight", "mean", "deviation")},
    }
    for column, (label, unit) in enumerate(quantities):
        edges = _edges([pair[column].values for pair in errors])
        panels = []
        for row, (view, pair) in enumerate(zip(views, errors, strict=True)):
            bottom = 0.6 + (len(subjects) - 1 - row) * (height + gap)
            last = row == len(subjects) - 1
            panel = add_panel(
                figure,
                Place(0.65 + 4.65 * column, bottom, 4.2, height),
                title=(view.subject.label or demand(chosen)) if column == 0 else "",
                x=label if last else "",
                y="seconds" if column == 0 else "",
                below_title=KEYS_POINTS,
            )
            heights = np.histogram(pair[column].values, edges)[0] / view.record.rate_hz
            _draw(panel, pair[column], edges, heights, view, COLOURS[row], unit)
            _tabulate(
                tables, view.subject.label, ("speed_m_s", "turn_rate_deg_s")[column], pair[column], edges, heights
            )
            panels.append(panel)
        top = max(panel.get_ylim()[1] for panel in panels)
        for panel in panels:
            panel.set_ylim(0.0, 1.03 * top)
    return Sketch(figure, tables, _caption(demand(chosen), views, errors))


def _errors(view: TrialView, negate: bool) -> tuple[_Errors, _Errors]:
    series, kept = view.series, view.evaluated
    if not kept.any():
        raise MotionError(
            "the figure cannot be drawn, because no step of the trial was evaluated",
            code="nothing-to-draw",
            where=view.trial.name,
        )
    sign = -1.0 if negate else 1.0
    speeds, turn_rates = (
        sign * (recorded - wished)[kept]
        for recorded, wished in (
            (series.speeds_m_s, series.wanted_speeds_m_s),
            (np.degrees(series.turn_rates_rad_s), np.degrees(series.wanted_turn_rates_rad_s)),
        )
    )
    switched = (series.wanted_speeds_m_s != view.trial.speed_m_s)[kept]
    return (
        _Errors(speeds, fit_one(speeds), fit_two(speeds, switched)),
        _Errors(turn_rates, fit_one(turn_rates), fit_two(turn_rates, switched)),
    )


def _edges(values: Sequence[AnyFloats]) -> AnyFloats:
    """Compute the edges of bins that contain all values but the lowest and highest thousandth; zero is an edge."""
    together = np.concatenate(values)
    low, high = np.quantile(together, (0.001, 0.999))
    low, high = min(float(low), 0.0), max(float(high), 0.0)
    width = max((high - low) / BINS, LEAST_BIN)
    first, last = int(np.floor(low / width)) - 1, int(np.ceil(high / width)) + 1
    return np.arange(first, last + 1) * width


def _draw(
    panel: Axes, errors: _Errors, edges: AnyFloats, heights: AnyFloats, view: TrialView, colour: str, unit: str
) -> None:
    panel.stairs(heights, edges, fill=True, color=colour, alpha=0.35, lw=0)
    seconds = len(errors.values) / view.record.rate_hz * (edges[1] - edges[0])
    fine = np.linspace(edges[0], edges[-1], FINE)
    looks: tuple[dict[str, Any], ...] = {"color": colour, "lw": 1.6}, {"color": QUIET, "lw": 1.2, "ls": (0, (4, 2))}
    for fit, name, look in zip((errors.two, errors.one), ("two normals", "one normal"), looks, strict=True):
        curve = np.minimum(seconds * fit.density(fine), 1.3 * heights.max())  # a collapsed component has no scale
        moments = "; ".join(
            f"{mean:+z.2f} ± {deviation:.2f}" for mean, deviation in zip(fit.means, fit.deviations, strict=True)
        )
        panel.plot(fine, curve, label=f"{name}: {moments} {unit}", **look)
    panel.axvline(0.0, color=REFERENCE, lw=0.8, zorder=1)
    panel.set_xlim(edges[0], edges[-1])
    add_keys(panel, loc="lower left", bbox_to_anchor=(-0.02, 1.0), borderaxespad=0.1)


def _tabulate(
    tables: dict[str, dict[str, list[object]]],
    label: str,
    quantity: str,
    errors: _Errors,
    edges: AnyFloats,
    heights: AnyFloats,
) -> None:
    for low, high, seconds in zip(edges[:-1], edges[1:], heights, strict=True):
        _append(tables["histogram"], (label, quantity, float(low), float(high), float(seconds)))
    for fit in (errors.one, errors.two):
        for parts in zip(fit.weights, fit.means, fit.deviations, strict=True):
            _append(tables["fits"], (label, quantity, len(fit.means), *(float(part) for part in parts)))


def _append(table: dict[str, list[object]], row: tuple[object, ...]) -> None:
    for column, value in zip(table.values(), row, strict=True):
        column.append(value)


def _caption(trial: str, views: Sequence[TrialView], errors: Sequence[tuple[_Errors, _Errors]]) -> str:
    parts = []
    for view, (speed, turn) in zip(views, errors, strict=True):
        parts.append(
            f"{view.subject.prefix}speed {speed.one.means[0]:+z.2f} ± {speed.one.deviations[0]:.2f} m/s, "
            f"turn rate {turn.one.means[0]:+z.1f} ± {turn.one.deviations[0]:.1f} deg/s"
        )
    text = f"Errors at every step of a {trial}. The mean is the static error, the width the dynamic error: "
    return f"{text}{'; '.join(parts)}."
