"""Handles of items that have a report: an HTML page with figures."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from marey_client.arguments import checks_arguments
from marey_client.downloads import safe_file_name, saved_atomically
from marey_client.items import ItemHandle
from marey_client.transport import named_path
from marey_schemas.documents.reports import StoredFigure


@checks_arguments
class ReportedHandle(ItemHandle):
    """Handle of an evaluation or a model, which has a verdict in words and may have a part `report`."""

    @property
    def verdict(self) -> str:
        """The quality of the evaluated clips or of the model, as one or two sentences."""
        return str(self.item.summary["verdict"])

    def summary(self) -> dict[str, Any]:
        """Return the verdict and the headline numbers; the name of each number ends in its unit."""
        return dict(self.item.summary)

    def figures(self) -> tuple[StoredFigure, ...]:
        """Return the figures of the report, with the formats in which each is stored."""
        return tuple(StoredFigure.model_validate(figure) for figure in self.part("report")["figures"])

    def report(self) -> bytes:
        """Return the report: one self-contained page of HTML."""
        return self._fetch(f"{self.url}/report", "text/html")

    def figure(
        self,
        name: str,
        format: str = "png",  # noqa: A002
        *,
        trial: str | None = None,
        table: str | None = None,
    ) -> bytes:
        """Return a figure as bytes: as png or svg, its data as json, or one `table` of its data as csv.

        Figures of single trials need the name of the `trial`.
        """
        params = {"format": format, "trial": trial, "table": table}
        return self._fetch(named_path(f"{self.url}/figures", name), "*/*", params)

    def save_report(self, path: str | Path) -> Path:
        """Write the report to a file, and return the path of the file."""
        return saved(path, self.report())

    def save_figures(self, folder: str | Path) -> list[Path]:
        """Write every figure to a folder, as PNG and SVG, with its data as JSON and CSV; return all paths."""
        files = (file for figure in self.figures() for file in self._files_of(figure))
        return [saved(Path(folder) / safe_file_name(name), data) for name, data in files]

    def _files_of(self, figure: StoredFigure) -> Iterator[tuple[str, bytes]]:
        name = figure.name if figure.trial is None else f"{figure.name} {figure.trial}"
        for form in ("png", "svg", "json"):
            yield f"{name}.{form}", self.figure(figure.name, form, trial=figure.trial)
        for table in figure.csv:
            yield f"{name}-{table}.csv", self.figure(figure.name, "csv", trial=figure.trial, table=table)

    def _fetch(self, path: str, accept: str, params: Mapping[str, str | None] | None = None) -> bytes:
        given = {name: value for name, value in (params or {}).items() if value is not None}
        return self.transport.send("GET", path, params=given, headers={"Accept": accept}).content


def saved(path: str | Path, data: bytes) -> Path:
    """Write bytes to a file, and return its path; if writing fails, no file is created."""
    with saved_atomically(path) as file:
        file.write(data)
    return Path(path)
