"""Counterparts of `marey_client.handles.reports` for async programs.

Written by `make docs` from that module; change it there.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from marey_client.asynchronous.counterparts import counterpart_of
from marey_client.asynchronous.items import AsyncItemHandle
from marey_client.handles.reports import ReportedHandle
from marey_schemas.documents.reports import StoredFigure


@counterpart_of(ReportedHandle)
class AsyncReportedHandle(AsyncItemHandle):
    """Handle of an evaluation or a model, which has a verdict in words and may have a part `report`."""

    _sync: ReportedHandle

    @property
    def verdict(self) -> str:
        """The quality of the evaluated clips or of the model, as one or two sentences."""
        return self._sync.verdict

    async def summary(self) -> dict[str, Any]:
        """Return the verdict and the headline numbers; the name of each number ends in its unit."""
        return await self._run(self._sync.summary)

    async def figures(self) -> tuple[StoredFigure, ...]:
        """Return the figures of the report, with the formats in which each is stored."""
        return await self._run(self._sync.figures)

    async def report(self) -> bytes:
        """Return the report: one self-contained page of HTML."""
        return await self._run(self._sync.report)

    async def figure(
        self, name: str, format: str = "png", *, trial: str | None = None, table: str | None = None
    ) -> bytes:
        """Return a figure as bytes: as png or svg, its data as json, or one `table` of its data as csv.

        Figures of single trials need the name of the `trial`.
        """
        return await self._run(self._sync.figure, name, format, trial=trial, table=table)

    async def save_report(self, path: str | Path) -> Path:
        """Write the report to a file, and return the path of the file."""
        return await self._run(self._sync.save_report, path)

    async def save_figures(self, folder: str | Path) -> list[Path]:
        """Write every figure to a folder, as PNG and SVG, with its data as JSON and CSV; return all paths."""
        return await self._run(self._sync.save_figures, folder)
