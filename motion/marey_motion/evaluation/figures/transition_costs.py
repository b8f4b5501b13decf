"""Figure 7: what transitions cost over a trial, beside the speed that was wished."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from marey_motion.evaluation.figures.drawn import Sketch
from marey_motion.evaluation.figures.paper import COLOURS, INK, REFERENCE, SMALL, Place, add_panel, new_figure, write
from marey_motion.evaluation.figures.subjects import FigureOptions, Subject, TrialView, choose_trial, view_trial
from marey_motion.matching.record import Status


def draw_transition_costs(subjects: Sequence[Subject], trial: str | None, _options: FigureOptions) -> Sketch:
    """Speeds above, cost below, one line per subject; a tick under the cost is a switch to another place."""
    chosen = choose_trial(subjects, trial, ("switching", "circle"))
    views = [view_trial(subject, chosen.name) for subject in subjects]
    figure = new_figure(9.0, 4.6)
    above = add_panel(figure, Place(0.7, 3.05, 8.1, 1.2), title=chosen.name, y="speed (m/s)")
    below = add_panel(figure, Place(0.7, 0.55, 8.1, 2.2), x="time (s)", y="transition cost (m)")
    first = views[0]
    above.step(first.times_s, first.wished_speeds_m_s, where="post", color=REFERENCE, lw=1.8, label="wished")
    top = max(float(view.record.pose_cost.max(initial=0.0)) for view in views) or 1.0
    for number, view in enumerate(views):
        name = view.subject.label or "recorded"
        above.plot(view.times_s, view.speeds_m_s, color=COLOURS[number], lw=0.9, alpha=0.9, label=name)
        below.plot(view.times_s, view.record.pose_cost, color=COLOURS[number], lw=0.8, alpha=0.85)
        level = -(0.045 + 0.05 * number) * top
        switches = view.times_s[_switched(view)]
        below.plot(switches, np.full(len(switches), level), "|", color=COLOURS[number], ms=5, mew=0.8)
    write(below, (0.0, 1.02), "ticks below: switches to another place", transform=below.transAxes, va="bottom")
    for panel in (above, below):
        panel.set_xlim(0.0, float(first.times_s[-1]) if len(first.times_s) > 1 else 1.0)
        for change in _changes(first):
            panel.axvline(change, color=REFERENCE, lw=0.7, ls=(0, (3, 3)), zorder=1)
    above.set_ylim(0.0, None)
    above.tick_params(labelbottom=False)
    below.set_ylim(-0.05 * top * (len(views) + 1), 1.08 * top)
    legend = above.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=3, frameon=False, fontsize=SMALL)
    for text in legend.get_texts():
        text.set(color=INK, parse_math=False)
    return Sketch(figure, {"costs": _table(views)}, _caption(views))


def _switched(view: TrialView) -> np.ndarray:
    return np.flatnonzero(view.record.status == Status.REPLACING)


def _changes(view: TrialView) -> list[float]:
    """When the wished speed or turn rate changes, in seconds."""
    speeds, turns = view.wished_speeds_m_s, view.wished_turn_rates_deg_s
    return [float(view.times_s[tick + 1]) for tick in np.flatnonzero((np.diff(speeds) != 0) | (np.diff(turns) != 0))]


def _table(views: Sequence[TrialView]) -> dict[str, object]:
    table: dict[str, object] = {"time_s": views[0].times_s, "wished_speed_m_s": views[0].wished_speeds_m_s}
    for view in views:
        start = f"{view.subject.label}_" if view.subject.label else ""
        table[f"{start}speed_m_s"] = view.speeds_m_s
        table[f"{start}pose_cost_m"] = view.record.pose_cost
        table[f"{start}switched"] = (view.record.status == Status.REPLACING).astype(int)
    return table


def _caption(views: Sequence[TrialView]) -> str:
    parts = []
    for view in views:
        cost = view.record.pose_cost[np.isfinite(view.record.pose_cost)]
        name = f"{view.subject.label}: " if view.subject.label else ""
        switches = len(_switched(view))
        if len(cost):
            parts.append(
                f"{name}mean {cost.mean():.3f} m, 95 % below {np.quantile(cost, 0.95):.3f} m, {switches} switches"
            )
    text = (
        "Distance over the joints from each displayed pose to the next; peaks are switches between poses that differ. "
    )
    return f"{text}{'; '.join(parts)}."
