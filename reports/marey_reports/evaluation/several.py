"""Report that compares several evaluations of the same trials, such as those of several datasets and of their union."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from marey_motion.evaluation.compare import Comparison
from marey_motion.evaluation.judgement import judge
from marey_motion.evaluation.relevance import recorded_rows, sum_by_source
from marey_motion.evaluation.result import EvaluationResult, interval_of
from marey_reports.drawing.head import ReportHead, ReportInput
from marey_reports.drawing.markup import Html, element
from marey_reports.drawing.page import Section, page, shown
from marey_reports.drawing.tables import Cell, Number, number, table
from marey_reports.evaluation.definitions import METRICS, definitions
from marey_reports.evaluation.figures import SHARED_FIGURES, draw_shared_figures
from marey_reports.evaluation.provenance import provenance
from marey_reports.evaluation.sentences import region_verdicts, verdict
from marey_schemas.documents.replicates import LEAST_REPLICATES, MeanInterval
from marey_schemas.wording import counted


def render_several(
    results: Sequence[EvaluationResult],
    comparisons: Sequence[Comparison],
    *,
    title: str,
    labels: Sequence[str],
    inputs: Sequence[ReportInput] = (),
) -> str:
    """Render the report of several evaluations under one normaliser as an HTML document.

    Parameters
    ----------
    results : at least two evaluations
    comparisons : comparisons of all others with the first
    labels : names of the evaluations, in the same order
    inputs : the compared revisions, for the head
    """
    drawn = draw_shared_figures(results, labels)
    said = [
        element("li", element("strong", label), ": ", verdict(each))
        for label, each in zip(labels, results, strict=True)
    ]
    sections = [
        Section("sets", "The sets", (_sets(results, labels), _regions(results, labels))),
        _metric_chapter(results, comparisons, labels),
        Section("figures", "Where each set follows, and what it contains", shown(drawn, *SHARED_FIGURES)),
        Section("definitions", "Definitions", definitions(results[0].options.limits)),
        Section("provenance", "Provenance", provenance(results, labels)),
    ]
    subject = f"Comparison of {len(results)} evaluations"
    head = ReportHead(subject, title, results[0].provenance.code_version, inputs)
    return page(head, element("ul", said, class_="regions"), sections)


def _sets(results: Sequence[EvaluationResult], labels: Sequence[str]) -> Html:
    """Write a table with the contents of each set of clips, and the number of trajectories followed with the set."""
    heads = (
        "set",
        "clips",
        "of them used",
        "minutes",
        "cells covered",
        "symmetry",
        "followed",
        "95 % interval",
        "grade",
    )
    rows: list[Sequence[Cell]] = []
    for label, each in zip(labels, results, strict=True):
        sources, judgement = sum_by_source(each.clips, each.usage), judge(each)
        minutes = recorded_rows(each.clips, each.usage) / each.options.database.rate_hz / 60.0
        counts = None if each.replicates is None else np.count_nonzero(each.replicates.followed, axis=0)
        interval = None if counts is None else interval_of(counts.astype(np.float64))
        followed = Number(judgement.followed, f"{judgement.followed} of {len(judgement.trials)}")
        rows.append(
            [
                label,
                number(len(sources), 0),
                number(sum(source.ticks > 0 for source in sources), 0),
                number(minutes, 1),
                Number(each.coverage.index, f"{100 * each.coverage.index:.0f} %"),
                number(each.coverage.symmetry),
                followed,
                _interval(interval, 1),
                judgement.grade,
            ]
        )
    return table("Sets of clips", heads, rows, numbers=range(1, 8))


def _regions(results: Sequence[EvaluationResult], labels: Sequence[str]) -> Html:
    """Write a table with the number of followed trajectories in each region of the trials."""
    regions = [{one.region: one for one in region_verdicts(each) if one.trials} for each in results]
    names = list(dict.fromkeys(name for each in regions for name in each))
    rows: list[Sequence[Cell]] = [
        [label, *(Number(one.followed, f"{one.followed} of {one.trials}") for one in (each[name] for name in names))]
        for label, each in zip(labels, regions, strict=True)
    ]
    return table("Trajectories followed by region", ("set", *names), rows, numbers=range(1, len(names) + 1))


def _metric_chapter(
    results: Sequence[EvaluationResult], comparisons: Sequence[Comparison], labels: Sequence[str]
) -> Section:
    """Write the chapter on all metrics: the value for each set, and the verdict on the change from the first set."""
    changes = [{change.metric: change for change in one.metrics} for one in comparisons]
    rows: list[Sequence[Cell]] = []
    for name, metric in METRICS.items():
        if all(each.suite.get(name) is None for each in results):
            continue
        row: list[Cell] = [metric.label]
        for place, each in enumerate(results):
            found = None if each.replicates is None else each.replicates.interval(name)
            row += [number(each.suite.get(name), metric.digits), _interval(found, metric.digits)]
            if place:
                change = changes[place - 1].get(name)
                row.append(change.verdict if change is not None else "")
        rows.append([*row, metric.unit])
    heads = ["measure", labels[0], "95 % interval"]
    for label in labels[1:]:
        heads += [label, "95 % interval", f"than {labels[0]}"]
    # Each set but the first has a column of words after its two columns of numbers.
    numbers = [1, 2, *(3 * place + shift for place in range(1, len(results)) for shift in (0, 1))]
    return Section(
        "numbers",
        "All metrics",
        (
            element("p", _about_verdicts(results, labels)),
            table("Metrics of the suites", [*heads, "unit"], rows, numbers=numbers, sortable=False),
        ),
    )


def _about_verdicts(results: Sequence[EvaluationResult], labels: Sequence[str]) -> str:
    replicates = results[0].options.replicates
    if replicates < LEAST_REPLICATES:
        return (
            f"The evaluations have {counted(replicates, 'replicate')}, so it is unknown which differences are chance. "
            f"Evaluate with at least {LEAST_REPLICATES} replicates to know."
        )
    return (
        f"Each set is compared with “{labels[0]}” over {replicates} paired replicates. The words are corrected for the "
        "number of metrics and of sets: by chance alone, about one of twenty such reports has a “better” or “worse”. "
        "All sets scale the features of motion matching in the same way."
    )


def _interval(found: MeanInterval | None, digits: int) -> Number:
    if found is None or found.low is None or found.high is None:
        return Number(None, "–")
    return Number(found.low, f"{found.low:.{digits}f} to {found.high:.{digits}f}")
