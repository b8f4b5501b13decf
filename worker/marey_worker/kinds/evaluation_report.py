"""The report of an evaluation."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from marey_motion.evaluation.result import EvaluationResult
from marey_reports.evaluation.figures import FIGURES, DrawnFigure, draw_figure, draw_figures
from marey_reports.evaluation.page import render_report
from marey_schemas.documents.reports import EvaluationReport
from marey_schemas.job_params import EvaluateParams
from marey_worker.context import Context
from marey_worker.job_io.stored_reports import store_report


def write_report(context: Context, result: EvaluationResult, params: EvaluateParams) -> dict[str, Any]:
    """Draw every figure and write the page; the document that names them."""
    figures = draw_figures(result)
    page = render_report(result, title=params.name, figures=figures)
    drawn = [*((None, figure) for figure in figures.values()), *_trial_figures(result, params)]
    return store_report(context, EvaluationReport, params.name, page, drawn)


def _trial_figures(result: EvaluationResult, params: EvaluateParams) -> Iterator[tuple[str, DrawnFigure]]:
    """Figures of the trials that were asked for."""
    families = {one.trial.name: one.trial.family for one in result.trials}
    for trial in params.trial_figures:
        for name, kind in FIGURES.items():
            if kind.trials == "any" or (kind.trials == "one" and families[trial] in kind.families):
                yield trial, draw_figure(name, result, trial=trial)
