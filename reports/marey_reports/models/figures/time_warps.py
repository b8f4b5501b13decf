"""Figure of the time functions (time warps) of an alignment, which shows where each clip is faster or slower."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from marey_motion.alignment.aligned import AlignedSet
from marey_motion.arrays import Floats
from marey_reports.drawing.drawn import Sketch
from marey_reports.drawing.paper import (
    COLOURS,
    INK,
    REFERENCE,
    Place,
    add_keys,
    add_panel,
    differing_parts,
    new_figure,
    shortened,
)
from marey_reports.models.figures.canonical_time import CANONICAL_TIME, limit_above, mark_keyframes, percents
from marey_schemas.wording import counted

if TYPE_CHECKING:
    from matplotlib.axes import Axes


NAMED = 4
POINTS = 12_000
"""Greatest total number of points of all lines in a panel; more points could not be distinguished."""
TABLED = 100
SPEED_SPAN = (0.1, 10.0)


def draw_time_warps(aligned: AlignedSet) -> Sketch:
    """Draw time functions and speeds of all clips; the legend names the reference and the clips most unlike it."""
    times_s = aligned.time_functions / aligned.frame_rate_hz
    speeds = 1.0 / np.diff(aligned.time_functions, axis=1)
    reference = [clip.uid for clip in aligned.clips].index(aligned.reference)
    odd = _most_unlike(aligned, reference)
    names = [shortened(name, 26) for name in differing_parts([clip.name for clip in aligned.clips])]
    figure = new_figure(10.4, 4.1)
    left = add_panel(figure, Place(0.7, 0.65, 3.4, 2.9), x=CANONICAL_TIME, y="time in the clip (s)", title="time")
    right = add_panel(figure, Place(4.85, 0.65, 3.4, 2.9), x=CANONICAL_TIME, y="speed (2: twice that of the reference)",
                      title="speed")  # fmt: skip
    share = percents(aligned.frame_count)
    _draw_lines(left, share, times_s, reference, odd, names)
    _draw_lines(right, 0.5 * (share[1:] + share[:-1]), speeds, reference, odd, names)
    left.set(xlim=(0.0, 100.0), ylim=(0.0, limit_above(times_s.max(axis=0), aligned.keyframes, 2.9)))
    right.set(xlim=(0.0, 100.0), yscale="log", ylim=_speed_limits(speeds))
    _write_speeds(right)
    mark_keyframes(left, aligned.keyframes, aligned.frame_count)
    mark_keyframes(right, aligned.keyframes, aligned.frame_count, named=False)
    add_keys(right, loc="upper left", bbox_to_anchor=(1.0, 1.02))
    return Sketch(figure, {"time_functions": _table(aligned), "clips": _clips(aligned)}, _caption(aligned, reference))


def _most_unlike(aligned: AlignedSet, reference: int) -> list[int]:
    """Find the clips whose time functions, scaled to equal duration, differ most from that of the reference."""
    paths = aligned.time_functions / aligned.time_functions[:, -1:]
    apart = np.abs(paths - paths[reference]).max(axis=1)
    order = sorted(range(len(paths)), key=lambda place: (-apart[place], aligned.clips[place].uid))
    return [place for place in order if place != reference and apart[place] > 0.0][:NAMED]


def _draw_lines(
    panel: Axes, share: Floats, values: Floats, reference: int, odd: Sequence[int], names: list[str]
) -> None:
    points = int(np.clip(POINTS // len(values), 30, len(share)))
    chosen = np.unique(np.rint(np.linspace(0, len(share) - 1, points)).astype(np.int64))
    others = [place for place in range(len(values)) if place != reference and place not in odd]
    alpha = float(np.clip(4.0 / np.sqrt(max(len(others), 1)), 0.25, 0.9))
    for number, place in enumerate(others):
        label = "other clips" if number == 0 else None
        panel.plot(share[chosen], values[place, chosen], color=REFERENCE, lw=0.8, alpha=alpha, label=label)
    for number, place in enumerate(odd):
        panel.plot(share[chosen], values[place, chosen], color=COLOURS[number], lw=1.3, label=names[place])
    panel.plot(share[chosen], values[reference, chosen], color=INK, lw=1.6, ls=(0, (4, 2)), label="reference")


def _speed_limits(speeds: Floats) -> tuple[float, float]:
    low, high = np.quantile(speeds, (0.002, 0.998))
    return max(SPEED_SPAN[0], min(0.5, 0.9 * float(low))), min(SPEED_SPAN[1], max(2.0, 1.1 * float(high)))


def _write_speeds(panel: Axes) -> None:
    low, high = panel.get_ylim()
    ticks = [tick for tick in (0.1, 0.2, 0.25, 0.5, 1.0, 2.0, 4.0, 5.0, 10.0) if low <= tick <= high]
    panel.set_yticks(ticks, [f"{tick:g}" for tick in ticks])
    panel.set_yticks([], minor=True)


def _table(aligned: AlignedSet) -> dict[str, object]:
    frames = np.unique(np.rint(np.linspace(0, aligned.frame_count - 1, TABLED)).astype(np.int64))
    return {
        "clip": [clip.uid for clip in aligned.clips for _ in frames],
        "canonical_frame": np.tile(frames, len(aligned.clips)),
        "source_frame": aligned.time_functions[:, frames].ravel(),
    }


def _clips(aligned: AlignedSet) -> dict[str, object]:
    return {
        "clip": [clip.uid for clip in aligned.clips],
        "name": [clip.name for clip in aligned.clips],
        "duration_s": aligned.time_functions[:, -1] / aligned.frame_rate_hz,
        "mean_cost_m2": [clip.cost for clip in aligned.clips],
    }


def _caption(aligned: AlignedSet, reference: int) -> str:
    durations = aligned.time_functions[:, -1] / aligned.frame_rate_hz
    keyframes = (
        f" Dotted lines mark the {counted(len(aligned.keyframes), 'keyframe')} that all share."
        if aligned.keyframes
        else ""
    )
    return (
        f"Alignment of {counted(len(aligned.clips), 'clip')} of {durations.min():.2f} to {durations.max():.2f} s with "
        f"the reference {aligned.clips[reference].name}. Left: the moment of each clip at each moment of canonical "
        "time. Right: the speed of the clip there, relative to the reference. The clips whose timing differs most "
        f"from that of the reference are in colour.{keyframes}"
    )
