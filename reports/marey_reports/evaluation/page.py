"""Reports of evaluations for people. Each report is one HTML file, which needs no network and no other file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from marey_motion.evaluation.compare import Comparison
from marey_motion.evaluation.result import EvaluationResult
from marey_reports.drawing.head import ReportHead, ReportInput
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
from marey_reports.evaluation.played import PlayedTrial, played_chapter
from marey_reports.evaluation.provenance import provenance
from marey_reports.evaluation.region_strips import PosedTrial, region_chapter
from marey_reports.evaluation.sentences import region_verdicts, verdict

__all__ = ["compared", "render_comparison", "render_report"]


def render_report(
    result: EvaluationResult,
    *,
    title: str,
    figures: Mapping[str, DrawnFigure] | None = None,
    inputs: Sequence[ReportInput] = (),
    played: Sequence[PlayedTrial] = (),
    posed: Sequence[PosedTrial] = (),
) -> str:
    """Render the report of one evaluation as an HTML document.

    Parameters
    ----------
    title : heading of the page, for example the name of the dataset
    figures : figures by name, as returned by `draw_figures`; if None, they are drawn. Missing figures are left out
    inputs : the evaluated revisions, for the head
    played : trials whose motion the page shows
    posed : trials of which the page shows poses
    """
    drawn = draw_figures(result) if figures is None else figures
    sections = [
        *([played_chapter(played, len(result.trials))] if played else []),
        *([region_chapter(posed)] if posed else []),
        coverage_chapter(result, drawn),
        error_chapter(result, drawn),
        load_chapter(result, drawn),
        unused_chapter(result),
        recording_chapter(result, drawn),
        baseline_chapter(result),
        appendix_chapter(result),
        Section("definitions", "Definitions", definitions(result.options.limits)),
        Section("provenance", "Provenance", (provenance([result], ["value"]), notes(result))),
    ]
    regions = element("ul", [element("li", region.sentence) for region in region_verdicts(result)], class_="regions")
    lead = element("p", verdict(result), class_="verdict"), regions, headline(result)
    head = ReportHead("Evaluation of clips", title, result.provenance.code_version, inputs)
    return page(head, lead, sections, plays_motion=bool(played))


def render_comparison(
    before: EvaluationResult,
    after: EvaluationResult,
    *,
    title: str,
    comparison: Comparison | None = None,
    labels: tuple[str, str] = ("before", "after"),
    figures: Mapping[str, DrawnFigure] | None = None,
    inputs: Sequence[ReportInput] = (),
) -> str:
    """Render the report of two evaluations as an HTML document.

    Parameters
    ----------
    comparison : comparison of `before` and `after`; adds confidence intervals, and marks trials that differ in any tick
    labels : names of both evaluations in figures and tables
    figures : figures by name, as returned by `draw_figures` for two results; if None, they are drawn
    inputs : the two revisions, for the head
    """
    drawn = draw_figures(before, other=after, labels=labels) if figures is None else figures
    sections = [
        metric_chapter(before, after, comparison, labels),
        trial_chapter(before, after, comparison, drawn),
        clip_chapter(before, after, drawn),
        coverage_of_two_chapter(drawn),
        Section("definitions", "Definitions", definitions(after.options.limits)),
        Section("provenance", "Provenance", provenance([before, after], labels)),
    ]
    lead = element("p", compared(before, after, comparison), class_="verdict"), headline_of_two(before, after, labels)
    head = ReportHead("Comparison of two evaluations", title, after.provenance.code_version, inputs)
    return page(head, lead, sections)
