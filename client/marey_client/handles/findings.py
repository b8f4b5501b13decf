"""Findings: results of jobs, with numbers and a document; some kinds of jobs also make a report."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from marey_client.blobs import Blobs
from marey_client.transport import Transport
from marey_schemas.encoding.codecs import JSON, decode_tree
from marey_schemas.queue.jobs import Job

FILES = ("document", "report", "maps", "figures", "fitted")
"""Members of a result that refer to files."""


@dataclass(frozen=True)
class Findings:
    """Findings of one job; `job.result` holds their counts."""

    transport: Transport
    job: Job

    @property
    def summary(self) -> dict[str, Any]:
        """The main numbers of the result."""
        return {name: value for name, value in (self.job.result or {}).items() if name not in FILES}

    def document(self) -> dict[str, Any]:
        """Return all results; arrays are numpy arrays."""
        return dict(decode_tree(Blobs(self.transport).fetch(self._blob("document")), JSON))

    def report(self) -> bytes:
        """Return the report, one self-contained page of HTML. Raises `LookupError` if the job made no report."""
        return Blobs(self.transport).fetch(self._blob("report"))

    def save_report(self, path: str | Path) -> Path:
        """Write the report to a file, and return the path of the file."""
        return self.save_file("report", path)

    def save_file(self, name: str, path: str | Path) -> Path:
        """Write a file of the result, such as `report`; return its path. Raises `LookupError` without such a file."""
        return Blobs(self.transport).fetch_to(self._blob(name), Path(path))

    def _blob(self, name: str) -> str:
        result = self.job.result or {}
        if name not in result:
            raise LookupError(f"the result of the job {self.job.id} has no {name}")
        return str(result[name]["blob"])
