"""Figure 9: how often each clip was used, and how often the character switched."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from marey_motion.evaluation.figures.drawn import Sketch
from marey_motion.evaluation.figures.paper import (
    COLOURS,
    INK,
    QUIET,
    REFERENCE,
    SMALL,
    Place,
    add_panel,
    name_ticks,
    new_figure,
    write,
)
from marey_motion.evaluation.figures.subjects import FigureOptions, Subject, view_trial

ROW = 0.235
TRANSITIONS = "Transitions"


class _Use(NamedTuple):
    """Frames displayed of each clip by uid, names by uid, and transitions made."""

    ticks: dict[str, int]
    names: dict[str, str]
    transitions: int


def draw_usage(subjects: Sequence[Subject], trial: str | None, options: FigureOptions) -> Sketch:
    """Bars for the most used clips, one for the others, one for transitions; of the suite, or of one trial."""
    uses = [_use(subject, trial) for subject in subjects]
    order = _order(uses)
    shown, others = order[: options.most_clips], order[options.most_clips :]
    rows = len(shown) + bool(others) + 1
    thick = 0.8 / len(subjects)
    height = ROW * rows * (1.0 if len(subjects) == 1 else 1.35)
    figure = new_figure(8.6, height + 1.25)
    title = trial or ""
    panel = add_panel(figure, Place(2.55, 0.55, 5.2, height), title=title, x="frames displayed, or times switched")
    panel.grid(visible=False, axis="y")
    largest = max([1, *(value for use in uses for value in (*use.ticks.values(), use.transitions))])
    for number, (subject, use) in enumerate(zip(subjects, uses, strict=True)):
        values = [use.ticks.get(uid, 0) for uid in shown]
        if others:
            values.append(sum(use.ticks.get(uid, 0) for uid in others))
        values.append(use.transitions)
        largest = max(largest, *values)
        places = np.arange(rows) + (number - 0.5 * (len(subjects) - 1)) * thick
        colours = [COLOURS[number]] * len(shown) + [REFERENCE] * bool(others) + [COLOURS[4]]
        hatches = [""] * (rows - 1) + ["//" if number else ""]
        label = subject.label or None
        panel.barh(places, values, height=0.92 * thick, color=colours, hatch=hatches, edgecolor="none", label=label)
        total = sum(use.ticks.values())
        for place, value, is_clips in zip(places, values, [True] * (rows - 1) + [False], strict=True):
            share = f"  {100 * value / total:.1f} %" if is_clips and total else ""
            end = value if value or not options.logarithmic else 1
            panel.annotate(
                f"{value:,}{share}",
                (end, place),
                (4, 0),
                textcoords="offset points",
                va="center",
                fontsize=SMALL,
                color=QUIET,
            )
    names = [next(use.names[uid] for use in uses if uid in use.names) for uid in shown]
    if others:
        names.append(f"{len(others)} other clip{'s' if len(others) > 1 else ''}")
    name_ticks(panel, range(rows), [*names, TRANSITIONS])
    panel.set_ylim(rows - 0.4, -0.6)
    if options.logarithmic:
        panel.set_xscale("log")
        panel.set_xlim(1, 4 * largest)
    else:
        panel.set_xlim(0, 1.2 * largest)
    if len(subjects) > 1:
        _draw_keys(panel, subjects)
    return Sketch(figure, {"usage": _table(subjects, uses, order)}, _caption(subjects, uses))


def _use(subject: Subject, trial: str | None) -> _Use:
    result = subject.result
    names = {clip.uid: clip.name for clip in result.clips}
    if trial is None:
        ticks = {result.clips[usage.clip].uid: int(usage.ticks) for usage in result.usage}
        return _Use(ticks, names, int(result.switches[:, 2].sum()) if len(result.switches) else 0)
    view = view_trial(subject, trial)
    counts = np.bincount(subject.clips_of(view.record.rows), minlength=len(result.clips))
    made = view.outcome.metrics.get("transitions")
    return _Use(dict(zip((clip.uid for clip in result.clips), counts.tolist(), strict=True)), names, int(made or 0))


def _order(uses: Sequence[_Use]) -> list[str]:
    """Clips by what all subjects display of them, most first; then by uid. Unused ones are none of the picture."""
    totals: dict[str, int] = {}
    for use in uses:
        for uid, ticks in use.ticks.items():
            totals[uid] = totals.get(uid, 0) + ticks
    return sorted((uid for uid, ticks in totals.items() if ticks), key=lambda uid: (-totals[uid], uid))


def _draw_keys(panel: object, subjects: Sequence[Subject]) -> None:
    from matplotlib.patches import Patch

    keys = [Patch(color=COLOURS[number], label=subject.label) for number, subject in enumerate(subjects)]
    legend = panel.legend(  # type: ignore[attr-defined]
        handles=keys, loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2, frameon=False, fontsize=SMALL
    )
    for text in legend.get_texts():
        text.set(color=INK, parse_math=False)


def _table(subjects: Sequence[Subject], uses: Sequence[_Use], order: Sequence[str]) -> dict[str, object]:
    unused = sorted({uid for use in uses for uid in use.ticks} - set(order))
    uids = [*order, *unused]
    names = [next(use.names[uid] for use in uses if uid in use.names) for uid in uids]
    table: dict[str, object] = {"clip": [*uids, ""], "name": [*names, TRANSITIONS]}
    for subject, use in zip(subjects, uses, strict=True):
        start = f"{subject.label}_" if subject.label else ""
        table[f"{start}frames"] = [*(use.ticks.get(uid) for uid in uids), use.transitions]
    return table


def _caption(subjects: Sequence[Subject], uses: Sequence[_Use]) -> str:
    parts = []
    for subject, use in zip(subjects, uses, strict=True):
        used = sum(1 for ticks in use.ticks.values() if ticks)
        name = f"{subject.label}: " if subject.label else ""
        parts.append(
            f"{name}{used} of {len(use.ticks)} clips used over {sum(use.ticks.values()):,} displayed frames, "
            f"{use.transitions:,} transitions between them."
        )
    return "How often a frame of each clip was displayed. " + " ".join(parts)
