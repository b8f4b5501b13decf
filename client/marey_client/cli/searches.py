"""Commands `search` and `tree` for motions of models, `index` and `similar` for moments of clips."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from marey_client.cli.addresses import Address, addresses_in_one_project, require_item
from marey_client.cli.models import model_at
from marey_client.cli.perception.metrics import MetricName, metric_at
from marey_client.cli.terminal.failures import WrongUsage
from marey_client.cli.terminal.following import (
    FINDINGS_JOB,
    SEEDED_JOB,
    Sources,
    Wait,
    clips_at,
    follow,
    print_ended,
)
from marey_client.cli.terminal.invocation import AsJson, connect, output_option, refuse_ignored
from marey_client.cli.terminal.output import print_json, print_message, print_table
from marey_client.cli.terminal.schema_options import Chosen, OptionsOf, add_command
from marey_client.cli.terminal.typed_values import read_json
from marey_schemas.formats import DEFAULT_FORMAT, MOTION_FORMATS
from marey_schemas.wording import counted, one_of

if TYPE_CHECKING:
    from marey_client.marey import Marey
    from marey_schemas.search import SearchAnswer, SimilarAnswer

TREE = OptionsOf("marey_schemas.queue.job_params:TreeParams")

SEARCH = OptionsOf("marey_schemas.search:SearchRequest", without=("constraints", "steps", "start", "motion"))

INDEX = OptionsOf("marey_schemas.queue.job_params:IndexParams")

SIMILAR = OptionsOf("marey_schemas.search:SimilarOptions", short={"results": "-n"}, without=("metric", "index"))

Many = list[str] | None


def add_to(app: typer.Typer) -> None:
    """Add the commands of this module to the application `app`."""
    add_command(app, tree, params=TREE, job=SEEDED_JOB)
    add_command(app, search, params=SEARCH)
    add_command(app, index, params=INDEX, job=FINDINGS_JOB)
    add_command(app, similar, params=SIMILAR)


def tree(
    context: typer.Context,
    place: Annotated[str, typer.Argument(help="A model: project/folder/name, or project/id.")],
    params: Chosen,
    job: Chosen,
    wait: Wait = True,
    as_json: AsJson = False,
) -> None:
    """Group samples of a model into a tree, which speeds up searches for motions that meet constraints."""
    with connect(context) as marey:
        found = model_at(marey, place)
        submitted = marey.project(found.project).submit(found.tree_request(**params).model_copy(update=job))
        ended = follow(marey, submitted, wait=wait, as_json=as_json)
    if ended is not None:
        print_ended(ended, as_json, _print_tree)


def _print_tree(made: dict[str, Any]) -> None:
    typer.echo(f"{counted(made['samples'], 'sample')} in {counted(made['nodes'], 'node')}")


def search(
    context: typer.Context,
    place: Annotated[str, typer.Argument(help="A model: project/folder/name, or project/id.")],
    params: Chosen,
    at: Annotated[
        Many,
        typer.Option(
            help="Require a position of a joint in the world, in metres: WHEN:JOINT=x,y,z, such as "
            "end:left_wrist=0.2,_,1; _ leaves a coordinate free."
        ),
    ] = None,
    turned: Annotated[
        Many,
        typer.Option(
            help="Require a rotation of a joint in the world, as a quaternion: "
            "WHEN:JOINT=w,x,y,z, such as end:head=1,0,0,0."
        ),
    ] = None,
    look: Annotated[
        Many,
        typer.Option(
            help="Require a direction of a joint's z axis, in world coordinates: WHEN:JOINT=x,y,z, such as "
            "start:head=0,0,1. WHEN is start, end, a keyframe or a canonical frame."
        ),
    ] = None,
    look_at: Annotated[
        Many,
        typer.Option(
            help="Require that a joint's z axis points at a position, in metres: WHEN:JOINT=x,y,z, such as "
            "end:head=0,1,3."
        ),
    ] = None,
    stand: Annotated[
        Many, typer.Option(help="Require a position of the body on the ground: WHEN=x,z in metres, such as end=0,1.5.")
    ] = None,
    face: Annotated[
        Many,
        typer.Option(help="Require a heading of the body: WHEN=degrees from +z, positive to the left, such as end=90."),
    ] = None,
    time: Annotated[
        Many,
        typer.Option(
            help="Require that a keyframe is reached at a time after the beginning of the motion: KEYFRAME=seconds."
        ),
    ] = None,
    start: Annotated[
        str | None,
        typer.Option(
            help="Position on the ground, in metres, and heading where the motion starts: x,z,degrees. Default: 0,0,0."
        ),
    ] = None,
    tolerance_cm: Annotated[
        float | None, typer.Option(help="Tolerance of positions, in centimetres; default: 1.")
    ] = None,
    tolerance_deg: Annotated[
        float | None, typer.Option(help="Tolerance of rotations and directions, in degrees; default: 5.")
    ] = None,
    request: Annotated[
        Path | None,
        typer.Option(
            help="JSON file with the whole search request. Only such a file can request several consecutive motions."
        ),
    ] = None,
    out: Annotated[
        Path | None,
        output_option(
            "File or folder to which the motion is written. Default: the motion is not written, only described.",
        ),
    ] = None,
    format: Annotated[str, typer.Option(help=f"Format of the file: {one_of(MOTION_FORMATS)}.")] = DEFAULT_FORMAT,  # noqa: A002
    as_json: AsJson = False,
) -> None:
    """Find the motion that meets constraints best, among all motions of a model.

    WHEN in an option is the label of a keyframe, `start`, `end`, or the number of a canonical frame: a frame of the
    common time to which the examples of the model were aligned.
    """
    from marey_schemas.search import SearchRequest

    if format not in MOTION_FORMATS:
        raise WrongUsage(f"{format!r} is not a format; the formats are {', '.join(MOTION_FORMATS)}")
    asked: dict[str, Any] = _read_request(request)
    tolerance_m = None if tolerance_cm is None else tolerance_cm * 0.01
    constraints = [
        *_joint_constraints("joint_position", at, "target_m", 3, {"tolerance_m": tolerance_m}),
        *_joint_constraints("joint_orientation", turned, "rotation", 4, {"tolerance_deg": tolerance_deg}),
        *_joint_constraints("look_direction", look, "direction", 3, {"tolerance_deg": tolerance_deg}),
        *_joint_constraints("look_direction", look_at, "point_m", 3, {"tolerance_deg": tolerance_deg}),
        *_body_constraints("root_position", stand, "target_m", 2, {"tolerance_m": tolerance_m}),
        *_body_constraints("root_heading", face, "heading_deg", 1, {"tolerance_deg": tolerance_deg}),
        *_body_constraints("keyframe_time", time, "seconds", 1, {}),
    ]
    if constraints:
        asked["constraints"] = constraints
    if not (asked.get("constraints") or asked.get("steps")):
        raise WrongUsage(
            "a search needs at least one constraint; give --at WHEN:JOINT=x,y,z or another "
            "option that adds a constraint"
        )
    if not constraints:
        refuse_ignored(context, "without an option that adds a constraint", "tolerance_cm", "tolerance_deg")
    asked |= params
    if start is not None:
        asked["start"] = _start(start)
    SearchRequest.model_validate(asked)
    with connect(context) as marey:
        found = model_at(marey, place)
        answer = found.search(**(asked | {"motion": False}))
        written = None if out is None else found.save_search(out, format=format, **asked)
    if as_json:
        file = None if written is None else str(written)
        return print_json({"answer": answer.model_dump(mode="json", exclude_none=True), "file": file})
    _print(answer)
    return None if written is None else typer.echo(written)


def index(
    context: typer.Context,
    sources: Sources,
    params: Chosen,
    job: Chosen,
    wait: Wait = True,
    as_json: AsJson = False,
) -> None:
    """Build or update an index of the poses of clips, which `marey similar` searches.

    `marey index lab` indexes all clips of the project `lab`. An update reads only new and changed clips.
    """
    addresses = addresses_in_one_project(sources)
    with connect(context) as marey:
        clips = [clips_at(marey, address) for address in addresses]
        submitted = marey.project(addresses[0].project).index(clips, **params, **job)
        ended = follow(marey, submitted, wait=wait, as_json=as_json)
    if ended is not None:
        print_ended(ended, as_json, _print_index)


def _print_index(made: dict[str, Any]) -> None:
    typer.echo(
        f"{counted(made['clips'], 'clip')}, {made['new_clips']} of them new, in {counted(made['shards'], 'shard')}"
    )
    if made["left_out"]:
        print_message(f"{counted(made['left_out'], 'clip')} cannot be compared; the log of the job names them.")


def similar(
    context: typer.Context,
    example: Annotated[
        str,
        typer.Argument(
            help="A clip and its frames: project/folder/name:FIRST-END, where the frame END is not included, or "
            "project/folder/name:FRAME for a single pose."
        ),
    ],
    params: Chosen,
    at_index: Annotated[
        str | None,
        typer.Option(
            "--index",
            help="Index to search: project/folder/name, or project/id. Default: the index of the project that was "
            "updated last.",
        ),
    ] = None,
    metric: MetricName = None,
    as_json: AsJson = False,
) -> None:
    """Find the moments of a project's clips that resemble some frames of a clip, the most similar first."""
    from marey_schemas.kinds import Kind
    from marey_schemas.queries.moments import read_moment

    try:
        moment = read_moment(example)
    except ValueError as error:
        raise WrongUsage(str(error)) from None
    place = Address.parse(moment.clip)
    with connect(context) as marey:
        clip = require_item(marey, place, [Kind.CLIP])
        chosen = None if metric is None else _metric_of(marey, place.project, metric)
        if at_index is not None:
            params["index"] = _index_of(marey, place.project, at_index)
        found = marey.project(place.project).similar(clip, moment.frames, metric=chosen, **params)
    return print_json(found) if as_json else _print_similar(found)


