"""Figures 4a and 4b of Abichequer Sangalli et al. (2022): a trial and the path of the character from above.

The sections of the trial are numbered. Trials of families that the paper does not have are drawn in the same way.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from marey_motion.arrays import Floats
from marey_motion.evaluation.scenario import Reference, Trial, demand, reference
from marey_reports.drawing.drawn import Sketch
from marey_reports.drawing.paper import COLOURS, INK, PAPER, REFERENCE, SMALL, Place, add_keys, add_panel, new_figure
from marey_reports.evaluation.figures.subjects import FigureOptions, Subject, choose_trial, find_record
from marey_schemas.options.evaluation import Family

if TYPE_CHECKING:
    from matplotlib.axes import Axes


COURSES: tuple[Family, ...] = ("corners", "stopping", "eights", "strafing", "takes")
"""Families that `draw_course` draws."""
SIDE, GAP = 3.9, 0.75
# Where within a section its number may stand, the middle first.
NUMBER_PLACES = (0.5, 0.4, 0.6, 0.3, 0.7, 0.2, 0.8)


def draw_circle(subjects: Sequence[Subject], trial: str | None, _options: FigureOptions) -> Sketch:
    """Draw a trial with one speed throughout (Figure 4a)."""
    return _draw(subjects, trial, "circle")


def draw_switching(subjects: Sequence[Subject], trial: str | None, _options: FigureOptions) -> Sketch:
    """Draw a trial in which the speed changes from section to section (Figure 4b)."""
    return _draw(subjects, trial, "switching")


def draw_course(subjects: Sequence[Subject], trial: str | None, _options: FigureOptions) -> Sketch:
    """Draw a trial with stops, corners, a figure of eight, motion sideways or backwards, or the path of a take."""
    return _draw(subjects, trial, *COURSES)


def _draw(subjects: Sequence[Subject], name: str | None, *families: Family) -> Sketch:
    trial = choose_trial(subjects, name, families)
    guide = reference(trial, look_ahead_s=0.0)
    sections = _sections(trial, guide.tick_count, guide.rate_hz)
    followed = [_followed(subject, trial) for subject in subjects]
    limits = _limits([guide.positions, *(path for path in followed if path is not None)])
    figure = new_figure(0.75 + len(subjects) * (SIDE + GAP), SIDE + (1.15 if len(subjects) > 1 else 0.9))
    for number, (subject, path) in enumerate(zip(subjects, followed, strict=True)):
        place = Place(0.7 + number * (SIDE + GAP), 0.72, SIDE, SIDE)
        panel = add_panel(
            figure, place, title=subject.label, x="x (m, left positive)", y="z (m)" if number == 0 else ""
        )
        if path is not None:
            panel.plot(*path.T, color=COLOURS[number], lw=1.1, alpha=0.85, zorder=2, label="simulated")
        panel.plot(*guide.positions.T, color=REFERENCE, lw=1.8, zorder=3, label="desired")
        panel.plot(0.0, 0.0, "o", color=INK, ms=5, zorder=4)
        _number_sections(panel, guide.positions, sections, limits)
        panel.set(xlim=limits[0][::-1], ylim=limits[1])
        add_keys(panel, loc="upper center", bbox_to_anchor=(0.5, -0.115), ncols=2)
    tables = {"sections": _section_table(trial, sections, guide.rate_hz), "paths": _paths(guide, subjects, followed)}
    return Sketch(figure, tables, _caption(trial, sections, guide.rate_hz))


def _followed(subject: Subject, trial: Trial) -> Floats | None:
    """Return the path of the character in a trial, or None if no records were stored."""
    return find_record(subject, trial.name).positions if subject.result.records else None


def _sections(trial: Trial, ticks: int, rate_hz: float) -> list[tuple[int, int, float]]:
    """Return, for each section, the first tick, the tick after the last, and the speed in metres per second.

    The first section is the approach.
    """
    bounds = [0.0, trial.approach_s]
    end_s = ticks / rate_hz
    if (every_s := trial.changes_every_s) is not None:
        bounds += list(np.arange(trial.approach_s + every_s, end_s - 1e-9, every_s))
    edges = [*(round(bound * rate_hz) for bound in bounds), ticks]
    speeds = [
        trial.switch_speed_m_s if trial.changes_speed and number >= 2 and number % 2 == 0 else trial.speed_m_s
        for number in range(len(bounds))
    ]
    return [
        (start, stop, speed) for start, stop, speed in zip(edges[:-1], edges[1:], speeds, strict=True) if stop > start
    ]


def _limits(paths: Sequence[Floats]) -> tuple[tuple[float, float], tuple[float, float]]:
    """Compute the square that contains all paths; all panels show this square."""
    low = np.min([path.min(axis=0) for path in paths], axis=0)
    high = np.max([path.max(axis=0) for path in paths], axis=0)
    centre, half = 0.5 * (low + high), 0.56 * max(float((high - low).max()), 0.5)
    return (float(centre[0] - half), float(centre[0] + half)), (float(centre[1] - half), float(centre[1] + half))


def _number_sections(
    panel: Axes,
    path: Floats,
    sections: Sequence[tuple[int, int, float]],
    limits: tuple[tuple[float, float], tuple[float, float]],
) -> None:
    """Write the number of each section on the path, if possible away from the numbers that were written before."""
    span = limits[0][1] - limits[0][0]
    placed: list[Floats] = []
    for number, (start, stop, _) in enumerate(sections, start=1):
        candidates = [path[min(round(start + share * (stop - start)), len(path) - 1)] for share in NUMBER_PLACES]
        free = [_room(candidate, placed) for candidate in candidates]
        enough = next((index for index, room in enumerate(free) if room > 0.12 * span), int(np.argmax(free)))
        spot = candidates[enough]
        placed.append(spot)
        panel.text(
            float(spot[0]),
            float(spot[1]),
            str(number),
            fontsize=SMALL,
            color=INK,
            ha="center",
            va="center",
            zorder=6,
            fontweight="bold",
            bbox={"boxstyle": "circle,pad=0.25", "facecolor": PAPER, "edgecolor": REFERENCE, "linewidth": 0.8},
        )


def _room(spot: Floats, placed: Sequence[Floats]) -> float:
    return min((float(np.linalg.norm(spot - other)) for other in placed), default=np.inf)


def _section_table(trial: Trial, sections: Sequence[tuple[int, int, float]], rate_hz: float) -> dict[str, object]:
    turn_rate = float(np.degrees(trial.turn_rate_rad_s))
    return {
        "section": list(range(1, len(sections) + 1)),
        "start_s": [start / rate_hz for start, _, _ in sections],
        "stop_s": [stop / rate_hz for _, stop, _ in sections],
        "speed_m_s": [speed for _, _, speed in sections],
        "turn_rate_deg_s": [_turn_rate(trial, number, turn_rate) for number in range(len(sections))],
    }


def _turn_rate(trial: Trial, number: int, turn_rate: float) -> float:
    """Return the turn rate of section `number`; section 0 is the approach.

    `turn_rate` is the turn rate of the trial; the result has the same unit.
    """
    if number == 0 or (trial.family == "stopping" and number % 2 == 0):
        return 0.0
    return -turn_rate if trial.family == "eights" and number % 2 == 0 else turn_rate


def _paths(guide: Reference, subjects: Sequence[Subject], followed: Sequence[Floats | None]) -> dict[str, object]:
    table: dict[str, object] = {
        "time_s": np.arange(len(guide.positions)) / guide.rate_hz,
        "reference_x_m": guide.positions[:, 0],
        "reference_z_m": guide.positions[:, 1],
    }
    for subject, path in zip(subjects, followed, strict=True):
        if path is not None:
            table[subject.column("x_m")], table[subject.column("z_m")] = path[:, 0], path[:, 1]
    return table


def _caption(trial: Trial, sections: Sequence[tuple[int, int, float]], rate_hz: float) -> str:
    if trial.family in COURSES:
        return (
            f"Desired path from above, from the dot on: {sections[0][1] / rate_hz:g} s straight at "
            f"{trial.speed_m_s:.4g} m/s (1), then a {demand(trial)}."
        )
    turn = np.degrees(trial.turn_rate_rad_s)
    straight = sections[0][1] / rate_hz
    text = f"Desired path from above, from the dot on: {straight:g} s straight at {trial.speed_m_s:g} m/s (1), "
    side = "straight ahead" if turn == 0 else f"to the {'left' if turn > 0 else 'right'} at {abs(turn):g} deg/s"
    if trial.family == "switching":
        return (
            f"{text}then {side}, switching between {trial.speed_m_s:g} and {trial.switch_speed_m_s:g} m/s every "
            f"{trial.switch_every_s:g} s (2 to {len(sections)})."
        )
    return f"{text}then {side} at the same speed for {trial.duration_s:g} s (2)."
