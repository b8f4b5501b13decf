"""Commands `evaluate`, which measures locomotion clips, and `report`, which writes the report of a result."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from marey_client.cli.addresses import Address, addresses_in_one_project, advice, find_item, require_item
from marey_client.cli.perception.metrics import MetricName, metric_at
from marey_client.cli.terminal.failures import WrongUsage
from marey_client.cli.terminal.following import (
    JOB,
    Sources,
    Wait,
    clips_at,
    follow,
    print_commit,
    refuse_without_waiting,
)
from marey_client.cli.terminal.invocation import AsJson, connect, output_option
from marey_client.cli.terminal.output import print_json, print_message, print_table
from marey_client.cli.terminal.schema_options import Chosen, OptionsOf, add_command
from marey_client.cli.terminal.typed_values import is_frame
from marey_schemas.wording import counted

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from marey_client.handles.evaluations import EvaluationHandle
    from marey_client.marey import Marey

WORST_SHOWN = 5
EVALUATE = OptionsOf(
    "marey_schemas.queue.job_params:EvaluateParams",
    short={
        "speeds_m_s": "--speeds",
        "turn_rates_deg_s": "--turns",
        "approach_s": "--approach",
        "duration_s": "--duration",
        "mirroring": "--mirror",
    },
    without=("loops", "trims", "metric"),
    defaults={"name": "the name of the first folder or clip, followed by -eval; of a whole project, evaluation"},
)

Loops = Annotated[
    list[str] | None, typer.Option("--loop", help="A clip that is a loop, or a folder of loops; may be repeated.")
]
Trims = Annotated[
    list[str] | None,
    typer.Option(
        "--trim",
        help="Range of frames to use of a clip, as project/folder/clip=first:stop, without "
        "the frame stop; may be repeated. Default: the whole clip.",
    ),
]
Normaliser = Annotated[
    str | None,
    typer.Option(
        help="Evaluation whose scaling of features is used, so that the results of both evaluations can be compared: "
        "project/folder/name."
    ),
]


def add_to(app: typer.Typer) -> None:
    """Add the commands of this module to the application `app`."""
    add_command(app, evaluate, params=EVALUATE, job=JOB)
    app.command()(report)


def evaluate(
    context: typer.Context,
    sources: Sources,
    params: Chosen,
    job: Chosen,
    into: Annotated[str | None, typer.Option(help="Folder of the result; default: the folder of the clips.")] = None,
    loop: Loops = None,
    trim: Trims = None,
    normaliser: Normaliser = None,
    metric: MetricName = None,
    out: Annotated[
        Path | None,
        output_option("Also write the report of the evaluation, an HTML page, to this file."),
    ] = None,
    wait: Wait = True,
    as_json: AsJson = False,
) -> None:
    """Measure the quality of locomotion clips by simulated motion matching: accuracy, coverage and use of the clips."""
    from marey_schemas.queue.job_params import EvaluateParams

    addresses = addresses_in_one_project(sources)
    refuse_without_waiting(wait, out=out)
    folder, last = _place_beside(addresses[0].path)
    params.setdefault("name", f"{last}-eval" if last else "evaluation")
    with connect(context) as marey:
        project = marey.project(addresses[0].project)
        add_clip_options(marey, params, loop, trim)
        submitted = project.evaluate(
            [clips_at(marey, address) for address in addresses],
            into=folder if into is None else into.strip("/"),
            normaliser=evaluation_at(marey, normaliser).id if normaliser else None,
            metric=metric_at(marey, metric),
            **job,
            **params,
        )
        trials = EvaluateParams.model_validate(params).trial_count
        ended = follow(marey, submitted, wait=wait, as_json=as_json, count=trials, unit="trials")
        if ended is None:
            return
        found = project.evaluation(ended)
        if out is not None:
            found.save_report(out)
        _print_evaluation(found, as_json)
    if out is not None:
        print_message(f"report: {out}")
    print_commit(ended)


def add_clip_options(marey: Marey, params: Chosen, loop: Sequence[str] | None, trim: Sequence[str] | None) -> None:
    """Add the clips that --loop and --trim name, as ids, to the parameters of an evaluation.

    With --loop, the end policy of the database is `loop`, unless the parameters set another policy.
    """
    if loop:
        params.setdefault("database", {}).setdefault("end_policy", "loop")
        params["loops"] = [one.id for place in loop for one in clips_in(marey, Address.parse(place))]
    if trim:
        params["trims"] = dict(_trim(marey, text) for text in trim)


def _place_beside(path: str) -> tuple[str, str]:
    """Return the folder and the name of a result of the input `path`: `lab`, `gaits-v1-raw` for `lab/gaits@v1/raw`."""
    named, at, version = path.partition("@")
    folder, _, last = named.rpartition("/")
    return folder, f"{last}{at}{version}".replace("@", "-").replace("/", "-")


def report(
    context: typer.Context,
    place: Annotated[str, typer.Argument(help="An evaluation or a model: project/folder/name, or project/id.")],
    out: Annotated[Path, output_option("File that receives the report.")] = Path("report.html"),
    figures: Annotated[
        Path | None,
        typer.Option(help="Also write every figure to this folder, as PNG and SVG, with its data as JSON and CSV."),
    ] = None,
    walk_graph: Annotated[
        Path | None,
        typer.Option(
            help="Also write the frames that the trials of an evaluation displayed, and the jumps between them, "
            "as a graph to this file, which ends in .graphml or .json."
        ),
    ] = None,
    trial: Annotated[
        str | None, typer.Option(help="Name of the trial that --walk-graph writes; default: all trials together.")
    ] = None,
    open_it: Annotated[bool, typer.Option("--open", help="Open the report in a browser.")] = False,
) -> None:
    """Write the report of an evaluation or a model to a file."""
    from marey_schemas.kinds import Kind

    if walk_graph is not None and walk_graph.suffix.lower() not in (".graphml", ".json"):
        raise WrongUsage(f"--walk-graph: {walk_graph} must end in .graphml or .json")
    if trial is not None and walk_graph is None:
        raise WrongUsage("--trial has an effect only together with --walk-graph; give both")
    kinds = [Kind.EVALUATION, Kind.MODEL] if walk_graph is None else [Kind.EVALUATION]
    with connect(context) as marey:
        found = require_item(marey, Address.parse(place), kinds)
        found.save_report(out)
        if walk_graph is not None:
            found.save_walk_graph(walk_graph, trial=trial)
        drawn = found.save_figures(figures) if figures is not None else []
    typer.echo(out)
    if walk_graph is not None:
        print_message(f"walk graph: {walk_graph}")
    if figures is not None:
        print_message(f"{counted(len(drawn), 'file')} of figures in {figures}")
    if open_it:
        import webbrowser

        webbrowser.open(out.absolute().as_uri())


def clips_in(marey: Marey, address: Address) -> list[Any]:
    """Return the clip at an address, or all clips in a folder and below it, in the order of their paths."""
    from marey_schemas.kinds import Kind

    project = marey.project(address.project)
    clip = find_item(marey, address, [Kind.CLIP])
    found = (
        [clip] if clip is not None else sorted(project.clips.list(collection=address.path), key=lambda one: one.path)
    )
    if not found:
        raise WrongUsage(f"there is no clip at {address}, nor below it; {advice(project, address.path, (Kind.CLIP,))}")
    return found


def _trim(marey: Marey, text: str) -> tuple[str, tuple[int, int]]:
    """Parse `project/folder/clip=first:stop`; return the id of the clip and the range of frames."""
    from marey_schemas.kinds import Kind

    place, _, frames = text.rpartition("=")
    first, colon, stop = frames.partition(":")
    if not (place and colon and is_frame(first) and is_frame(stop)):
        raise WrongUsage(
            f"{text!r} is not a clip with a range of frames; write "
            "project/folder/clip=first:stop, as in lab/walks/take=120:900"
        )
    return require_item(marey, Address.parse(place), [Kind.CLIP]).id, (int(first), int(stop))


def evaluation_at(marey: Marey, place: str) -> EvaluationHandle:
    """Return the evaluation at an address. Raises `WrongUsage` if there is none."""
    from marey_schemas.kinds import Kind

    found: EvaluationHandle = require_item(marey, Address.parse(place), [Kind.EVALUATION])
    return found


def _print_evaluation(found: EvaluationHandle, as_json: bool) -> None:
    if as_json:
        return print_json({"evaluation": found.item, "summary": found.summary(), "trials": found.trials()})
    typer.echo(found.verdict)
    document = found.document()
    if (perceived := document.get("perceived")) is not None:
        typer.echo(perceived_text(perceived))
    for region in document.get("regions", ()):
        typer.echo(region["sentence"])
    rows = [(row["trial"], _number(row["offset_mean"], 2), _number(row["se_v"], 2), _number(row["se_omega_deg"], 1),
             _number(row.get("foot_skate"), 2), ", ".join(row.get("beyond_limits", ())))
            for row in found.worst_trials()[:WORST_SHOWN]]  # fmt: skip
    columns = ("worst trials", "offset m", "speed error m/s", "turn error deg/s", "feet slide m/s", "beyond limits")
    print_table(columns, rows, right=columns[1:-1])
    return print_message(f"to write the report, run marey report {found.project}/{found.path} --out report.html")


def perceived_text(perceived: Mapping[str, Any]) -> str:
    """Return a sentence about the number and the perceptual distances of the transitions between clips."""
    if not perceived["transitions"]:
        return f"There are no transitions to measure by the metric {perceived['metric']}."
    return (
        f"{counted(perceived['transitions'], 'transition')}: perceptual distance {perceived['median']:.2f} (median), "
        f"{perceived['p95']:.2f} (95th percentile), by the metric {perceived['metric']}."
    )


def _number(value: float | None, digits: int) -> str:
    return "" if value is None else f"{value:.{digits}f}"
