"""Reports of evaluations for people: one HTML file each, which needs no network and no other file."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from marey_motion.evaluation.compare import Comparison
from marey_motion.evaluation.judgement import judge, strain
from marey_motion.evaluation.relevance import sum_by_source
from marey_motion.evaluation.result import EvaluationResult, TrialResult
from marey_motion.evaluation.scenario import demand
from marey_reports.drawing.markup import element
from marey_reports.drawing.page import Section, page
from marey_reports.evaluation.chapters import (
    appendix_chapter,
    baseline_chapter,
    coverage_chapter,
    error_chapter,
    headline,
    load_chapter,
    notes,
    recording_chapter,
    unused_chapter,
)
from marey_reports.evaluation.comparison import (
    clip_chapter,
    compared,
    coverage_of_two_chapter,
    headline_of_two,
    metric_chapter,
    trial_chapter,
)
from marey_reports.evaluation.definitions import definitions
from marey_reports.evaluation.figures import DrawnFigure, draw_figures
from marey_reports.evaluation.provenance import provenance
from marey_schemas.wording import counted

__all__ = ["compared", "render_comparison", "render_report", "verdict"]


def render_report(result: EvaluationResult, *, title: str, figures: Mapping[str, DrawnFigure] | None = None) -> str:
    """Render the report of one evaluation as an HTML document.

    Parameters
    ----------
    title : heading of the page, for example the name of the dataset
    figures : figures by name, as returned by `draw_figures`; if None, they are drawn. Missing figures are left out
    """
    drawn = draw_figures(result) if figures is None else figures
    sections = [
        coverage_chapter(result, drawn),
        error_chapter(result, drawn),
        load_chapter(result, drawn),
        unused_chapter(result),
        recording_chapter(result, drawn),
        baseline_chapter(result),
        appendix_chapter(result),
        Section("definitions", "Definitions", definitions()),
        Section("provenance", "Provenance", (provenance([result], ["value"]), notes(result))),
    ]
    lead = element("p", verdict(result), class_="verdict"), headline(result)
    return page(title, lead, sections, f"Written by Marey {result.provenance.code_version}.")


def render_comparison(
    before: EvaluationResult,
    after: EvaluationResult,
    *,
    title: str,
    comparison: Comparison | None = None,
    labels: tuple[str, str] = ("before", "after"),
    figures: Mapping[str, DrawnFigure] | None = None,
) -> str:
    """Render the report of two evaluations as an HTML document.

    Parameters
    ----------
    comparison : comparison of `before` and `after`; adds confidence intervals, and marks trials that differ in any tick
    labels : names of both evaluations in figures and tables
    figures : figures by name, as returned by `draw_figures` for two results; if None, they are drawn
    """
    drawn = draw_figures(before, other=after, labels=labels) if figures is None else figures
    sections = [
        metric_chapter(before, after, comparison, labels),
        trial_chapter(before, after, comparison, drawn),
        clip_chapter(before, after, drawn),
        coverage_of_two_chapter(drawn),
        Section("definitions", "Definitions", definitions()),
        Section("provenance", "Provenance", provenance([before, after], labels)),
    ]
    lead = element("p", compared(before, after), class_="verdict"), headline_of_two(before, after, labels)
    return page(title, lead, sections, f"Written by Marey {after.provenance.code_version}.")


def verdict(result: EvaluationResult) -> str:
    """Summarise quality, largest errors, coverage and unused data in one sentence."""
    judgement = judge(result)
    if judgement.worst is None:
        return "Not judged: the evaluation has no trials."
    parts = [f"the character follows {judgement.followed} of {counted(judgement.trials, 'trajectory')}"]
    if judgement.followed < judgement.trials:
        parts[0] += f", worst at a {demand(judgement.worst.trial)} ({_failing(judgement.worst)})"
    missing = result.coverage.deficit_s
    enough = int(np.count_nonzero(missing <= 0.0))
    parts.append(f"{enough} of {counted(missing.size, 'cell')} of speed and turn rate hold enough data")
    sources = sum_by_source(result.clips, result.usage)
    unused = sum(1 for source in sources if not source.ticks)
    if unused:
        parts.append(f"{unused} of {counted(len(sources), 'clip')} {'is' if unused == 1 else 'are'} never used")
    return f"{judgement.grade.capitalize()}: {'; '.join(parts)}."


def _failing(outcome: TrialResult) -> str:
    """Describe the error of a trial (offset, speed or turn rate) that is largest relative to its limit."""
    kind = max(zip(strain(outcome), ("offset_mean", "se_v", "se_omega_deg"), strict=True))
    value = outcome.metrics.get(kind[1])
    if value is None or math.isinf(kind[0]):
        return "not measured"
    if kind[1] == "offset_mean":
        return f"{value:.1f} m off on average"
    if kind[1] == "se_v":
        return f"{abs(value):.1f} m/s too {'fast' if value > 0.0 else 'slow'}"
    turn = outcome.trial.turn_rate_rad_s
    much = value * turn > 0.0 if turn else True
    return f"{abs(value):.0f} deg/s too {'much' if much else 'little'}"
