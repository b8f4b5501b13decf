"""The report of an evaluation and its figures, as files that its document names."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Iterator
from typing import Any

from marey_motion.evaluation.figures import FIGURES, DrawnFigure, draw_figure, draw_figures
from marey_motion.evaluation.report import render_report
from marey_motion.evaluation.result import EvaluationResult
from marey_schemas.evaluation import EvaluateParams, EvaluationReport, StoredFigure, StoredFile
from marey_worker.context import Context


def write_report(context: Context, result: EvaluationResult, params: EvaluateParams) -> dict[str, Any]:
    """Draw every figure and write the page; the document that names them."""
    figures = draw_figures(result)
    page = render_report(result, title=params.name, figures=figures)
    report = EvaluationReport(
        title=params.name,
        html=_stored(context, page.encode()),
        scripts=_scripts(page),
        figures=(
            *(_stored_figure(context, figure) for figure in figures.values()),
            *(_stored_figure(context, figure, trial) for trial, figure in _trial_figures(result, params)),
        ),
    )
    return report.model_dump(mode="json", by_alias=True)


def _scripts(page: str) -> tuple[str, ...]:
    """The script of the page: its last one. Anything before it that looks like one came with a name of something."""
    _, found, rest = page.rpartition("<script>")
    digest = hashlib.sha256(rest.partition("</script>")[0].encode()).digest()
    return (f"sha256-{base64.b64encode(digest).decode()}",) if found else ()


def _trial_figures(result: EvaluationResult, params: EvaluateParams) -> Iterator[tuple[str, DrawnFigure]]:
    """Figures of the trials that were asked for."""
    families = {one.trial.name: one.trial.family for one in result.trials}
    for trial in params.trial_figures:
        for name, kind in FIGURES.items():
            if kind.trials == "any" or (kind.trials == "one" and families[trial] in kind.families):
                yield trial, draw_figure(name, result, trial=trial)


def _stored_figure(context: Context, figure: DrawnFigure, trial: str | None = None) -> StoredFigure:
    files = {name: _stored(context, data) for name, data in figure.files().items()}
    tables = {table: files[f"{figure.name}-{table}.csv"] for table in figure.tables}
    return StoredFigure(
        name=figure.name,
        number=figure.number,
        title=figure.title,
        caption=figure.caption,
        trial=trial,
        png=files[f"{figure.name}.png"],
        svg=files[f"{figure.name}.svg"],
        json_=files[f"{figure.name}.json"],
        csv=tables,
    )


def _stored(context: Context, data: bytes) -> StoredFile:
    file = context.scratch / "figure"
    file.write_bytes(data)
    return StoredFile(blob=context.put_file(file), size_bytes=len(data))
