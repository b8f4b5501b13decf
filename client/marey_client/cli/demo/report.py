"""Report of the demonstration, as text and as JSON."""

from __future__ import annotations

import shlex
import shutil
import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import typer

from marey_client.cli.demo.evaluation import DemoEvaluation
from marey_client.cli.demo.versions import DATASET, DemoVersion
from marey_client.cli.terminal.output import print_message, print_rows
from marey_client.imports import refusal_text
from marey_schemas.address import ADMIN_TOKEN_FILE
from marey_schemas.imports import ImportEntry
from marey_schemas.items import Item
from marey_schemas.queue.jobs import Job

REASONS_SHOWN = 12


@dataclass
class DemoReport:
    """Results of the demonstration, and the paths of the files that it wrote.

    `seconds` is the duration of each step: import, retarget, files, version, evaluate.
    """

    entries: Sequence[ImportEntry]
    left_out: int
    job: Job | None
    sources: Sequence[Item]
    results: Sequence[Item]
    seconds: dict[str, float]
    data: Path
    exported: Sequence[Path]
    tasks: int
    shared_tasks: int
    sheet: Path | None
    version: DemoVersion | None
    evaluation: DemoEvaluation
    server: str = ""

    @property
    def refused(self) -> list[tuple[str, str]]:
        """Refused files and clips: for each, the step that refused it, and a text with its name and the reason."""
        imports = [("import", refusal_text(entry)) for entry in self.entries if entry.error is not None]
        result = (self.job.result if self.job else None) or {}
        retargets = [
            ("retarget", f"{one.get('name')}: {one.get('detail')} ({one.get('code')})")
            for one in result.get("refused", ())
        ]
        return imports + retargets

    @property
    def warnings(self) -> Counter[str]:
        """The number of files with each import warning, by the code of the warning."""
        return Counter(code for entry in self.entries for code in {warning.code for warning in entry.warnings})

    def as_dict(self) -> dict[str, Any]:
        """Return the report as a dict for JSON."""
        return {
            "server": self.server,
            "data": str(self.data.absolute()),
            "files": len(self.entries),
            "left_out": self.left_out,
            "statuses": dict(Counter(entry.status for entry in self.entries)),
            "warnings": dict(self.warnings),
            "refused": [{"step": step, "reason": reason} for step, reason in self.refused],
            "frames": _frames(self.sources),
            "retargeted_clips": len(self.results),
            "retargeted_frames": _frames(self.results),
            "seconds": self.seconds,
            "poses_per_second": self._rates(),
            "bytes_per_pose": {"takes": _bytes_per_pose(self.sources), "retargeted": _bytes_per_pose(self.results)},
            "tasks": self.tasks,
            "shared_tasks": self.shared_tasks,
            "job": self.job.id if self.job else None,
            "contact_sheet": str(self.sheet.absolute()) if self.sheet else None,
            "exported": [str(path.absolute()) for path in self.exported],
            "version": self.version.as_dict() if self.version else None,
            "evaluated_clips": self.evaluation.chosen,
            "evaluation": self.evaluation.summary,
            "evaluation_report": str(self.evaluation.report.absolute()) if self.evaluation.report else None,
        }

    def _rates(self) -> dict[str, float]:
        frames = {"import": sum(entry.frames or 0 for entry in self.entries), "retarget": _frames(self.results)}
        return {step: count / self.seconds[step] for step, count in frames.items()}


def print_report(report: DemoReport) -> None:
    """Print the quality of the motion, a table of numbers, the reasons for refusals, and the paths of all files."""
    typer.echo(f"{report.evaluation.sentence}\n")
    print_rows(_rows(report))
    for step, reason in report.refused[:REASONS_SHOWN]:
        print_message(f"refused in the step {step}: {reason}")
    if len(report.refused) > REASONS_SHOWN:
        print_message(f"... and {len(report.refused) - REASONS_SHOWN} more")
    print_message(f"\nserver data       {report.data.absolute()}")
    if report.exported:
        print_message(f"retargeted files  {report.exported[0].parent.absolute()}")
    if report.sheet:
        print_message(f"contact sheet     {report.sheet.absolute()}")
    if report.version and report.version.picture:
        print_message(f"smoothed clip     {report.version.picture.absolute()}")
    if report.evaluation.report:
        print_message(f"evaluation        {report.evaluation.report.absolute()}")
    marey, data = _command(), shlex.quote(str(report.data))
    token = shlex.quote(str(report.data / ADMIN_TOKEN_FILE))
    print_message(f"to browse, run    {marey} serve --data {data}   and   {marey} ls demo --token-file {token}")


def _command() -> str:
    """Return the command that starts `marey`: its name if a folder of `PATH` contains it, otherwise its path."""
    return "marey" if shutil.which("marey") else shlex.quote(sys.argv[0])


def _rows(report: DemoReport) -> Iterator[tuple[str, str, str]]:
    figures = report.as_dict()
    rates, seconds, sizes = figures["poses_per_second"], figures["seconds"], figures["bytes_per_pose"]
    taken = {status: count for status, count in figures["statuses"].items() if status != "failed"}
    refusals = Counter(step for step, _ in report.refused)
    yield "files", f"{figures['files']}", _counted(taken)
    if report.left_out:
        yield "left out", f"{report.left_out}", "not motion files"
    yield "warnings", f"{sum(report.warnings.values())}", _counted(dict(report.warnings.most_common()))
    yield "refused", f"{len(report.refused)}", _counted({f"in {step}": count for step, count in refusals.items()})
    yield "imported", f"{figures['frames']:,}", "frames, uploaded, read, checked and stored"
    yield "", f"{seconds['import']:.2f}", "seconds"
    yield "", f"{rates['import']:,.0f}", "poses per second"
    yield "", f"{sizes['takes']:.0f}", "bytes per pose"
    yield (
        "retargeted",
        f"{figures['retargeted_frames']:,}",
        f"frames in {figures['retargeted_clips']} clips on another skeleton",
    )
    shared = (
        f"; {report.shared_tasks} of {report.tasks} tasks reuse results of earlier ones" if report.shared_tasks else ""
    )
    yield "", f"{seconds['retarget']:.2f}", f"seconds, through queue and worker{shared}"
    yield "", f"{rates['retarget']:,.0f}", "poses per second"
    yield "", f"{sizes['retargeted']:.0f}", "bytes per pose"
    if (version := report.version) is not None:
        edited = f"; {version.edited} was smoothed on a branch and merged" if version.edited else ""
        yield "version", version.tag, f"of the dataset {DATASET}, with {version.entries} entries{edited}"
    yield from _evaluation_rows(report)


def _evaluation_rows(report: DemoReport) -> Iterator[tuple[str, str, str]]:
    yield "evaluated", f"{report.evaluation.chosen}", report.evaluation.selection
    if (found := report.evaluation.summary) is not None:
        yield (
            "",
            f"{report.seconds['evaluate']:.2f}",
            f"seconds for {found['trials']} trials, report and figures included",
        )
        if found["offset_mean_m"] is not None:
            yield "", f"{found['offset_mean_m']:.2f}", "metres off the path on average"
        yield "", f"{found['coverage_index']:.0%}", "of the speeds and turn rates covered"


def _counted(counts: dict[str, int]) -> str:
    return ", ".join(f"{count} {what}" for what, count in counts.items())


def _frames(items: Sequence[Item]) -> int:
    return sum(int(item.summary.get("frames", 0)) for item in items)


def _bytes_per_pose(items: Sequence[Item]) -> float:
    return sum(item.parts["motion"].size_bytes for item in items) / max(1, _frames(items))
