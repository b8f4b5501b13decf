"""The report of an evaluation and its figures, as files that its document names."""

from __future__ import annotations

import base64
import hashlib
from typing import Any

from marey_motion.evaluation.figures import FIGURES, DrawnFigure, draw_figure
from marey_motion.evaluation.report import render_report
from marey_motion.evaluation.result import EvaluationResult
from marey_schemas.evaluation import EvaluationReport, StoredFigure, StoredFile
from marey_worker.context import Context

OF_ONE_FAMILY = {"scenario-circle": "circle", "scenario-switching": "switching"}


def write_report(context: Context, result: EvaluationResult, title: str) -> dict[str, Any]:
    """Draw every figure and write the page; the document that names them."""
    figures = draw_figures(result)
    page = render_report(result, title=title, figures=figures)
    report = EvaluationReport(
        title=title,
        html=_stored(context, page.encode()),
        scripts=_scripts(page),
        figures=tuple(_stored_figure(context, figure) for figure in figures.values()),
    )
    return report.model_dump(mode="json", by_alias=True)


def draw_figures(result: EvaluationResult) -> dict[str, DrawnFigure]:
    """Every figure that can be drawn of the result, by name; those of one trial show the one that went worst."""
    families = result.options.families
    wanted = [name for name in FIGURES if OF_ONE_FAMILY.get(name, families[0]) in families]
    return {name: draw_figure(name, result) for name in wanted}


def _scripts(page: str) -> tuple[str, ...]:
    """The script of the page: its last one. Anything before it that looks like one came with a name of something."""
    _, found, rest = page.rpartition("<script>")
    digest = hashlib.sha256(rest.partition("</script>")[0].encode()).digest()
    return (f"sha256-{base64.b64encode(digest).decode()}",) if found else ()


def _stored_figure(context: Context, figure: DrawnFigure) -> StoredFigure:
    files = {name: _stored(context, data) for name, data in figure.files().items()}
    tables = {table: files[f"{figure.name}-{table}.csv"] for table in figure.tables}
    return StoredFigure(
        name=figure.name,
        number=figure.number,
        title=figure.title,
        caption=figure.caption,
        png=files[f"{figure.name}.png"],
        svg=files[f"{figure.name}.svg"],
        json_=files[f"{figure.name}.json"],
        csv=tables,
    )


def _stored(context: Context, data: bytes) -> StoredFile:
    file = context.scratch / "figure"
    file.write_bytes(data)
    return StoredFile(blob=context.put_file(file), size_bytes=len(data))
