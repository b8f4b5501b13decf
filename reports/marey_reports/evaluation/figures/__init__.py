"""Figures of one or two evaluations: the figures of Abichequer Sangalli et al. (2022), and a few more.

matplotlib is loaded when the first figure is drawn. The same result gives the same bytes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple, get_args

from marey_motion.errors import MotionError
from marey_motion.evaluation.result import EvaluationResult
from marey_reports.drawing.drawn import DrawnFigure, Sketch
from marey_reports.evaluation.figures.clip_graph import draw_clip_graph
from marey_reports.evaluation.figures.clip_usage import draw_usage
from marey_reports.evaluation.figures.coverage_points import draw_points
from marey_reports.evaluation.figures.density import draw_density, draw_directions
from marey_reports.evaluation.figures.errors import draw_errors
from marey_reports.evaluation.figures.frame_use import draw_frame_use
from marey_reports.evaluation.figures.holes import draw_holes
from marey_reports.evaluation.figures.offsets import FAMILY_TITLES, draw_offsets
from marey_reports.evaluation.figures.scenarios import COURSES, draw_circle, draw_course, draw_switching
from marey_reports.evaluation.figures.subjects import FigureOptions, Subject
from marey_reports.evaluation.figures.transition_costs import draw_transition_costs
from marey_schemas.options.evaluation import Family

__all__ = [
    "COVERAGE_FIGURES",
    "FIGURES",
    "SCENARIO_FIGURES",
    "SHARED_FIGURES",
    "TRIAL_FIGURES",
    "USE_FIGURES",
    "DrawnFigure",
    "FigureKind",
    "FigureOptions",
    "draw_figure",
    "draw_figures",
    "draw_shared_figures",
    "drawable",
]


class FigureKind(NamedTuple):
    """A figure that can be drawn.

    Parameters
    ----------
    number : number of the figure in Abichequer Sangalli et al. (2022), or "" if that paper does not have the figure
    trials : "one": the figure shows one trial; "any": one trial or all trials; "none": always all trials
    families : families of trials that the figure can show
    draw : function that draws the figure for one or two subjects
    """

    number: str
    title: str
    trials: str
    draw: Callable[[Sequence[Subject], str | None, FigureOptions], Sketch]
    families: tuple[Family, ...] = get_args(Family)


PUBLISHED: tuple[Family, ...] = ("circle", "switching")
"""Families of trials in Abichequer Sangalli et al. (2022)."""

FIGURES = {
    "points": FigureKind("1", "Speeds and turn rates of every clip", "none", draw_points),
    "scenario-circle": FigureKind("4a", "A trial at constant speed", "one", draw_circle, ("circle",)),
    "scenario-switching": FigureKind("4b", "A trial whose speed switches", "one", draw_switching, ("switching",)),
    "scenario-course": FigureKind("", "A trial with stops, corners or other courses", "one", draw_course, COURSES),
    "offsets": FigureKind("5", "Distance from the path", "none", draw_offsets, tuple(FAMILY_TITLES)),
    "density": FigureKind("6", "Density of the data", "none", draw_density),
    "transition-cost": FigureKind("7", "Cost of transitions over a trial", "one", draw_transition_costs, PUBLISHED),
    "errors": FigureKind("8", "Errors of speed and turn rate", "one", draw_errors, PUBLISHED),
    "usage": FigureKind("9", "Usage of the clips", "any", draw_usage),
    "clip-graph": FigureKind("10", "Frames and transitions", "any", draw_clip_graph),
    "directions": FigureKind("", "Forward, backward and sideways", "none", draw_directions),
    "holes": FigureKind("", "Missing data", "none", draw_holes),
    "frame-use": FigureKind("", "Use of the parts of the clips", "any", draw_frame_use),
}
"""Every figure by its name."""

COVERAGE_FIGURES = ("density", "points", "holes", "directions")
"""Names of the figures in the chapter on coverage."""
SCENARIO_FIGURES = ("scenario-circle", "scenario-switching", "scenario-course")
"""Names of the figures that show a trial from above."""
TRIAL_FIGURES = ("transition-cost", "errors")
"""Names of the figures of costs and errors in a trial."""
USE_FIGURES = ("usage", "frame-use", "clip-graph")
"""Names of the figures in the chapter on the most used clips."""
SHARED_FIGURES = ("offsets", "density")
"""Figures that can show more than two results, as small multiples on one scale."""


def draw_figure(
    name: str,
    result: EvaluationResult,
    *,
    trial: str | None = None,
    other: EvaluationResult | None = None,
    labels: tuple[str, str] = ("before", "after"),
    options: FigureOptions | None = None,
) -> DrawnFigure:
    """Draw one figure of a result, or of two results on shared scales.

    Parameters
    ----------
    name : name of the figure, a key of `FIGURES`
    trial : name of the trial to show, such as "switching v=1.5 w=-50". Default: the trial
        that the character follows worst, for figures that show only one trial; otherwise all trials
    other : second result, drawn beside the first for comparison
    labels : names of the two results in a comparison

    Raises
    ------
    MotionError    if the figure or the trial is unknown, if the record of the trial is missing, or if a trial is given
        for a figure that always shows all trials
    """
    kind = FIGURES.get(name)
    if kind is None:
        raise MotionError(f"there is no figure {name!r}; choose from {', '.join(FIGURES)}", code="unknown-figure")
    if trial is not None and kind.trials == "none":
        raise MotionError(
            f"the figure {name!r} shows all trials together; leave out the trial", code="figure-without-trial"
        )
    subjects = [Subject("", result)] if other is None else [Subject(labels[0], result), Subject(labels[1], other)]
    return DrawnFigure(kind.draw(subjects, trial, options or FigureOptions()), name, kind.number, kind.title)


def draw_figures(
    result: EvaluationResult,
    *,
    other: EvaluationResult | None = None,
    labels: tuple[str, str] = ("before", "after"),
) -> dict[str, DrawnFigure]:
    """Draw the figures that `drawable` lists, of one result or of two results in comparison; return them by name."""
    return {name: draw_figure(name, result, other=other, labels=labels) for name in drawable(result, other=other)}


def drawable(result: EvaluationResult, *, other: EvaluationResult | None = None) -> list[str]:
    """Return the names of the figures that one result, or a comparison of two results, can have.

    Figures are left out if their trials are missing, or if they need records that were not stored.
    """
    results = [result] if other is None else [result, other]
    names = set.intersection(*({each.trial.name for each in one.trials} for one in results))
    families = {each.trial.family for each in result.trials if each.trial.name in names}
    asked = set(result.options.families)
    with_records = all(one.records for one in results)
    return [
        name
        for name, kind in FIGURES.items()
        if (families if kind.trials == "one" else asked).intersection(kind.families)
        if kind.trials != "one" or with_records
    ]


def draw_shared_figures(results: Sequence[EvaluationResult], labels: Sequence[str]) -> dict[str, DrawnFigure]:
    """Draw the figures that can show many results, on shared scales; return them by name.

    Parameters
    ----------
    results : at least two results with the same grid of trials
    labels : their names
    """
    subjects = [Subject(label, result) for label, result in zip(labels, results, strict=True)]
    return {
        name: DrawnFigure(kind.draw(subjects, None, FigureOptions()), name, kind.number, kind.title)
        for name in SHARED_FIGURES
        for kind in (FIGURES[name],)
        if set(kind.families).intersection(results[0].options.families)
    }