def _index_of(marey: Marey, project: str, index: str) -> str:
    """Return the id of the index to search, which is given as an address or as an id.

    Raises `WrongUsage` if there is none, or if it is of another project.
    """
    from marey_schemas.kinds import Kind

    address = Address.parse(index if "/" in index else f"{project}/{index}")
    if address.project != project:
        raise WrongUsage(
            f"the index {index} is in the project {address.project}; give an index in {project}, where the clip is"
        )
    return str(require_item(marey, address, [Kind.INDEX]).id)


def _metric_of(marey: Marey, project: str, metric: str) -> str:
    """Return the name or the id of the metric of a search.

    Raises `WrongUsage` if there is no such metric, or if another project has it.
    """
    from marey_schemas.documents.metrics import is_built_in

    if not is_built_in(metric) and (other := Address.parse(metric).project) != project:
        raise WrongUsage(f"the metric is in the project {other}; store it in {project}, where the clip is")
    return str(metric_at(marey, metric))


# -- reading what is asked ---------------------------------------------------------------------------------------------


def _read_request(path: Path | None) -> dict[str, Any]:
    if path is None:
        return {}
    read = read_json(path)
    if not isinstance(read, dict):
        raise WrongUsage(f"the file {path} must contain the search request as a JSON object")
    return read


