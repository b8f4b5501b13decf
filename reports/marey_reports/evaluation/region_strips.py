"""Chapter of the report that shows poses of trials of each region: the worst, a typical and the best one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from marey_motion.clip import Clip
from marey_motion.evaluation.judgement import REGIONS, Region, TrialVerdict, judge
from marey_motion.evaluation.result import EvaluationResult
from marey_motion.evaluation.scenario import demand
from marey_motion.matching.record import TrialRecord
from marey_reports.drawing.drawn import DrawnFigure, Sketch
from marey_reports.drawing.markup import element
from marey_reports.drawing.page import Section, shown
from marey_reports.drawing.strips import PoseRow, draw_even_poses, even_frames
from marey_reports.drawing.tables import table
from marey_reports.evaluation.sentences import failing
from marey_schemas.documents.worst_first import middle_of

Role = Literal["worst", "typical", "best", "only"]


@dataclass(frozen=True, eq=False)
class PosedTrial:
    """Trial of which a report shows poses.

    Parameters
    ----------
    region : region of the trial
    role : why the trial was chosen among those of its region
    verdict : the trial with its checks
    poses : frames of the displayed motion at even intervals, each as a clip of one frame
    """

    region: Region
    role: Role
    verdict: TrialVerdict
    poses: tuple[Clip, ...]


def choose_by_region(result: EvaluationResult) -> list[tuple[Region, Role, TrialVerdict, TrialRecord]]:
    """Choose the worst, the middle and the best trial of each region; none without records.

    The middle trial is the one in the middle of the order from worst to best. A region with two trials has no middle
    trial, and the role of the only trial of a region is "only".
    """
    if not result.records:
        return []
    record_of = {each.trial.name: record for each, record in zip(result.trials, result.records, strict=True)}
    ranked = judge(result).ranked
    return [
        (region, role, one, record_of[one.outcome.trial.name])
        for region in REGIONS
        for role, one in _in_roles([each for each in ranked if each.region == region])
    ]


def _in_roles(ranked: list[TrialVerdict]) -> list[tuple[Role, TrialVerdict]]:
    if len(ranked) < 2:
        return [("only", one) for one in ranked]
    typical: list[tuple[Role, TrialVerdict]] = [("typical", middle_of(ranked[1:-1]))] if len(ranked) > 2 else []
    return [("worst", ranked[0]), *typical, ("best", ranked[-1])]


def poses_of(clip: Clip) -> tuple[Clip, ...]:
    """Return frames of a clip at even intervals, each as a clip of one frame."""
    return tuple(clip.sliced(frame, frame + 1) for frame in even_frames(clip.frame_count))


def region_chapter(posed: Sequence[PosedTrial]) -> Section:
    """Write the chapter on regions: a picture with a row of poses for each trial in `posed`, and a table of them."""
    text = element(
        "p",
        "For each region, poses at even intervals of the trial that exceeds its limits most, of one in the middle of "
        "the order from worst to best, and of the best one.",
    )
    figures = {"region-poses": DrawnFigure(_draw(posed), "region-poses", "", "Poses of trials of each region")}
    rows = [(f"{one.region}: {one.role}", demand(one.verdict.outcome.trial), _problem(one.verdict)) for one in posed]
    named = table("The trials of the picture", ("region", "trial", "greatest error"), rows, numbers=(), sortable=False)
    return Section("regions", "What each region looks like", (text, shown(figures, "region-poses"), named))


def _draw(posed: Sequence[PosedTrial]) -> Sketch:
    rows = [PoseRow(f"{one.region}: {one.role}", one.verdict.outcome.trial.name, one.poses) for one in posed]
    chosen: dict[str, object] = {
        "region": [one.region for one in posed],
        "role": [one.role for one in posed],
        "trial": [one.verdict.outcome.trial.name for one in posed],
        "worst_measure": [one.verdict.worst.measure for one in posed],
        "strain": [one.verdict.worst.strain for one in posed],
    }
    return Sketch(draw_even_poses(rows), {"trials": chosen}, "Each body is seen from its front left.")


def _problem(verdict: TrialVerdict) -> str:
    return "within all limits" if verdict.followed else failing(verdict)
