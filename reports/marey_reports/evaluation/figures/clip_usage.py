"""Figure 9 of Abichequer Sangalli et al. (2022): use of each clip, and number of transitions."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from marey_motion.arrays import AnyFloats
from marey_reports.drawing.drawn import Sketch
from marey_reports.drawing.paper import (
    COLOURS,
    QUIET,
    REFERENCE,
    SMALL,
    Place,
    add_keys,
    add_panel,
    name_ticks,
    new_figure,
)
from marey_reports.evaluation.figures.axes import ROW
from marey_reports.evaluation.figures.subjects import FigureOptions, Subject
from marey_schemas.wording import counted

if TYPE_CHECKING:
    from matplotlib.axes import Axes


TRANSITIONS = "Transitions"


class _Use(NamedTuple):
    """Use of clips in one evaluation: for each uid, ticks of display and name; and the total number of transitions."""

    ticks: dict[str, int]
    names: dict[str, str]
    transitions: int


def draw_usage(subjects: Sequence[Subject], trial: str | None, options: FigureOptions) -> Sketch:
    """Draw a bar for each of the most used clips, one bar for all other clips, and one for transitions.

    The bars are for one trial, or for the whole suite if `trial` is None.
    """
    uses = [_use(subject, trial) for subject in subjects]
    order = _order(uses)
    shown, others = order[: options.most_clips], order[options.most_clips :]
    rows = len(shown) + bool(others) + 1
    height = ROW * rows * (1.0 if len(subjects) == 1 else 1.35)
    figure = new_figure(8.6, height + (1.05 if trial or len(subjects) > 1 else 0.65))
    place = Place(2.55, 0.55, 5.2, height)
    panel = add_panel(figure, place, title=trial or "", x="displayed frames, or transitions")
    panel.grid(visible=False, axis="y")
    thick, largest = 0.8 / len(subjects), 1
    for number, use in enumerate(uses):
        values = [use.ticks.get(uid, 0) for uid in shown]
        values += [sum(use.ticks.get(uid, 0) for uid in others)] * bool(others)
        places = np.arange(rows) + (number - 0.5 * (len(subjects) - 1)) * thick
        _draw_bars(panel, places, values, use, number, 0.92 * thick, bool(others))
        largest = max(largest, use.transitions, *values, 0)
    names = [next(use.names[uid] for use in uses if uid in use.names) for uid in shown]
    rest = [counted(len(others), "other clip")] * bool(others)
    name_ticks(panel, range(rows), names, [*rest, TRANSITIONS])
    if options.logarithmic:
        panel.set_xscale("log")
    panel.set_xlim(*((0.8, 5.0 * largest) if options.logarithmic else (0, 1.2 * largest)))
    panel.xaxis.set_major_formatter("{x:,.0f}")
    panel.set_ylim(rows - 0.4, -0.6)
    if len(subjects) > 1:
        _draw_keys(panel, subjects)
    return Sketch(figure, {"usage": _table(subjects, uses, order)}, _caption(subjects, uses))


def _draw_bars(
    panel: Axes, places: AnyFloats, values: Sequence[int], use: _Use, number: int, thick: float, others: bool
) -> None:
    """Draw the labelled bars of the subject with index `number`.

    There is one bar for each listed clip, one for all remaining clips if `others` is true, and a hatched bar for
    transitions. `values` are the lengths of all bars except the bar for transitions. `places` are the positions of all
    bars, and `thick` is their thickness.
    """
    total = sum(use.ticks.values())
    colours = [COLOURS[number]] * (len(values) - others) + [REFERENCE] * others
    panel.barh(places[:-1], values, height=thick, color=colours, lw=0)
    panel.barh(
        places[-1:], [use.transitions], height=thick, color="none", edgecolor=COLOURS[number], hatch="////", lw=0.8
    )
    shares = [f" ({100 * value / total:.1f} %)" if total else "" for value in values] + [""]
    for place, value, share in zip(places, [*values, use.transitions], shares, strict=True):
        panel.annotate(
            f"{value:,}{share}", (max(value, 0.8), place), (4, 0), textcoords="offset points", va="center",
            fontsize=SMALL, color=QUIET,
        )  # fmt: skip


def _use(subject: Subject, trial: str | None) -> _Use:
    clips = subject.result.clips
    ticks = {clips[usage.clip].uid: usage.ticks for usage in subject.usage(trial)}
    trials = [each for each in subject.result.trials if trial in (None, each.trial.name)]
    made = sum(each.metrics.get("transitions") or 0.0 for each in trials)
    return _Use(ticks, {clip.uid: clip.name for clip in clips}, int(made))


def _order(uses: Sequence[_Use]) -> list[str]:
    """Sort clips by their total time of display in all subjects, longest first, then by uid; leave out unused clips."""
    totals: dict[str, int] = {}
    for use in uses:
        for uid, ticks in use.ticks.items():
            totals[uid] = totals.get(uid, 0) + ticks
    return sorted((uid for uid, ticks in totals.items() if ticks), key=lambda uid: (-totals[uid], uid))


def _draw_keys(panel: Axes, subjects: Sequence[Subject]) -> None:
    from matplotlib.patches import Patch

    keys = [Patch(color=COLOURS[number], label=subject.label) for number, subject in enumerate(subjects)]
    add_keys(panel, handles=keys, loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2)


def _table(subjects: Sequence[Subject], uses: Sequence[_Use], order: Sequence[str]) -> dict[str, object]:
    unused = sorted({uid for use in uses for uid in use.ticks} - set(order))
    uids = [*order, *unused]
    names = [next(use.names[uid] for use in uses if uid in use.names) for uid in uids]
    table: dict[str, object] = {"clip": [*uids, ""], "name": [*names, TRANSITIONS]}
    for subject, use in zip(subjects, uses, strict=True):
        table[subject.column("frames")] = [*(use.ticks.get(uid) for uid in uids), use.transitions]
    return table


def _caption(subjects: Sequence[Subject], uses: Sequence[_Use]) -> str:
    parts = []
    for subject, use in zip(subjects, uses, strict=True):
        used = sum(1 for ticks in use.ticks.values() if ticks)
        parts.append(
            f"{subject.prefix}{used} of {len(use.ticks)} clips used; {sum(use.ticks.values()):,} displayed frames, "
            f"{counted(use.transitions, 'transition')}."
        )
    return "Number of displayed frames of each clip. " + " ".join(parts)