def _joint_constraints(
    kind: str, texts: Sequence[str] | None, field: str, count: int, tolerance: dict[str, float | None]
) -> list[dict[str, Any]]:
    made = []
    for text in texts or ():
        place, _, values = text.partition("=")
        moment, colon, joint = place.rpartition(":")
        if not (colon and moment and joint and values):
            raise WrongUsage(f"{text!r} is not a constraint on a joint; write WHEN:JOINT={','.join('wxyz'[-count:])}")
        made.append({"joint": joint, **_constraint(kind, moment, field, _numbers(values, count, text), tolerance)})
    return made


def _body_constraints(
    kind: str, texts: Sequence[str] | None, field: str, count: int, tolerance: dict[str, float | None]
) -> list[dict[str, Any]]:
    made = []
    for text in texts or ():
        moment, _, values = text.rpartition("=")
        if not (moment and values):
            raise WrongUsage(f"{text!r} names no time and value; write WHEN={('x,z' if count == 2 else 'number')}")
        numbers = _numbers(values, count, text)
        made.append(_constraint(kind, moment, field, numbers if count > 1 else numbers[0], tolerance))
    return made


def _constraint(
    kind: str, moment: str, field: str, value: object, tolerance: dict[str, float | None]
) -> dict[str, Any]:
    given = {name: size for name, size in tolerance.items() if size is not None}
    return {"type": kind, "at": _moment(moment), field: value, **given}


