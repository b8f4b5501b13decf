"""Counterparts of `marey_client.handles.findings` for async programs.

Written by `make docs` from that module; change it there.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from marey_client.asynchronous.counterparts import Counterpart, counterpart_of
from marey_client.handles.findings import Findings
from marey_schemas.documents.reports import StoredFigure
from marey_schemas.queue.jobs import Job


@counterpart_of(Findings)
class AsyncFindings(Counterpart):
    """Findings of one job: its results, with the files that some kinds of jobs also make."""

    _sync: Findings

    @property
    def job(self) -> Job:
        return self._sync.job

    @property
    def summary(self) -> dict[str, Any]:
        """The main numbers of the job's result, by name."""
        return self._sync.summary

    async def document(self) -> dict[str, Any]:
        """Return the document with all results of the job; arrays are numpy arrays."""
        return await self._run(self._sync.document)

    async def report(self) -> bytes:
        """Return the report, one self-contained page of HTML. Raises `LookupError` if the job made no report."""
        return await self._run(self._sync.report)

    async def save_report(self, path: str | Path) -> Path:
        """Write the report to a file, and return the path of the file."""
        return await self._run(self._sync.save_report, path)

    async def save_file(self, name: str, path: str | Path) -> Path:
        """Write a file of the result, such as `report`; return its path. Raises `LookupError` without such a file."""
        return await self._run(self._sync.save_file, name, path)

    def figures(self) -> tuple[StoredFigure, ...]:
        """Return the figures of the report; an empty result without a report."""
        return self._sync.figures()

    async def save_figures(self, folder: str | Path) -> list[Path]:
        """Write every figure to a folder, as PNG and SVG, with its data as JSON and CSV; return all paths."""
        return await self._run(self._sync.save_figures, folder)
