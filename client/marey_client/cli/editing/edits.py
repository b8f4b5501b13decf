"""Command `edit`: saves, previews and applies commands that edit clips."""

from __future__ import annotations

import shlex
from typing import TYPE_CHECKING, Annotated, Any

import typer

from marey_client.cli.addresses import Address, addresses_in_one_project, require_item
from marey_client.cli.editing.edit_commands import command_text, object_types, parameter_rows, parse_command
from marey_client.cli.terminal.failures import WrongUsage
from marey_client.cli.terminal.following import JOB, Into, Sources, Wait, clips_at, follow, print_ended
from marey_client.cli.terminal.invocation import AsJson, connect
from marey_client.cli.terminal.output import print_json, print_pairs, print_table
from marey_client.cli.terminal.schema_options import Chosen, OptionsOf, add_command
from marey_client.cli.terminal.typed_values import is_frame, read_json
from marey_schemas.wording import counted, suggestion

if TYPE_CHECKING:
    from marey_client.handles.edits import EditHandle
    from marey_client.marey import Marey
    from marey_schemas.editing.edits import EditDocument
    from marey_schemas.editing.previews import EditPreview

edit = typer.Typer(no_args_is_help=True, rich_markup_mode=None, help="Edit clips with commands.")

EDIT = OptionsOf("marey_schemas.queue.job_params:EditParams", without=("commands",))

Do = Annotated[
    list[str] | None,
    typer.Option(
        "--do",
        help="A command, such as 'trim start=10 stop=200'; may be repeated. `marey edit commands` lists all commands.",
    ),
]
From = Annotated[
    str | None, typer.Option("--file", help="JSON file with a list of commands or an edit; - reads standard input.")
]
With = Annotated[str | None, typer.Option("--with", help="Saved edit whose commands are applied: project/folder/name.")]


def add_to(app: typer.Typer) -> None:
    """Add the commands of this module to the application `app`."""
    app.add_typer(edit, name="edit")
    add_command(edit, apply_edit, "apply", params=EDIT, job=JOB)


def apply_edit(
    context: typer.Context,
    sources: Sources,
    params: Chosen,
    job: Chosen,
    do: Do = None,
    file: From = None,
    saved: With = None,
    into: Into = "",
    wait: Wait = True,
    as_json: AsJson = False,
) -> None:
    """Apply commands, or a saved edit, to clips as a job; the results are new clips or new revisions."""
    addresses = addresses_in_one_project(sources)
    if not (into or params.get("suffix") or params.get("in_place")):
        raise WrongUsage(
            "choose where the results go: --into FOLDER, --suffix TEXT (next to the clips, with this text "
            "added to their names), or --in-place (new revisions of the clips)"
        )
    if into and params.get("in_place"):
        raise WrongUsage("--in-place cannot be combined with --into, because it makes new revisions of the clips")
    with connect(context) as marey:
        commands = _commands(marey, addresses[0].project, do, file, saved)
        clips = [clips_at(marey, address) for address in addresses]
        submitted = marey.project(addresses[0].project).edit(clips, commands, into=into.strip("/"), **job, **params)
        ended = follow(marey, submitted, wait=wait, as_json=as_json)
    if ended is None:
        return
    if not as_json:
        for finding in (ended.result or {}).get("findings", ()):
            typer.echo(_finding(finding))
    print_ended(ended, as_json)


@edit.command("save")
def save_edit(
    context: typer.Context,
    address: Annotated[str, typer.Argument(help="Name of the edit: project/folder/name.")],
    do: Do = None,
    file: From = None,
    title: Annotated[str, typer.Option(help="Purpose of the edit.")] = "",
    message: Annotated[
        str, typer.Option("--message", "-m", help="Message of the new revision, shown in the history.")
    ] = "",
    as_json: AsJson = False,
) -> None:
    """Save commands as an edit, or replace the commands of a saved edit."""
    place = Address.parse(address)
    if not place.path:
        raise WrongUsage(f"{address!r} is not the address of an edit; write project/folder/name")
    folder = place.path.rpartition("/")[0]
    with connect(context) as marey:
        commands = _given(marey, place.project, do, file)
        edits = marey.project(place.project).edits
        held = edits.save(place.name, commands, title=title, collection=folder, message=message)
    if as_json:
        return print_json(held.item)
    count = counted(len(commands.commands), "command")
    return typer.echo(f"{held.id} {held.path} revision {held.item.revision}: {count}")


@edit.command("show")
def show_edit(
    context: typer.Context,
    address: Annotated[str, typer.Argument(help="The edit: project/folder/name.")],
    as_json: AsJson = False,
) -> None:
    """Show the commands of an edit."""
    with connect(context) as marey:
        document = _edit_at(marey, address).document()
    if as_json:
        return print_json(document)
    if document.title:
        typer.echo(document.title)
    for number, command in enumerate(document.commands):
        given = command.model_dump(mode="json", exclude_defaults=True)
        typer.echo(f"{number:3}  {command_text(given)}")
    return None


@edit.command("preview")
def preview_edit(
    context: typer.Context,
    address: Annotated[str, typer.Argument(help="The clip: project/folder/name.")],
    do: Do = None,
    file: From = None,
    saved: With = None,
    frames: Annotated[
        str, typer.Option(help="Frames of the result to show, such as 100:200. Default: all.", show_default=False)
    ] = ":",
    piece: Annotated[
        int, typer.Option(min=1, help="Number of the result to show if the commands split the clip, counted from 1.")
    ] = 1,
    as_json: AsJson = False,
) -> None:
    """Show the result of commands on a clip without storing it. With --json, the output includes the new motion."""
    from marey_schemas.kinds import Kind

    place = Address.parse(address)
    with connect(context) as marey:
        clip = require_item(marey, place, [Kind.CLIP])
        commands = _commands(marey, place.project, do, file, saved)
        fields = ("motion", "positions", "findings") if as_json else ("positions", "findings")
        shown = clip.preview(commands, frames=_range(frames), piece=piece - 1, fields=fields)
    return print_json(shown) if as_json else _print_preview(shown, piece)


