"""Page or picture that compares runs of a script."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator, Sequence

from marey_motion.version import code_version
from marey_reports.comparisons.axes import axis_title
from marey_reports.comparisons.bars import draw_bars
from marey_reports.comparisons.curves import draw_curves
from marey_reports.comparisons.scatter import draw_scatter
from marey_reports.comparisons.subjects import ComparedSubject, ends, short, written
from marey_reports.drawing.drawn import DrawnFigure, Sketch
from marey_reports.drawing.head import ReportHead
from marey_reports.drawing.markup import Content, element
from marey_reports.drawing.page import Section, page, shown
from marey_reports.drawing.paper import QUIET, SMALL, plain
from marey_reports.drawing.tables import Cell, Number, facts, table
from marey_schemas.documents.replicates import LEAST_REPLICATES
from marey_schemas.formats.pictures import PLOTS, ChartFile, Plot
from marey_schemas.queue.comparisons import MOST_DRAWN, ComparedColumn, ComparedRun, RunComparison, number_of
from marey_schemas.wording import counted

_CAPTION_SIGNS, _CAPTION_LINE = 148, 0.16
"""Number of characters in a line of a caption, and height of the line in inches."""
MOST_COLUMNS = 24
MOST_PARAMETERS = 3
"""Greatest number of parameters over which a page draws each field."""


def draw_comparison(
    comparison: RunComparison,
    file_type: ChartFile,
    *,
    plot: Plot | None = None,
    parameter: str | None = None,
    log: bool = False,
) -> bytes:
    """Draw a comparison of runs: an HTML page with all charts and tables, or one chart of one field as SVG or PNG.

    Parameters
    ----------
    comparison : the compared runs; charts of the kind "lines" need its curves
    plot : kind of the charts. If None, a page has charts of all kinds, and a picture has a chart of the first kind for
        which the runs have values
    parameter : name of the parameter on the horizontal axis; if None, each parameter that differs
    log : whether axes of fields with positive values are logarithmic

    Returns
    -------
    bytes    the content of the file

    Raises
    ------
    ValueError    if the runs have no values for the wanted chart, or no parameter of the given name
    """
    subject = ComparedSubject(comparison, log)
    if file_type == "html":
        return render_page(subject, plot, parameter).encode()
    figure = next(_figures(subject, subject.fields, plot, parameter), None)
    if figure is None:
        raise ValueError(f"the runs have no numbers for {_chart_words(plot)}")
    _write_caption(figure)
    return figure.png if file_type == "png" else figure.svg.encode()


def _write_caption(figure: DrawnFigure) -> None:
    """Write the caption below the chart, in a picture that is not part of an HTML page."""
    drawing = figure.sketch.figure
    lines = textwrap.wrap(plain(figure.caption), _CAPTION_SIGNS)
    width, before = drawing.get_size_inches()
    added = _CAPTION_LINE * len(lines) + 0.1
    drawing.set_size_inches(width, before + added)
    for axes in drawing.axes:
        left, bottom, across, up = axes.get_position().bounds
        share = before / (before + added)
        axes.set_position((left, (bottom * before + added) / (before + added), across, up * share))
    for number, line in enumerate(reversed(lines)):
        drawing.text(0.02, (0.12 + _CAPTION_LINE * number) / (before + added), line, fontsize=SMALL, color=QUIET,
                     parse_math=False)  # fmt: skip


def _chart_words(plot: Plot | None) -> str:
    return {
        None: "a chart",
        "lines": "lines over steps: no compared field was logged over steps",
        "scatter": "a chart over a parameter: no parameter with few enough values differs",
        "bars": "bars",
    }[plot]


def _figures(
    subject: ComparedSubject, fields: Sequence[ComparedColumn], plot: Plot | None, parameter: str | None
) -> Iterator[DrawnFigure]:
    """Yield the charts: of all fields as lines, then over parameters, then as bars."""
    for kind in PLOTS if plot is None else (plot,):
        for name, title, sketch in _sketches(subject, fields, kind, parameter):
            if sketch is not None:
                yield DrawnFigure(sketch, f"{kind}-{name}", "", title)


def _sketches(
    subject: ComparedSubject, fields: Sequence[ComparedColumn], plot: Plot, parameter: str | None
) -> Iterator[tuple[str, str, Sketch | None]]:
    if plot == "lines":
        for field in subject.comparison.curves:
            yield field, f"{field} over steps", draw_curves(subject, field)
        return
    for column in fields:
        if plot == "bars":
            yield column.name, f"{column.name} by setting", draw_bars(subject, column)
            continue
        for across in _parameters(subject, parameter):
            yield (f"{column.name}-{across.name}", f"{column.name} by {across.name}",
                   draw_scatter(subject, column, across))  # fmt: skip


def _parameters(subject: ComparedSubject, wanted: str | None) -> Sequence[ComparedColumn]:
    """Return the columns on horizontal axes. Raises `ValueError` if the wanted one does not exist."""
    known = [column for column in subject.comparison.columns if column.of in ("value", "input")]
    if wanted is None:
        return [column for column in subject.varied if column.of != "commit"][:MOST_PARAMETERS]
    chosen = [column for column in known if column.name == wanted]
    if not chosen:
        names = ", ".join(column.name for column in known)
        raise ValueError(f"the runs have no parameter {wanted!r}; they have {names or 'none'}")
    return chosen[:1]


# -- page --


def render_page(subject: ComparedSubject, plot: Plot | None, parameter: str | None) -> str:
    """Render a comparison as an HTML document that contains everything it shows."""
    comparison = subject.comparison
    fields = [column for column in subject.fields if column.differs or column.goal][:MOST_DRAWN] or subject.fields[:1]
    figures = {figure.name: figure for figure in _figures(subject, fields, plot, parameter)}
    sections = []
    for kind, heading in (("lines", "Over steps"), ("scatter", "By parameter"), ("bars", "By setting")):
        names = [name for name in figures if name.startswith(f"{kind}-")]
        if names:
            sections.append(Section(kind, heading, shown(figures, *names)))
    replicated = any(len(setting.runs) > 1 for setting in comparison.settings)
    if replicated:
        sections.append(Section("means", "Means", _means(subject, fields)))
    sections.append(Section("runs", "Runs", _runs(comparison)))
    lead: Content = (element("p", _verdict(subject), class_="verdict"), _headline(comparison))
    return page(ReportHead("Comparison of runs", f"Runs of {comparison.subject}", code_version()), lead, sections)


def _verdict(subject: ComparedSubject) -> str:
    """Describe which setting is best for the first field with a goal, and whether chance may explain the difference."""
    column = next((one for one in subject.fields if one.goal is not None and one.best_mean is not None), None)
    if column is None:
        return f"{counted(len(subject.comparison.runs), 'run')} are compared."
    points = subject.points(column.name)
    best = next(one for one in points if one.summary.mean == column.best_mean)
    text = (
        f"{subject.labels[best.setting]} has the {column.goal} {axis_title(column.name)}: "
        f"{short(best.summary.mean)} (n = {best.summary.n})."
    )
    others = [one for one in points if one is not best]
    if not others:
        return text
    if any(one.summary.low is None or one.summary.high is None for one in points):
        return f"{text} With fewer than {LEAST_REPLICATES} seeds, chance may explain the difference."
    low, high = best.summary.low or 0.0, best.summary.high or 0.0
    apart = all((one.summary.high or 0.0) < low or (one.summary.low or 0.0) > high for one in others)
    return text if apart else f"{text} Its 95 % interval overlaps that of another setting."


def _headline(comparison: RunComparison) -> Content:
    counts = [len(setting.runs) for setting in comparison.settings]
    repeats = sum(setting.repeats for setting in comparison.settings)
    seeds = f"{min(counts)}" if min(counts) == max(counts) else f"{min(counts)} to {max(counts)}"
    notes = "" if comparison.complete else "the first in the order; there are more"
    return facts(
        (
            ("runs", str(len(comparison.runs)), notes),
            ("settings", str(len(counts)), "runs that differ only by their seeds"),
            ("seeds per setting", seeds, f"{counted(repeats, 'repetition')} not counted" if repeats else ""),
        )
    )


def _runs(comparison: RunComparison) -> Content:
    columns = [column for column in comparison.columns if column.differs or len(comparison.runs) < 2]
    kept = columns[:MOST_COLUMNS]
    heads = ("job", "seed", *comparison.titles(kept))
    rows = [
        [element("code", run.job), Number(run.seed, str(run.seed)), *(_cell(column, run) for column in kept)]
        for run in comparison.runs
    ]
    numbers = [1, *(place for place, column in enumerate(kept, 2) if column.numeric)]
    note = f"{len(columns) - len(kept)} more columns are left out." if len(columns) > len(kept) else None
    equal = [
        f"{column.name} = {written(column, comparison.runs[0])}"
        for column in comparison.columns
        if column not in columns and column.of != "field"
    ]
    same = f"Equal in all runs: {', '.join(equal)}." if equal else None
    return table("Runs", heads, rows, numbers=numbers), *(element("p", text) for text in (same, note) if text)


def _cell(column: ComparedColumn, run: ComparedRun) -> Cell:
    number = number_of(run.cell(column))
    if number is None:
        return written(column, run)
    return Number(number, written(column, run), "good" if column.best is not None and number == column.best else "")


def _means(subject: ComparedSubject, fields: Sequence[ComparedColumn]) -> Content:
    heads = ["setting", "n", *(name for column in fields for name in (axis_title(column.name), "95 % interval"))]
    rows: list[Sequence[Cell]] = []
    for place, setting in enumerate(subject.comparison.settings):
        row: list[Cell] = [subject.labels[place], Number(len(setting.runs), str(len(setting.runs)))]
        for column in fields:
            summary = setting.fields.get(column.name)
            if summary is None:
                row += [Number(None, "–")] * 2
                continue
            best = "good" if summary.mean == column.best_mean else ""
            row.append(Number(summary.mean, short(summary.mean), best))
            known = summary.low is not None and summary.high is not None
            row.append(Number(summary.low, ends(summary.low or 0.0, summary.high or 0.0) if known else "–"))
        rows.append(row)
    return table("Means of runs with different seeds", heads, rows, numbers=range(1, len(heads)))
