"""Chapter of the report that shows the motion of the worst trial and of a typical one, beside the desired path."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

from marey_motion.arrays import Floats
from marey_motion.clip import Clip
from marey_motion.evaluation.judgement import TrialVerdict, judge
from marey_motion.evaluation.result import EvaluationResult
from marey_motion.evaluation.scenario import demand, reference
from marey_motion.matching.record import TrialRecord
from marey_reports.drawing.drawn import DrawnFigure, Sketch
from marey_reports.drawing.markup import Html, element, joined
from marey_reports.drawing.page import Section, shown
from marey_reports.drawing.paper import (
    COLOURS,
    INK,
    PAPER,
    QUIET,
    REFERENCE,
    Place,
    add_keys,
    add_panel,
    new_figure,
    write,
)
from marey_reports.drawing.strips import PoseRow, draw_pose_rows
from marey_reports.evaluation.sentences import failing
from marey_schemas.documents.worst_first import middle_of
from marey_schemas.wording import counted

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

STRIP_POSES = 8
"""Number of poses in the strip of a trial."""
MARKED_EVERY_S = (1.0, 2.0, 5.0, 10.0, 20.0, 30.0, 60.0)
MOST_MARKS = 8
BEHIND_TIME = {"facecolor": PAPER, "alpha": 0.75, "lw": 0, "pad": 0.8}
MAP_IN = 4.2
"""Side of the map of a trial, in inches."""


@dataclass(frozen=True, eq=False)
class PlayedTrial:
    """Trial whose motion a report shows.

    Parameters
    ----------
    role : why the trial was chosen
    verdict : the trial with its checks
    record : every tick of the trial
    clip : the displayed motion, one frame for each tick
    packed : the same motion for the player: the JSON text that `web/src/motion/packed.ts` reads, without any "<"
    """

    role: Literal["worst", "typical"]
    verdict: TrialVerdict
    record: TrialRecord
    clip: Clip
    packed: str


def choose_played(
    result: EvaluationResult,
) -> list[tuple[Literal["worst", "typical"], TrialVerdict, TrialRecord]]:
    """Choose the worst trial and the one in the middle of the order from worst to best; none without records."""
    if not result.records:
        return []
    ranked = list(judge(result).ranked)
    names = [each.trial.name for each in result.trials]
    chosen: list[tuple[Literal["worst", "typical"], TrialVerdict]] = [("worst", ranked[0])]
    if len(ranked) > 1:
        chosen.append(("typical", middle_of(ranked[1:])))
    return [(role, one, result.records[names.index(one.outcome.trial.name)]) for role, one in chosen]


def played_chapter(played: Sequence[PlayedTrial], total: int) -> Section:
    """Write the chapter: for each trial its problem, the player, a map of its paths, and a strip of poses."""
    text = element(
        "p",
        f"{counted(len(played), 'trial')} of {total}: the worst, and a typical one from the middle of the order from "
        "worst to best. In the maps, a thin line leads from the desired place to the place of the character at the "
        "same moment.",
    )
    return Section("motion", "What it looks like", (text, *(_trial(one) for one in played)))


def _trial(one: PlayedTrial) -> Html:
    trial = one.verdict.outcome.trial
    problems = list(dict.fromkeys(check.measure for check in one.verdict.exceeded))
    beyond = f"Beyond the limits: {', '.join(problems)}." if problems else "All measures are within the limits."
    worst = f" Worst: {failing(one.verdict)}." if problems else ""
    figures = {
        f"{one.role}-path": DrawnFigure(_draw_map(one), f"{one.role}-path", "", f"Paths of the {one.role} trial"),
        f"{one.role}-poses": DrawnFigure(_draw_strip(one), f"{one.role}-poses", "", f"Poses of the {one.role} trial"),
    }
    seconds = one.clip.frame_count / one.clip.frame_rate_hz
    player = element(
        "div",
        element("script", Html(one.packed), type="application/json"),
        class_="player",
        hidden="",
        data_label=f"Play {seconds:.0f} s of the {one.role} trial",
    )
    path, poses = (shown(figures, name) for name in figures)
    return joined(
        (
            element("h3", f"The {one.role} trial: {demand(trial)}"),
            element("p", f"{beyond}{worst}"),
            element("div", player, path, class_="pair watched"),
            poses,
        )
    )


def _draw_map(one: PlayedTrial) -> Sketch:
    """Draw the desired path and the path of the character from above, with the time along both."""
    guide = reference(one.verdict.outcome.trial, look_ahead_s=0.0)
    ticks = min(len(guide.positions), len(one.record.positions))
    desired, simulated = guide.positions[:ticks], one.record.positions[:ticks]
    marks = _marks(ticks, one.record.rate_hz)
    figure = new_figure(MAP_IN + 0.9, MAP_IN + 1.0)
    panel = add_panel(figure, Place(0.7, 0.8, MAP_IN, MAP_IN), x="x (m, left positive)", y="z (m)")
    for start, stop in zip(desired[marks], simulated[marks], strict=True):
        panel.plot(*np.stack((start, stop)).T, color=QUIET, lw=0.6, zorder=1)
    for path, colour, label, width in ((desired, REFERENCE, "desired", 1.8), (simulated, COLOURS[0], "simulated", 1.2)):
        panel.plot(*path.T, color=colour, lw=width, label=label, zorder=2)
        panel.plot(*path[marks].T, "o", color=colour, ms=4, zorder=3)
    panel.plot(*desired[0], "o", color=INK, ms=6, zorder=4)
    _fit(panel, np.concatenate((desired, simulated)))
    _write_times(panel, desired, marks, one.record.rate_hz)
    add_keys(panel, loc="upper center", bbox_to_anchor=(0.5, -0.115), ncols=2)
    table = {
        "time_s": np.arange(ticks) / one.record.rate_hz,
        **{
            f"{name}_{axis}_m": path[:, column]
            for name, path in (("desired", desired), ("simulated", simulated))
            for column, axis in enumerate("xz")
        },
    }
    apart = np.linalg.norm(desired - simulated, axis=1)
    caption = (
        f"Seen from above, from the largest dot on; numbers are seconds. Over the whole path, with the approach, the "
        f"character is {apart.mean():.2f} m from the desired place on average, at most {apart.max():.2f} m."
    )
    return Sketch(figure, {"paths": table}, caption)


def _marks(ticks: int, rate_hz: float) -> list[int]:
    """Choose ticks at whole seconds, at most `MOST_MARKS` and evenly spaced, without the first tick."""
    seconds = (ticks - 1) / rate_hz
    every = next((step for step in MARKED_EVERY_S if seconds / step <= MOST_MARKS), max(seconds / MOST_MARKS, 1.0))
    return [round(number * every * rate_hz) for number in range(1, int(seconds / every) + 1)]


def _fit(panel: Axes, points: Floats) -> None:
    """Show a square that contains all points; x grows to the left, as seen by somebody who looks along z."""
    low, high = points.min(axis=0), points.max(axis=0)
    centre, half = 0.5 * (low + high), 0.58 * max(float((high - low).max()), 0.5)
    panel.set(xlim=(centre[0] + half, centre[0] - half), ylim=(centre[1] - half, centre[1] + half))


def _write_times(panel: Axes, path: Floats, marks: Sequence[int], rate_hz: float) -> None:
    """Write the seconds beside the marks of the desired path; a time that would cover an earlier one is left out."""
    width = abs(panel.get_xlim()[1] - panel.get_xlim()[0])
    written: list[Floats] = []
    for mark in marks:
        if all(float(np.linalg.norm(path[mark] - other)) > 0.07 * width for other in written):
            written.append(path[mark])
            place = float(path[mark][0]) - 0.015 * width, float(path[mark][1]) + 0.028 * width
            write(panel, place, f"{mark / rate_hz:g}", color=INK, zorder=5, bbox=BEHIND_TIME)


def _draw_strip(one: PlayedTrial) -> Sketch:
    """Draw poses at even intervals, all seen from the front left of the body."""
    frames = [round(place) for place in np.linspace(0, one.clip.frame_count - 1, STRIP_POSES)]
    poses = [one.clip.sliced(frame, frame + 1) for frame in frames]
    row = PoseRow("", "", poses, headings_rad=np.zeros(len(poses)))
    times = [f"{frame / one.clip.frame_rate_hz:.1f} s" for frame in frames]
    figure: Figure = draw_pose_rows([row], ["after"] * len(frames), times)
    caption = f"{STRIP_POSES} poses at even intervals, each from the front left of the body."
    return Sketch(figure, {"moments": {"frame": frames}}, caption)
