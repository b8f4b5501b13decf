"""Storage of reports: pages and figures as files, and the document that refers to these files."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Iterable
from typing import Any

from marey_reports.drawing.drawn import DrawnFigure
from marey_schemas.documents.reports import Report, StoredFigure, StoredFile
from marey_worker.context import Context


def store_report(
    context: Context, kind: type[Report], title: str, page: str, figures: Iterable[tuple[str | None, DrawnFigure]]
) -> dict[str, Any]:
    """Store the page and the figures of a report as files; return the document that refers to these files."""
    report = kind.model_validate(
        {
            "title": title,
            "html": _stored(context, page.encode()),
            "scripts": _scripts(page),
            "figures": tuple(stored_figure(context, figure, trial) for trial, figure in figures),
        }
    )
    return report.model_dump(mode="json", by_alias=True)


def _scripts(page: str) -> tuple[str, ...]:
    """Return the SHA-256 digest of the page's script, or an empty tuple if the page has none.

    The script is the last `<script>` in the page, because earlier ones can be parts of names of clips.
    """
    _, found, rest = page.rpartition("<script>")
    digest = hashlib.sha256(rest.partition("</script>")[0].encode()).digest()
    return (f"sha256-{base64.b64encode(digest).decode()}",) if found else ()


def stored_figure(context: Context, figure: DrawnFigure, trial: str | None = None) -> StoredFigure:
    """Store a figure in all its formats as files; return the entry of a document that refers to these files."""
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
