"""Last step of the demonstration: the evaluation of the retargeted locomotion."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from marey_client.cli.demo.versions import DemoVersion
from marey_client.handles.clips import ClipHandle
from marey_client.progress import Advance
from marey_client.project import ProjectHandle

NAME = "evaluation"
TRAVEL_M = 0.5
"""Least median horizontal displacement of the root of a locomotion clip within `TRAVEL_WINDOW_S`, in metres."""
TRAVEL_WINDOW_S = 1.0
"""Time in seconds over which the displacement of the root is measured."""
OPTIONS: dict[str, Any] = {
    "speeds_m_s": (1.0, 1.5, 2.0, 2.5, 3.0),
    "turn_rates_deg_s": (-100.0, -50.0, 0.0, 50.0, 100.0),
}
"""Options of the evaluation: every second speed and turn rate of the published suite, so 50 trials instead of 162."""


@dataclass(frozen=True)
class DemoEvaluation:
    """Result of the evaluation; `summary` is None if no clip is locomotion."""

    clips: int
    chosen: int
    summary: dict[str, Any] | None = None
    report: Path | None = None

    @property
    def sentence(self) -> str:
        """The result of the evaluation, in one sentence; if nothing was evaluated, the reason."""
        if self.summary is None:
            return f"None of {self.clips} retargeted clips is locomotion, so nothing was evaluated."
        return str(self.summary["verdict"])

    @property
    def selection(self) -> str:
        """A text that says which clips were evaluated, and by which rule these clips were chosen."""
        return (
            f"of {self.clips} retargeted clips: those whose root moves at least {TRAVEL_M:g} m within "
            f"{TRAVEL_WINDOW_S:g} s from at least half of the frames"
        )


def evaluate_locomotion(
    project: ProjectHandle,
    clips: Mapping[str, ClipHandle],
    version: DemoVersion | None,
    root: str,
    folder: Path,
    advance: Advance,
) -> DemoEvaluation:
    """Evaluate the locomotion clips among `clips`, with their content in `version`; write the report to `folder`.

    `clips` maps the paths of entries in the version to clips; `root` is the name of the root joint of all clips.
    Nothing is evaluated if no clip is locomotion, or if `version` is None.
    """
    chosen = []
    for done, (path, clip) in enumerate(clips.items()):
        advance("looking for locomotion", done, len(clips))
        if travels(clip, root):
            chosen.append(path)
    if not chosen or version is None:
        return DemoEvaluation(len(clips), 0)
    job = project.evaluate(version.places(chosen), name=NAME, **OPTIONS)
    found = project.evaluation(job, on_progress=lambda now: _show(now.progress, advance))
    return DemoEvaluation(len(clips), len(chosen), found.summary(), found.save_report(folder / "evaluation.html"))


def travels(clip: ClipHandle, root: str) -> bool:
    """Return whether the root's median horizontal displacement within `TRAVEL_WINDOW_S` is at least `TRAVEL_M`."""
    rate_hz = float(clip.item.summary["frame_rate_hz"])
    window = round(TRAVEL_WINDOW_S * rate_hz)
    if int(clip.item.summary["frames"]) <= window:
        return False
    places = clip.motion(joints=[root]).root_translations[:, [0, 2]]
    travelled = np.linalg.norm(places[window:] - places[:-window], axis=1)
    return bool(np.median(travelled) >= TRAVEL_M)


def _show(progress: Any, advance: Advance) -> None:
    if progress is not None:
        advance("evaluating", progress.done, progress.total)
