"""Commands `retarget`, `align` and `cut`: jobs that create clips from clips."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

import typer

from marey_client.cli.addresses import Address, addresses_in_one_project, require_item
from marey_client.cli.perception.metrics import MetricName, metric_at
from marey_client.cli.terminal.following import JOB, Into, Sources, Wait, clips_at, follow, input_at, print_ended
from marey_client.cli.terminal.invocation import AsJson, connect
from marey_client.cli.terminal.output import print_message, print_table
from marey_client.cli.terminal.schema_options import Chosen, OptionsOf, add_command
from marey_schemas.wording import counted

if TYPE_CHECKING:
    from marey_client.marey import Marey

RETARGET = OptionsOf("marey_schemas.queue.job_params:RetargetParams")
ALIGN = OptionsOf(
    "marey_schemas.queue.job_params:AlignParams",
    short={"rate_hz": "--rate", "mirroring": "--mirror"},
    nulls={"slope_limit": "-1"},
    without=("metric",),
)
CUT = OptionsOf(
    "marey_schemas.queue.job_params:CutParams",
    short={
        "margin_before_s": "--before",
        "margin_after_s": "--after",
        "shortest_s": "--shortest",
        "longest_s": "--longest",
    },
)
REFERENCES = ("medoid", "nearest_mean_length")
SQUARE_CM = 1e4  # in a square metre


def add_to(app: typer.Typer) -> None:
    """Add the commands of this module to the application `app`."""
    add_command(app, retarget, params=RETARGET, job=JOB)
    add_command(app, align, params=ALIGN, job=JOB)
    add_command(app, cut, params=CUT, job=JOB)


def retarget(
    context: typer.Context,
    sources: Sources,
    to: Annotated[
        str, typer.Option(help="The skeleton to which the motion is transferred: project/folder/name, or project/id.")
    ],
    into: Into,
    params: Chosen,
    job: Chosen,
    wait: Wait = True,
    as_json: AsJson = False,
) -> None:
    """Transfer the motion of clips to another skeleton, as a job."""
    from marey_schemas.kinds import Kind
    from marey_schemas.queue.job_params import RetargetParams

    *addresses, target = addresses_in_one_project([*sources, to])
    with connect(context) as marey:
        clips = [clips_at(marey, address) for address in addresses]
        skeleton = require_item(marey, target, [Kind.SKELETON])
        submitted = marey.project(target.project).retarget(
            clips, skeleton.id, into=into.strip("/"), params=RetargetParams.model_validate(params), **job
        )
        ended = follow(marey, submitted, wait=wait, as_json=as_json)
    if ended is not None:
        _print_warnings(ended.result or {})
        print_ended(ended, as_json)


def align(
    context: typer.Context,
    sources: Sources,
    into: Into,
    params: Chosen,
    job: Chosen,
    annotations: Annotated[
        list[str] | None,
        typer.Option(
            help="Annotation to use, or folder of annotations; may be repeated. Default: all annotations of these "
            "clips."
        ),
    ] = None,
    metric: MetricName = None,
    wait: Wait = True,
    as_json: AsJson = False,
) -> None:
    """Align clips of one action with each other, as a job.

    `--reference` also accepts the address (project/folder/name) or the path (folder/name) of a clip.
    """
    from marey_schemas.kinds import Kind

    addresses = addresses_in_one_project(sources)
    with connect(context) as marey:
        given = [input_at(marey, Address.parse(place), Kind.ANNOTATION) for place in annotations or ()]
        if "reference" in params:
            params["reference"] = _reference(marey, params["reference"])
        clips = [clips_at(marey, address) for address in addresses]
        project = marey.project(addresses[0].project)
        submitted = project.align(
            clips,
            into=into.strip("/"),
            annotations=given or None,
            metric=metric_at(marey, metric),
            **job,
            **params,
        )
        ended = follow(marey, submitted, wait=wait, as_json=as_json)
    if ended is not None:
        print_ended(ended, as_json, _print_aligned)


def cut(
    context: typer.Context,
    sources: Annotated[
        list[str], typer.Argument(help="Annotations, or folders of annotations: project/folder[/name].")
    ],
    into: Into,
    params: Chosen,
    job: Chosen,
    wait: Wait = True,
    as_json: AsJson = False,
) -> None:
    """Cut clips along the segments of annotations; each piece keeps the keyframes inside its range of frames."""
    from marey_schemas.kinds import Kind

    addresses = addresses_in_one_project(sources)
    with connect(context) as marey:
        places = [input_at(marey, address, Kind.ANNOTATION) for address in addresses]
        project = marey.project(addresses[0].project)
        ended = follow(marey, project.cut(places, into=into.strip("/"), **job, **params), wait=wait, as_json=as_json)
    if ended is not None:
        print_ended(ended, as_json, print_labelled)


def print_labelled(result: dict[str, Any]) -> None:
    """Print the number of created clips or annotations, in total and by label, then the inputs without results."""
    made = counted(result["clips"], "clip") if "clips" in result else counted(result["annotations"], "annotation")
    counts = result.get("segments") or result.get("labels") or {}
    typer.echo(", ".join([made, *(f"{count} {label}" for label, count in counts.items())]))
    if empty := result.get("empty"):
        print_message(f"nothing was found in {counted(len(empty), 'clip')}, such as {empty[0]}")


def _print_warnings(result: dict[str, Any]) -> None:
    """Print the number of clips for each warning to standard error."""
    for code, count in result.get("warnings", {}).items():
        print_message(f"warning {code}: {counted(count, 'clip')}; see `marey show --part info` of a clip")


def _reference(marey: Marey, text: str) -> str:
    """Return the parameter `reference` of the job: the name of a rule that chooses the clip, or the id of a clip."""
    from marey_schemas.kinds import Kind

    return text if text in REFERENCES else str(require_item(marey, Address.parse(text), [Kind.CLIP]).id)


def _print_aligned(result: dict[str, Any]) -> None:
    metric = result.get("metric")
    cost, scale = ("cost, cm²", SQUARE_CM) if metric is None else ("distance", 1.0)
    columns = ("clip", "frames", cost, "slowest", "fastest", "")
    rows = [
        (
            one["name"],
            one["frames"],
            f"{one['cost'] * scale:.2f}",
            f"{one['least_slope']:.2f}",
            f"{one['greatest_slope']:.2f}",
            "reference" if one["name"] == result["reference"] else "",
        )
        for one in result["aligned"]
    ]
    print_table(columns, rows, right=columns[1:5])
    keyframes = ", ".join(f"{label} {frame}" for label, frame in result["keyframes"].items())
    typer.echo(
        f"{counted(result['clips'], 'clip')} of {counted(result['frames'], 'frame')} at {result['frame_rate_hz']:g} Hz"
        + (f"; keyframes: {keyframes}" if keyframes else "")
        + f"; {len(result['refused'])} refused"
        + ("" if metric is None else f"; metric: {metric['name']}")
    )