def _moment(text: str) -> str | float:
    """Parse the time of a constraint: a number is a canonical frame, any other text is a label."""
    try:
        return float(text)
    except ValueError:
        return text


def _numbers(text: str, count: int, whole: str) -> list[float | None]:
    parts = text.split(",")
    try:
        numbers = [None if part.strip() == "_" else float(part) for part in parts]
    except ValueError:
        raise WrongUsage(f"{whole!r}: {text!r} must be {count} numbers, separated by commas") from None
    if len(numbers) != count:
        raise WrongUsage(f"{whole!r} has {len(numbers)} numbers where {count} are needed")
    return numbers


def _start(text: str) -> dict[str, float | None]:
    x, z, heading = _numbers(text, 3, f"--start {text}")
    return {"x": x, "z": z, "heading_deg": heading}


# -- output ------------------------------------------------------------------------------------------------------------


def _print_similar(found: SimilarAnswer) -> None:
    rows = [
        (
            one.path,
            f"{one.frames[0]}-{one.frames[1]}",
            f"{one.start_s:.2f}-{one.end_s:.2f}",
            f"{one.distance:.3f}",
            "mirrored" if one.mirrored else "",
        )
        for one in found.moments
    ]
    print_table(("clip", "frames", "s", "distance", ""), rows, right=("frames", "s", "distance"))
    if found.metric is not None:
        typer.echo(f"metric: {found.metric.name}")
    if found.behind:
        print_message(
            f"{counted(found.behind, 'clip')} changed since the index was updated, and {found.searched_clips:,} were "
            "searched; `marey index` updates it."
        )


def _print(answer: SearchAnswer) -> None:
    rows = []
    for one in answer.errors:
        unit, error = next(
            (unit, value)
            for unit, value in (("cm", one.error_cm), ("deg", one.error_deg), ("s", one.error_s))
            if value is not None
        )
        left = error if one.finished_error is None else one.finished_error
        what = f"{one.type} {one.joint}" if one.joint else one.type
        searched = "" if one.searched_error is None else f"{one.searched_error:.3f}"
        rows.append((one.step, what, searched, f"{left:.3f}", unit, "yes" if one.reached else "no"))
    columns = ("step", "constraint", "after search", "final error", "unit", "reached")
    print_table(columns, rows, right=columns[2:4])
    for number, step in enumerate(answer.steps):
        likely = step.likelihood_percentile
        likelihood = "" if likely is None else f", likelier than {likely:.0f} % of the examples"
        typer.echo(f"step {number}: {step.duration_s:.2f} s{likelihood}")
        if step.tree == "drawn":
            print_message("The model has no tree, so samples were drawn for this search; `marey tree` builds one.")
    for place in answer.out_of_reach:
        print_message(f"constraint {place} is out of the model's reach: the model was not trained on such motions.")