@edit.command("commands")
def list_commands(
    name: Annotated[str | None, typer.Argument(help="Name of a command; default: all commands.")] = None,
    as_json: AsJson = False,
) -> None:
    """Show the commands of edits, or the parameters of one command."""
    from marey_schemas.editing.edits import COMMAND_MODELS

    if name is not None and name not in COMMAND_MODELS:
        raise WrongUsage(f"there is no command {name!r}; {suggestion(name, COMMAND_MODELS, 'commands')}")
    wanted = {one: model for one, model in COMMAND_MODELS.items() if name in (None, one)}
    if as_json:
        return print_json({one: model.model_json_schema() for one, model in wanted.items()})
    if name is None:
        return print_table(
            ("command", "parameters", "what it does"),
            [
                (one, " ".join(row[0] for row in parameter_rows(model)), _summary(model))
                for one, model in wanted.items()
            ],
        )
    typer.echo(_summary(wanted[name]))
    columns = ("parameter", "type", "default", "meaning")
    print_table(columns, parameter_rows(wanted[name]))
    for heading, rows in object_types(wanted[name]):
        typer.echo(heading)
        print_table(columns, rows)
    typer.echo("Examples:")
    for example in wanted[name].examples:
        typer.echo(f"  --do {shlex.quote(command_text({'command': name, **example}))}")
    return None


# -- what is asked for --


def _commands(
    marey: Marey, project: str, do: list[str] | None, file: str | None, saved: str | None
) -> EditHandle | EditDocument:
    """Return the saved edit, or the commands given as arguments or in a file."""
    if saved is None:
        return _given(marey, project, do, file)
    if do or file:
        raise WrongUsage("give either a saved edit with --with, or commands with --do or --file, not both")
    if Address.parse(saved).project != project:
        raise WrongUsage("the edit and the clips must be in one project")
    return _edit_at(marey, saved)


def _given(marey: Marey, project: str, do: list[str] | None, file: str | None) -> EditDocument:
    from marey_client.handles.edits import as_edit

    if do and file is not None:
        raise WrongUsage("give commands either with --do or with --file, not both")
    if not do and file is None:
        raise WrongUsage("no commands are given; give commands with --do or --file")
    tree: Any = [parse_command(text) for text in do or ()] if file is None else read_json(file)
    given = tree if isinstance(tree, dict) else {"commands": tree}
    commands, title = given.get("commands"), given.get("title", "")
    if not isinstance(commands, list):
        raise WrongUsage(f"{file} contains no commands; it must be a list, or an object with `commands`")
    return as_edit([_with_ids(marey, project, one) for one in commands], title=title)


def _with_ids(marey: Marey, project: str, command: Any) -> Any:
    """Return a command in which the address of a source clip, if there is one, is replaced by the clip's id."""
    from marey_schemas.kinds import Kind

    source = command.get("source") if isinstance(command, dict) else None
    if not isinstance(source, str) or "/" not in source:
        return command
    place = Address.parse(source)
    if place.project != project:
        raise WrongUsage(
            f"{command.get('command', 'a command')}: the source clip {place} must be in the "
            f"project {project}, like the clips to edit"
        )
    return {**command, "source": require_item(marey, place, [Kind.CLIP]).id}


def _edit_at(marey: Marey, address: str) -> EditHandle:
    from marey_schemas.kinds import Kind

    found: EditHandle = require_item(marey, Address.parse(address), [Kind.EDIT])
    return found


def _range(text: str) -> slice:
    start, colon, stop = text.partition(":")
    if not colon or not all(not bound or is_frame(bound) for bound in (start, stop)):
        raise WrongUsage(f"--frames {text!r}: write a range such as 100:200, 100: or :200")
    return slice(int(start or 0), int(stop) if stop else None)


# -- output --


def _summary(model: Any) -> str:
    return str(model.__doc__).strip().partition("\n")[0]


def _print_preview(shown: EditPreview, piece: int) -> None:
    assert shown.positions is not None
    heights = shown.positions[:, :, 1]
    first, last = (" ".join(f"{value:.3f}" for value in pose[0]) for pose in shown.positions[[0, -1]])
    print_pairs(
        [
            ("piece", f"{piece} of {shown.pieces}" if shown.pieces > 1 else ""),
            ("frames", f"{shown.frames[0]}:{shown.frames[1]} of {shown.frame_count}"),
            ("rate", f"{shown.frame_rate_hz:g} Hz, {shown.frame_count / shown.frame_rate_hz:.2f} s"),
            ("root", f"from {first} to {last} m"),
            ("heights", f"{heights.min():.3f} to {heights.max():.3f} m"),
        ]
    )
    for finding in shown.findings:
        typer.echo(_finding(finding))


def _finding(finding: dict[str, Any]) -> str:
    """Return the measurements that a command reported about a clip, in one line; segments are ranges of frames."""
    figures = []
    for name, value in finding.items():
        if name == "segments":
            figures += [f"{one['label']} {one['start']}:{one['end']}" for one in value]
        elif name not in ("name", "item", "command", "frame_count", "frame_rate_hz"):
            figures.append(f"{name} {value:.4g}" if isinstance(value, float) else f"{name} {value}")
    place = f"{finding['name']}: " if "name" in finding else ""
    return f"{place}{finding['command']}: {', '.join(figures) or 'nothing'}"
