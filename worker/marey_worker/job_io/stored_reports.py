"""Storage of reports: pages and figures as files, and the document that refers to these files."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from marey_reports.drawing.drawn import DrawnFigure
from marey_reports.drawing.head import ReportInput
from marey_reports.drawing.page import scripts_of
from marey_schemas.documents.reports import Report, StoredFigure, StoredFile
from marey_worker.context import Context


def inputs_of(context: Context) -> tuple[ReportInput, ...]:
    """Return the inputs of the job as the head of its report lists them, in the order of the submission."""
    pins = (pin for many in context.inputs.values() for pin in many)
    return tuple(ReportInput(pin.kind.noun, pin.path, pin.revision) for pin in pins)


def store_report(
    context: Context, kind: type[Report], title: str, page: str, figures: Iterable[tuple[str | None, DrawnFigure]]
) -> dict[str, Any]:
    """Store the page and the figures of a report as files; return the report as a document.

    Each figure is given with the name of its trial, or None. The document refers to the files.
    """
    report = kind.model_validate(
        {
            "title": title,
            "html": _stored(context, page.encode()),
            "scripts": scripts_of(page),
            "figures": tuple(stored_figure(context, figure, trial) for trial, figure in figures),
        }
    )
    return report.model_dump(mode="json", by_alias=True)


def stored_figure(context: Context, figure: DrawnFigure, trial: str | None = None) -> StoredFigure:
    """Store a figure as files, one for each format; return the figure's entry in the document of a report."""
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
