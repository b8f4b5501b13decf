"""`pipeline`: jobs that work on what others of them make, handed in and followed together."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from marey_client.cli.failures import Refused
from marey_client.cli.invocation import AsJson, connect
from marey_client.cli.json_files import read_json
from marey_client.cli.output import print_json, print_table, tell, tell_refused

if TYPE_CHECKING:
    from marey_client.pipelines import PipelineRun
    from marey_schemas.jobs import Job

INTERRUPTED = 130
COLUMNS = ("step", "kind", "state", "done", "job", "")
COUNTED = ("clips", "annotations", "frames", "samples", "nodes")
REFUSED_SHOWN = 3

Wait = Annotated[bool, typer.Option("--wait/--no-wait", help="Wait until every job has ended.")]


def add_to(app: typer.Typer) -> None:
    """Register the commands of this module."""
    app.command()(pipeline)


def pipeline(
    context: typer.Context,
    file: Annotated[Path, typer.Argument(help="The pipeline, in JSON; - reads standard input.")],
    project: Annotated[str, typer.Option(help="The project it runs in.")],
    wait: Wait = True,
    as_json: AsJson = False,
) -> None:
    """Hand in a graph of jobs, and follow them. What was computed before is not computed again."""
    from marey_schemas.pipelines import PipelineCreate

    wanted = PipelineCreate.model_validate(read_json(file))
    with connect(context) as marey:
        run = marey.project(project).pipeline(wanted)
        follow_run(run, project, wait=wait, as_json=as_json)


def follow_run(run: PipelineRun, project: str, *, wait: bool, as_json: bool) -> None:
    """Wait for the jobs of a pipeline, if that is wanted, and print how they stand.

    Raises `JobUnsuccessful`, and `Refused` where jobs refused some of their inputs.
    """
    if not wait:
        return print_steps(run, as_json)
    try:
        with _live_table() as show:
            run.wait(on_progress=show)
    except KeyboardInterrupt:
        first = next((job.id for job in run.steps.values() if not job.state.terminal), "JOB")
        tell(f"the jobs go on without you; marey job ls {project} shows them, marey job cancel {first} stops them")
        raise typer.Exit(INTERRUPTED) from None
    finally:
        print_steps(run, as_json)
        if not as_json:
            _tell_shortfalls(run)
    if any(map(_refused, run.steps.values())):
        raise Refused
    return None


def _refused(job: Job) -> list[Mapping[str, Any]]:
    """What a job refused of its inputs; of an import, files."""
    result = job.result or {}
    failed = [entry for entry in result.get("entries", ()) if entry["status"] == "failed"]
    return [*result.get("refused", ()), *({"name": entry["name"], **entry["error"]} for entry in failed)]


def _tell_shortfalls(run: PipelineRun) -> None:
    """What did not go into the results of steps, and what their makers had to remark."""
    for step, job in run.steps.items():
        if refused := _refused(job):
            tell(f"{step} refused {len(refused)}:")
            tell_refused(refused, most=REFUSED_SHOWN)
        result = job.result or {}
        if empty := result.get("empty"):
            places = empty[0] if len(empty) == 1 else f"{len(empty)} clips, such as {empty[0]}"
            tell(f"{step} found nothing in {places}")
        for note in result.get("notes", ()):
            tell(f"{step}: {note}")


def print_steps(run: PipelineRun, as_json: bool) -> None:
    """Print how the jobs stand."""
    if as_json:
        print_json({"jobs": dict(run.steps)})
    else:
        print_table(COLUMNS, map(_row, run.steps.items()))


@contextmanager
def _live_table() -> Iterator[Callable[[Mapping[str, Job]], None]]:
    """A table on the error stream that is drawn anew while the block runs; nothing where that is no terminal."""
    if not sys.stderr.isatty():
        yield lambda _steps: None
        return
    from rich import box
    from rich.console import Console
    from rich.live import Live
    from rich.table import Table
    from rich.text import Text

    def drawn(steps: Mapping[str, Job]) -> Table:
        table = Table(*COLUMNS, box=box.SIMPLE_HEAD, pad_edge=False)
        for row in map(_row, steps.items()):
            table.add_row(*map(Text, row))
        return table

    with Live(console=Console(stderr=True), transient=True, auto_refresh=False) as live:
        yield lambda steps: live.update(drawn(steps), refresh=True)


def _row(step: tuple[str, Job]) -> tuple[str, ...]:
    name, job = step
    return name, job.kind, _state(job), _done(job), job.id, _remark(job)


def _state(job: Job) -> str:
    return f"{job.state}, as before" if job.cached_from and job.state.terminal else str(job.state)


def _done(job: Job) -> str:
    """Tasks that have ended, of those there are, or how far the job itself is."""
    if job.state.terminal and job.size is None:
        return ""
    if job.size is not None:
        return f"{job.children.get('succeeded', 0)}/{job.size} tasks"
    if job.progress is None or not job.progress.total:
        return ""
    return f"{100 * min(1.0, job.progress.done / job.progress.total):.0f} %"


def _remark(job: Job) -> str:
    if job.failure is not None:
        return " ".join(job.failure.detail.split())
    if job.progress is not None and not job.state.terminal:
        return job.progress.note
    result: Mapping[str, Any] = job.result or {}
    return result.get("verdict") or ", ".join(f"{result[name]} {name}" for name in COUNTED if name in result)
