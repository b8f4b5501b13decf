"""`edit`: commands on clips, saved, applied and previewed."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Annotated, Any

import typer

from marey_client.cli.addresses import Address, require_item
from marey_client.cli.command_texts import is_frame, parameter_rows, parse_command
from marey_client.cli.failures import WrongUsage
from marey_client.cli.invocation import AsJson, connect
from marey_client.cli.jobs import clips_at, follow, print_ended
from marey_client.cli.json_files import read_json
from marey_client.cli.output import print_json, print_pairs, print_table
from marey_schemas.wording import counted

if TYPE_CHECKING:
    from marey_client.handles.edits import EditHandle
    from marey_client.marey import Marey
    from marey_schemas.editing.edits import EditDocument
    from marey_schemas.editing.previews import EditPreview

edit = typer.Typer(no_args_is_help=True, rich_markup_mode=None, help="Edits: commands on clips.")

Do = Annotated[
    list[str] | None,
    typer.Option("--do", help="A command, as in 'trim start=10 stop=200'; may be repeated. See marey edit commands."),
]
From = Annotated[
    str | None, typer.Option("--file", help="Commands from a file of JSON: a list, or an edit; - for standard input.")
]
With = Annotated[str | None, typer.Option("--with", help="The commands of a saved edit: project/folder/name.")]


def add_to(app: typer.Typer) -> None:
    """Register the commands of this module."""
    app.add_typer(edit, name="edit")


@edit.command("apply")
def apply_edit(
    context: typer.Context,
    sources: Annotated[list[str], typer.Argument(help="Clips or folders of clips: project/folder[/name].")],
    do: Do = None,
    file: From = None,
    saved: With = None,
    into: Annotated[str, typer.Option(help="The folder in the project that the results go to.")] = "",
    suffix: Annotated[str, typer.Option(help="Appended to the names of the results.")] = "",
    in_place: Annotated[bool, typer.Option("--in-place", help="Make the results new revisions of the clips.")] = False,
    tag: Annotated[list[str] | None, typer.Option(help="Tag of the results; may be repeated.")] = None,
    priority: Annotated[int, typer.Option(min=-100, max=100, help="Higher goes first.")] = 0,
    wait: Annotated[bool, typer.Option("--wait/--no-wait", help="Wait until it has ended.")] = True,
    as_json: AsJson = False,
) -> None:
    """Apply commands to clips, as a job."""
    addresses = [Address.parse(source) for source in sources]
    if len({address.project for address in addresses}) > 1:
        raise WrongUsage("the clips must be in one project")
    if not (into or suffix or in_place):
        raise WrongUsage("say where the results go: --into a folder, with a --suffix beside the clips, or --in-place")
    with connect(context) as marey:
        commands = _commands(marey, addresses[0].project, do, file, saved)
        clips = [clips_at(marey, address) for address in addresses]
        options = {"suffix": suffix, "in_place": in_place, "tags": tuple(tag or ())}
        given = {name: value for name, value in options.items() if value}
        project = marey.project(addresses[0].project)
        submitted = project.edit(clips, commands, into=into.strip("/"), priority=priority, **given)
        if not wait:
            return print_json(submitted) if as_json else typer.echo(submitted.id)
        ended = follow(marey, submitted)
    if not as_json:
        for finding in (ended.result or {}).get("findings", ()):
            typer.echo(_finding(finding))
    return print_ended(ended, as_json)


@edit.command("save")
def save_edit(
    context: typer.Context,
    address: Annotated[str, typer.Argument(help="What the edit is called: project/folder/name.")],
    do: Do = None,
    file: From = None,
    title: Annotated[str, typer.Option(help="What the edit is for.")] = "",
    message: Annotated[str, typer.Option("--message", "-m", help="Shown in the history.")] = "",
    as_json: AsJson = False,
) -> None:
    """Keep commands as an edit, or change one."""
    place = Address.parse(address)
    if not place.path:
        raise WrongUsage(f"{address!r} names no edit; write project/folder/name")
    folder = place.path.rpartition("/")[0]
    with connect(context) as marey:
        commands = _given(marey, place.project, do, file)
        edits = marey.project(place.project).edits
        held = edits.save(place.name, commands, title=title, collection=folder, message=message)
    if as_json:
        return print_json(held.item)
    told = counted(len(commands.commands), "command")
    return typer.echo(f"{held.id} {held.path} revision {held.item.revision}: {told}")


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
        told = " ".join(f"{name}={json.dumps(value)}" for name, value in given.items() if name != "command")
        typer.echo(f"{number:3}  {command.command} {told}".rstrip())
    return None


@edit.command("preview")
def preview_edit(
    context: typer.Context,
    address: Annotated[str, typer.Argument(help="The clip: project/folder/name.")],
    do: Do = None,
    file: From = None,
    saved: With = None,
    frames: Annotated[str, typer.Option(help="Which frames of the result, as in 100:200.")] = ":",
    piece: Annotated[int, typer.Option(min=1, help="Which of the results, where the clip is split.")] = 1,
    as_json: AsJson = False,
) -> None:
    """Tell what commands would make of a clip; nothing is stored. With --json, its motion too."""
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
    name: Annotated[str | None, typer.Argument(help="Left out: every command.")] = None,
    as_json: AsJson = False,
) -> None:
    """Show what an edit can do, or the parameters of one command."""
    from marey_schemas.editing.edits import COMMAND_MODELS

    if name is not None and name not in COMMAND_MODELS:
        raise WrongUsage(f"there is no command {name!r}; there are {', '.join(COMMAND_MODELS)}")
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
    return print_table(("parameter", "type", "default", "meaning"), parameter_rows(wanted[name]))


# -- what is asked for --


def _commands(
    marey: Marey, project: str, do: list[str] | None, file: str | None, saved: str | None
) -> EditHandle | EditDocument:
    """The saved edit, or the commands that were typed or are in a file."""
    if saved is None:
        return _given(marey, project, do, file)
    if do or file:
        raise WrongUsage("give --with an edit, or commands by --do or --file, and not both")
    if Address.parse(saved).project != project:
        raise WrongUsage("the edit and the clips must be in one project")
    return _edit_at(marey, saved)


def _given(marey: Marey, project: str, do: list[str] | None, file: str | None) -> EditDocument:
    from marey_client.handles.edits import as_edit

    if (file is None) == (not do):
        raise WrongUsage("give commands by --do, or by --file, and not both")
    tree: Any = [parse_command(text) for text in do or ()] if file is None else read_json(file)
    given = tree if isinstance(tree, dict) else {"commands": tree}
    commands, title = given.get("commands"), given.get("title", "")
    if not isinstance(commands, list):
        raise WrongUsage(f"{file} holds no commands; a list is needed, or an object with `commands`")
    return as_edit([_with_ids(marey, project, one) for one in commands], title=title)


def _with_ids(marey: Marey, project: str, command: Any) -> Any:
    """The command with the id of its source, where that is named by its address."""
    from marey_schemas.kinds import Kind

    source = command.get("source") if isinstance(command, dict) else None
    if not isinstance(source, str) or "/" not in source:
        return command
    place = Address.parse(source)
    if place.project != project:
        raise WrongUsage(f"{command.get('command', 'a command')}: the source {place} must be in the project {project}")
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


# -- what is told --


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
    """What a command found out, in one line; segments as ranges of frames."""
    told = []
    for name, value in finding.items():
        if name == "segments":
            told += [f"{one['label']} {one['start']}:{one['end']}" for one in value]
        elif name not in ("name", "item", "command", "frame_count", "frame_rate_hz"):
            told.append(f"{name} {value:.4g}" if isinstance(value, float) else f"{name} {value}")
    place = f"{finding['name']}: " if "name" in finding else ""
    return f"{place}{finding['command']}: {', '.join(told) or 'nothing'}"
