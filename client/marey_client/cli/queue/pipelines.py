"""Commands `pipeline` and `build-model`: they submit jobs that read each other's outputs, and follow the jobs."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from marey_client.cli.addresses import Address, require_item
from marey_client.cli.terminal.failures import INTERRUPTED, Refused, WrongUsage
from marey_client.cli.terminal.following import SEEDED_JOB, clips_at, commit_text
from marey_client.cli.terminal.invocation import AsJson, connect
from marey_client.cli.terminal.output import print_json, print_message, print_refused, print_table
from marey_client.cli.terminal.schema_options import Chosen, OptionsOf, add_command
from marey_client.cli.terminal.typed_values import json_or_text, read_json
from marey_client.progress import progress
from marey_schemas.wording import counted

if TYPE_CHECKING:
    from marey_client.handles.pipelines import PipelineRun
    from marey_client.marey import Marey
    from marey_schemas.queue.jobs import Job

COLUMNS = ("step", "kind", "state", "done", "job", "")
COUNTED = ("clips", "annotations", "frames", "samples", "nodes")
REFUSED_SHOWN = 3

STEPS = ("import", "annotate", "cut", "align", "model", "tree")


PROPOSE = OptionsOf("marey_schemas.queue.job_params:AnnotateParams", only=("proposal",), short={"method": "--propose"})

Wait = Annotated[bool, typer.Option("--wait/--no-wait", help="Wait until every job has ended.")]


def add_to(app: typer.Typer) -> None:
    """Add the commands of this module to the application `app`."""
    app.command()(pipeline)
    add_command(app, build_model, propose=PROPOSE, job=SEEDED_JOB)


def pipeline(
    context: typer.Context,
    file: Annotated[Path, typer.Argument(help="JSON file of the pipeline; - reads standard input.")],
    project: Annotated[str, typer.Option(help="The project that the pipeline runs in.")],
    wait: Wait = True,
    as_json: AsJson = False,
) -> None:
    """Submit a graph of jobs, and follow the jobs. Results that were computed before are used again."""
    from marey_schemas.queue.pipelines import PipelineCreate

    wanted = PipelineCreate.model_validate(read_json(file))
    with connect(context) as marey:
        run = marey.project(project).pipeline(wanted)
        follow_run(run, project, wait=wait, as_json=as_json)


def build_model(
    context: typer.Context,
    takes: Annotated[
        list[str],
        typer.Argument(help="Clips or folders of clips, as project/folder[/name]. With --project: local files."),
    ],
    name: Annotated[str, typer.Option(help="Name of the model.")],
    propose: Chosen,
    job: Chosen,
    project: Annotated[
        str | None,
        typer.Option(help="Project to which local files are uploaded. Default: the takes are clips on the server."),
    ] = None,
    to: Annotated[
        str | None,
        typer.Option(
            help="Skeleton to retarget the takes to: project/folder/name. Default: the takes are not retargeted."
        ),
    ] = None,
    into: Annotated[str | None, typer.Option(help="Folder of the results; default: the name of the model.")] = None,
    layer: Annotated[
        str | None,
        typer.Option(
            help="Layer of the annotations to use. With --propose: name of the layer for the proposed annotations."
        ),
    ] = None,
    label: Annotated[
        list[str] | None, typer.Option(help="Use only segments with this label; may be repeated. Default: all labels.")
    ] = None,
    whole: Annotated[
        bool,
        typer.Option("--whole", help="Do not cut the takes into pieces; use their annotations only to align them."),
    ] = False,
    rate: Annotated[
        float | None,
        typer.Option(
            help="Frames per second of the aligned clips. Default: the most common frame rate of the examples."
        ),
    ] = None,
    mirror: Annotated[
        bool, typer.Option("--mirror", help="Also train the model on mirrored copies of the examples.")
    ] = False,
    tree: Annotated[
        bool, typer.Option("--tree/--no-tree", help="Build a tree of samples for the model, which speeds up searches.")
    ] = True,
    choices: Annotated[
        list[str] | None,
        typer.Option(
            "--set", help="Parameter of a step as step.parameter=value, such as align.window=5; may be repeated."
        ),
    ] = None,
    wait: Wait = True,
    as_json: AsJson = False,
) -> None:
    """Make a model from takes: import, retarget, annotate, cut and align them, train the model, build its search tree.

    Existing results are used again: if a take has changed, only the results that depend on this take are computed.
    """
    plan: dict[str, Any] = _chosen(choices or ())
    if propose:
        method = propose["proposal"]["method"]
        _choose(plan, ("annotate", "proposal", "method"), method, f"--propose {method}")
        plan["annotate"] |= {"layer": layer} if layer else {}
    elif layer is not None:
        plan["layer"] = layer
    if label or ((propose or layer) and not whole):
        plan.setdefault("align" if whole else "cut", {}).update({"labels": label} if label else {})
    plan["align"] = {
        **plan.get("align", {}),
        **({} if rate is None else {"rate_hz": rate}),
        **({"mirroring": "add"} if mirror else {}),
    }
    plan |= {} if tree else {"tree": None}
    plan |= {"into": into.strip("/")} if into else {}
    with connect(context) as marey:
        place, found = _takes(marey, takes, project, plan.pop("import", {}))
        if to is not None:
            plan["skeleton"] = {"item": _skeleton(marey, to, place)}
        with progress() as advance:
            run = marey.project(place).build_model(**found, **plan, **job, name=name, notice=advance)
        follow_run(run, place, wait=wait, as_json=as_json)


def _chosen(choices: Iterable[str]) -> dict[str, dict[str, Any]]:
    """Return the parameters that `--set step.parameter=value` gives, by step; `step.a.b=value` sets `b` within `a`."""
    chosen: dict[str, dict[str, Any]] = {}
    for text in choices:
        path, equals, value = text.partition("=")
        step, *names = path.split(".")
        if not equals or step not in STEPS or not all(names) or not names:
            raise WrongUsage(
                f"{text!r} does not set a parameter of a step; write step.parameter=value, where step "
                f"is one of {', '.join(STEPS)}"
            )
        _choose(chosen, (step, *names), json_or_text(value), f"--set {text}")
    return chosen


def _choose(chosen: dict[str, Any], path: Sequence[str], value: Any, option: str) -> None:
    """Set the value at a path in nested objects. Raises `WrongUsage` if the path conflicts with an earlier option."""
    place: Any = chosen
    for depth, name in enumerate(path[:-1], start=1):
        place = place.setdefault(name, {})
        if not isinstance(place, dict):
            raise WrongUsage(f"{option} conflicts with --set {'.'.join(path[:depth])}={place}; give only one of them")
    place[path[-1]] = value


def _takes(marey: Marey, takes: list[str], project: str | None, options: dict[str, Any]) -> tuple[str, dict[str, Any]]:
    """Return the project, and the takes in the form that `build_model` needs. Local files are uploaded."""
    if project is None:
        addresses = [Address.parse(take) for take in takes]
        if len({address.project for address in addresses}) > 1:
            raise WrongUsage("the takes must be in one project")
        if options:
            raise WrongUsage(
                "there are parameters for an import, but the takes are clips of a project; leave out these "
                "parameters, or give local files, and name the project that receives the files with --project"
            )
        return addresses[0].project, {"takes": [clips_at(marey, address) for address in addresses]}
    from marey_client.imports import find_files, left_out_texts
    from marey_schemas.options.imports import ImportOptions

    found = find_files(map(Path, takes))
    if found.exported:
        raise WrongUsage(
            "the takes are in a folder that `marey dataset export` wrote; first import the folder with `marey "
            "upload`, which also imports take records and consents, then give the imported clips as takes"
        )
    for text in left_out_texts(found.left_out):
        print_message(text)
    return project, {"takes": found.files, "options": ImportOptions.model_validate(options)}


def _skeleton(marey: Marey, to: str, project: str) -> str:
    from marey_schemas.kinds import Kind

    address = Address.parse(to)
    if address.project != project:
        raise WrongUsage("the takes and the skeleton must be in one project")
    skeleton_id: str = require_item(marey, address, [Kind.SKELETON]).id
    return skeleton_id


def follow_run(run: PipelineRun, project: str, *, wait: bool, as_json: bool) -> None:
    """Wait for the jobs of a pipeline if requested, and print their states.

    Raises `JobUnsuccessful` if a job did not succeed, and `Refused` if jobs refused some of their inputs or if results
    could not be committed to the requested branch.
    """
    if not wait:
        return print_steps(run, as_json)
    try:
        with _live_table() as show:
            run.wait(on_progress=show)
    except KeyboardInterrupt:
        first = next((job.id for job in run.steps.values() if not job.state.terminal), "JOB")
        print_message(
            f"the jobs continue on the server; `marey job ls {project}` shows them, "
            f"`marey job cancel {first}` stops them"
        )
        raise typer.Exit(INTERRUPTED) from None
    finally:
        print_steps(run, as_json)
        if not as_json:
            _print_shortfalls(run)
    if any(_refused(job) or job.publish_conflict for job in run.steps.values()):
        raise Refused
    return None


def _refused(job: Job) -> list[Mapping[str, Any]]:
    """Return the inputs that a job refused; the inputs of an import are files."""
    result = job.result or {}
    failed = [entry for entry in result.get("entries", ()) if entry["status"] == "failed"]
    return [*result.get("refused", ()), *({"name": entry["name"], **entry["error"]} for entry in failed)]


def _print_shortfalls(run: PipelineRun) -> None:
    """Print the refused inputs of each step, the inputs in which it found nothing, its notes, and its commit."""
    for step, job in run.steps.items():
        if refused := _refused(job):
            print_message(f"{step} refused {counted(len(refused), 'input')}:")
            print_refused(refused, most=REFUSED_SHOWN)
        result = job.result or {}
        if empty := result.get("empty"):
            places = empty[0] if len(empty) == 1 else f"{len(empty)} clips, such as {empty[0]}"
            print_message(f"{step} found nothing in {places}")
        for note in result.get("notes", ()):
            print_message(f"{step}: {note}")
        if job.commit is not None and job.state == "succeeded":
            print_message(f"{step}: {commit_text(job)}")


def print_steps(run: PipelineRun, as_json: bool) -> None:
    """Print a table with the state of the job of each step."""
    if as_json:
        print_json({"jobs": dict(run.steps)})
    else:
        print_table(COLUMNS, map(_row, run.steps.items()))


@contextmanager
def _live_table() -> Iterator[Callable[[Mapping[str, Job]], None]]:
    """Yield a function that shows a table of jobs on standard error; without a terminal, the function does nothing."""
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
    return f"{job.state} (reused)" if job.cached_from and job.state.terminal else str(job.state)


def _done(job: Job) -> str:
    """Return how many of a job's tasks have succeeded, as in 3/8, or the progress in percent of a job without tasks."""
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
