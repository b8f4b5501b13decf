"""Figure 7 of Abichequer Sangalli et al. (2022): speeds and costs of transitions during a trial.

The speeds are in the upper panel, and the costs in the lower panel.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from marey_motion.evaluation.scenario import demand
from marey_reports.drawing.drawn import Sketch
from marey_reports.drawing.paper import COLOURS, REFERENCE, Place, add_keys, add_panel, new_figure, write
from marey_reports.evaluation.figures.subjects import FigureOptions, Subject, TrialView, choose_trial, view_trial

LEAST_TOP_M = 0.01
"""Least upper end of the axis of costs, in metres, so that rounding errors of a character at rest look like zero."""


def draw_transition_costs(subjects: Sequence[Subject], trial: str | None, _options: FigureOptions) -> Sketch:
    """Draw speeds above and costs below, with a line per subject; marks under the costs show where a search jumped."""
    chosen = choose_trial(subjects, trial, ("switching", "circle"))
    views = [view_trial(subject, chosen) for subject in subjects]
    first = views[0].series
    figure = new_figure(9.0, 4.6)
    above = add_panel(figure, Place(0.7, 3.05, 8.1, 1.2), title=demand(chosen), y="speed (m/s)")
    below = add_panel(figure, Place(0.7, 0.55, 8.1, 2.2), x="time (s)", y="transition cost (m)")
    above.step(first.times_s, first.wanted_speeds_m_s, where="post", color=REFERENCE, lw=1.8, label="desired")
    costs = [view.record.pose_cost[1:] for view in views]
    top = max([LEAST_TOP_M, *(float(np.nanmax(cost, initial=0.0)) for cost in costs)])
    for number, (view, cost) in enumerate(zip(views, costs, strict=True)):
        look: dict[str, Any] = {"color": COLOURS[number], "lw": 0.9, "alpha": 0.85}
        above.plot(view.series.times_s, view.series.speeds_m_s, label=view.subject.label or "simulated", **look)
        below.plot(view.series.times_s, cost, **look)
        switches = view.series.times_s[view.switched]
        level = np.full(len(switches), -(0.045 + 0.05 * number) * top)
        below.plot(switches, level, "|", color=COLOURS[number], ms=5, mew=0.8)
    write(below, (0.0, 1.02), "marks below: transitions to another frame", transform=below.transAxes, va="bottom")
    changes = first.times_s[1:][(np.diff(first.wanted_speeds_m_s) != 0) | (np.diff(first.wanted_turn_rates_rad_s) != 0)]
    for panel in (above, below):
        panel.set_xlim(0.0, float(first.times_s[-1]) if len(first.times_s) else 1.0)
        for change in changes:
            panel.axvline(change, color=REFERENCE, lw=0.7, ls=(0, (3, 3)), zorder=1)
    above.set_ylim(0.0, None)
    above.tick_params(labelbottom=False)
    below.set_ylim(-0.05 * top * (len(views) + 1), 1.08 * top)
    add_keys(above, loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=3)
    return Sketch(figure, {"costs": _table(views)}, _caption(views))


def _table(views: Sequence[TrialView]) -> dict[str, object]:
    first = views[0].series
    table: dict[str, object] = {"time_s": first.times_s, "wished_speed_m_s": first.wanted_speeds_m_s}
    for view in views:
        column = view.subject.column
        table[column("speed_m_s")] = view.series.speeds_m_s
        table[column("pose_cost_m")] = view.record.pose_cost[1:]
        table[column("switched")] = view.switched.astype(int)
    return table


def _caption(views: Sequence[TrialView]) -> str:
    parts = []
    for view in views:
        costs = view.record.pose_cost[1:]
        costs = costs[np.isfinite(costs)]
        switches = int(np.count_nonzero(view.switched))
        if len(costs):
            spread = f"mean {costs.mean():.3f} m, 95 % below {np.quantile(costs, 0.95):.3f} m"
            parts.append(f"{view.subject.prefix}{spread}, {switches} transitions")
    text = "Distance of each displayed pose from the previous one, summed over joints; peaks are jumps to other poses: "
    return f"{text}{'; '.join(parts)}."
