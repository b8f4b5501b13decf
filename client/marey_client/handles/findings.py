"""Findings: results of jobs that measure, with numbers and a document; some kinds of jobs also make a report."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from marey_client.arguments import checks_arguments
from marey_client.blobs import Blobs
from marey_client.downloads import safe_file_name
from marey_client.errors import NotComparable
from marey_client.handles.reports import saved
from marey_client.transport import Transport, sends_nothing
from marey_schemas.documents.quality import QualityConditions, QualityDocument, command_with, differing_conditions
from marey_schemas.documents.reports import StoredFigure
from marey_schemas.encoding.codecs import JSON, decode_tree
from marey_schemas.queue.jobs import Job

FILES = ("document", "report", "maps", "figures", "fitted", "table")
"""Names of members of a job's result that refer to files, such as a report, instead of numbers."""


@checks_arguments
@dataclass(frozen=True)
class Findings:
    """Findings of one job: its results, with the files that some kinds of jobs also make."""

    transport: Transport
    job: Job

    @property
    def summary(self) -> dict[str, Any]:
        """The main numbers of the job's result, by name."""
        return {name: value for name, value in (self.job.result or {}).items() if name not in FILES}

    def document(self) -> dict[str, Any]:
        """Return the document with all results of the job; arrays are numpy arrays."""
        return dict(decode_tree(Blobs(self.transport).fetch(self._blob("document")), JSON))

    def report(self) -> bytes:
        """Return the report, one self-contained page of HTML. Raises `LookupError` if the job made no report."""
        self._blob("report")  # raises LookupError if the job made no report
        path = f"/projects/{self.job.project}/jobs/{self.job.id}/files/report"
        return self.transport.send("GET", path, headers={"Accept": "text/html"}).content

    def save_report(self, path: str | Path) -> Path:
        """Write the report to a file, and return the path of the file."""
        return saved(path, self.report())

    def save_file(self, name: str, path: str | Path) -> Path:
        """Write a file of the result, such as `report`; return its path. Raises `LookupError` without such a file."""
        return Blobs(self.transport).fetch_to(self._blob(name), Path(path))

    @sends_nothing
    def figures(self) -> tuple[StoredFigure, ...]:
        """Return the figures of the report; an empty result without a report."""
        return tuple(StoredFigure.model_validate(figure) for figure in (self.job.result or {}).get("figures", ()))

    def save_figures(self, folder: str | Path) -> list[Path]:
        """Write every figure to a folder, as PNG and SVG, with its data as JSON and CSV; return all paths."""
        return [
            saved(Path(folder) / safe_file_name(name), Blobs(self.transport).fetch(blob))
            for figure in self.figures()
            for name, blob in _files_of(figure)
        ]

    def _blob(self, name: str) -> str:
        result = self.job.result or {}
        if name not in result:
            raise LookupError(f"the result of the job {self.job.id} has no {name}")
        return str(result[name]["blob"])


@dataclass(frozen=True)
class Quality(Findings):
    """Quality of clips: numbers for each clip, totals, and the same for reference clips if some were given."""

    @property
    def conditions(self) -> QualityConditions:
        """The conditions of the measurement; the numbers of two results can be compared only if these are equal."""
        return QualityConditions.model_validate((self.job.result or {})["conditions"])

    def measured(self) -> QualityDocument:
        """Return all measurements, for each clip and in total."""
        return QualityDocument.model_validate(self.document())

    def changes_since(self, earlier: Quality) -> Mapping[str, tuple[float, float]]:
        """Return the totals of an earlier result and of this result, by the name of the measure.

        Measures that only one of the two results has are left out. Raises `NotComparable` if the results were measured
        under different conditions; the text contains the command that measures under the earlier conditions.
        """
        if different := differing_conditions(earlier.conditions, self.conditions):
            reasons = ", ".join(f"{name} is {before} and {now}" for name, (before, now) in different.items())
            advice = "measure both sets of clips again" if "code" in different else "measure these clips again"
            raise NotComparable(
                f"the results of {earlier.job.id} and {self.job.id} cannot be compared, because their numbers mean "
                f"different things: {reasons}; {advice}, with `{command_with(earlier.conditions)}`"
            )
        before, now = (one.summary["totals"] for one in (earlier, self))
        return {
            name: (before[name], value)
            for name, value in now.items()
            if value is not None and before.get(name) is not None
        }

    def save_table(self, path: str | Path) -> Path:
        """Write one row for each clip to a file, as CSV; return the path."""
        return self.save_file("table", path)


def _files_of(figure: StoredFigure) -> Iterator[tuple[str, str]]:
    """Yield the name and the digest of each file of a figure."""
    yield f"{figure.name}.png", figure.png.blob
    yield f"{figure.name}.svg", figure.svg.blob
    yield f"{figure.name}.json", figure.json_.blob
    for table, file in figure.csv.items():
        yield f"{figure.name}-{table}.csv", file.blob
