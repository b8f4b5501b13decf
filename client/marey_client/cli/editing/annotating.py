"""Commands `annotation`: show, edit, propose, import and export segments and keyframes of clips."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from marey_client.cli.addresses import Address, addresses_in_one_project, require_item
from marey_client.cli.clip_jobs import print_labelled
from marey_client.cli.terminal.failures import WrongUsage
from marey_client.cli.terminal.following import JOB, Sources, Wait, clips_at, follow, print_ended
from marey_client.cli.terminal.invocation import AsJson, connect, output_option
from marey_client.cli.terminal.output import print_json, print_pairs, print_table
from marey_client.cli.terminal.schema_options import Chosen, OptionsOf, add_command
from marey_client.cli.terminal.typed_values import assignment, is_frame, json_or_text
from marey_schemas.formats import DEFAULT_END_INDEX, DEFAULT_FORM, AnnotationForm, EndIndex
from marey_schemas.wording import counted

if TYPE_CHECKING:
    from marey_client.handles.annotations import AnnotationHandle
    from marey_client.marey import Marey


ANNOTATE = OptionsOf("marey_schemas.queue.job_params:AnnotateParams")
MERGE = OptionsOf(
    "marey_schemas.editing.annotation_commands:MergeSegment", only=("neighbour",), short={"neighbour": "--with"}
)
DEFAULT_PROPOSAL = {"method": "steps"}

annotation = typer.Typer(no_args_is_help=True, rich_markup_mode=None, help="Edit segments and keyframes of clips.")

Place = Annotated[str, typer.Argument(help="An annotation: project/folder/name, or project/id.")]
At = Annotated[int, typer.Argument(min=0, help="A frame number inside the segment to change.")]
Label = Annotated[str, typer.Argument(help="Label of the segment or keyframe.")]


def add_to(app: typer.Typer) -> None:
    """Add the commands of this module to the application `app`."""
    app.add_typer(annotation, name="annotation")
    add_command(annotation, merge, params=MERGE)
    add_command(annotation, propose, params=ANNOTATE, job=JOB)


@annotation.command()
def show(context: typer.Context, place: Place, as_json: AsJson = False) -> None:
    """Show the segments and keyframes of an annotation."""
    with connect(context) as marey:
        found = annotation_at(marey, place)
        document = found.document()
        clip = marey.project(found.project).clips.get(found.item.summary["clip"])
    if as_json:
        return print_json(document)
    print_pairs(
        [
            ("clip", f"{clip.path}, revision {found.item.summary['clip_revision']}"),
            ("layer", document.layer),
            ("made by", document.made_by),
        ]
    )
    rate_hz = clip.item.summary["frame_rate_hz"]
    rows: list[tuple[object, ...]] = [
        (one.label, one.start, one.end, f"{(one.end - one.start) / rate_hz:.3f}") for one in document.segments
    ]
    rows += [(one.label, one.frame, "", "") for one in document.keyframes]
    return print_table(("label", "frame", "end", "s"), rows, right=("frame", "end", "s"))


@annotation.command()
def create(
    context: typer.Context,
    clip: Annotated[str, typer.Argument(help="The clip: project/folder/name, or project/id.")],
    layer: Annotated[str, typer.Option(help="Name of the annotation layer, such as steps.")] = "default",
    name: Annotated[
        str | None,
        typer.Option(help="Name of the annotation; default: name of the clip, space, name of the layer."),
    ] = None,
    segment: Annotated[
        list[str] | None, typer.Option(help="Segment as label=first:end, without the frame `end`; may be repeated.")
    ] = None,
    keyframe: Annotated[list[str] | None, typer.Option(help="Keyframe as label=frame; may be repeated.")] = None,
    as_json: AsJson = False,
) -> None:
    """Create an annotation of a clip, with the given segments and keyframes, if any."""
    from marey_schemas.kinds import Kind

    segments = sorted((_segment(text) for text in segment or ()), key=lambda one: one[1:])
    keyframes = sorted((_keyframe(text) for text in keyframe or ()), key=lambda one: (one[1], one[0]))
    with connect(context) as marey:
        found = require_item(marey, Address.parse(clip), [Kind.CLIP])
        made = found.annotate(
            layer,
            name=name,
            segments=[dict(zip(("label", "start", "end"), one, strict=True)) for one in segments],
            keyframes=[dict(zip(("label", "frame"), one, strict=True)) for one in keyframes],
        )
    return print_json(made.item) if as_json else typer.echo(f"{made.project}/{made.path}")


@annotation.command()
def add(
    context: typer.Context,
    place: Place,
    label: Label,
    frames: Annotated[str, typer.Argument(help="Frames as first:end; the frame `end` is not included.")],
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Shorten or remove existing segments that overlap the new one.")
    ] = False,
) -> None:
    """Add a segment: a range of frames with a label."""
    _, start, end = _segment(f"{label}={frames}")
    _apply(context, place, command="create_segment", label=label, start=start, end=end, overwrite=overwrite)


@annotation.command()
def split(
    context: typer.Context,
    place: Place,
    at: Annotated[int, typer.Argument(min=0, help="First frame of the second part.")],
    label: Annotated[
        str | None, typer.Option(help="Label of the second part; default: the label of the first part.")
    ] = None,
) -> None:
    """Split a segment into two adjacent segments."""
    _apply(context, place, command="split_segment", at=at, label=label)


def merge(context: typer.Context, place: Place, at: At, params: Chosen) -> None:
    """Merge a segment with a neighbouring segment; a gap between the two is filled."""
    _apply(context, place, command="merge_segment", at=at, **params)


@annotation.command()
def move(
    context: typer.Context,
    place: Place,
    at: At,
    start: Annotated[
        int | None, typer.Option(min=0, help="New first frame of the segment. Give either --start or --end.")
    ] = None,
    end: Annotated[
        int | None,
        typer.Option(
            min=0, help="New end of the segment: the frame after its last frame. Give either --start or --end."
        ),
    ] = None,
) -> None:
    """Move the start or the end of a segment. An adjacent segment is extended or shortened accordingly."""
    edges = [(edge, to) for edge, to in (("start", start), ("end", end)) if to is not None]
    if len(edges) != 1:
        raise WrongUsage("give exactly one of --start and --end")
    _apply(context, place, command="move_boundary", at=at, edge=edges[0][0], to=edges[0][1])


@annotation.command()
def relabel(
    context: typer.Context,
    place: Place,
    at: At,
    label: Annotated[str, typer.Argument(help="New label of the segment.")],
) -> None:
    """Give a segment another label."""
    _apply(context, place, command="relabel_segment", at=at, label=label)


@annotation.command()
def remove(context: typer.Context, place: Place, at: At) -> None:
    """Remove a segment; its frames then have no label."""
    _apply(context, place, command="remove_segment", at=at)


@annotation.command("keyframe")
def mark(
    context: typer.Context,
    place: Place,
    label: Label,
    frame: Annotated[int, typer.Argument(min=0, help="Frame number of the keyframe.")],
    move_to: Annotated[
        int | None, typer.Option("--move", min=0, help="Move the keyframe at FRAME to this frame.")
    ] = None,
    remove_it: Annotated[bool, typer.Option("--remove", help="Remove the keyframe.")] = False,
) -> None:
    """Add a keyframe; with --move or --remove, move it or remove it."""
    if move_to is not None and remove_it:
        raise WrongUsage("give only one of --move and --remove")
    if move_to is not None:
        _apply(context, place, command="move_keyframe", label=label, frame=frame, to=move_to)
    else:
        _apply(context, place, command="remove_keyframe" if remove_it else "add_keyframe", label=label, frame=frame)


@annotation.command()
def clear(context: typer.Context, place: Place) -> None:
    """Remove all segments and keyframes."""
    _apply(context, place, command="clear")


def propose(
    context: typer.Context,
    sources: Sources,
    params: Chosen,
    job: Chosen,
    option: Annotated[
        list[str] | None,
        typer.Option("--set", help="Option of the method as name=value, such as most_turn_deg=30; may be repeated."),
    ] = None,
    into: Annotated[
        str,
        typer.Option(
            help="Folder that receives the annotations, in subfolders named like the folders of the clips. By "
            "default, each annotation is stored in the folder of its clip."
        ),
    ] = "",
    wait: Wait = True,
    as_json: AsJson = False,
) -> None:
    """Annotate clips with an algorithm that finds steps (the default), pauses, or contacts of a hand."""
    addresses = addresses_in_one_project(sources)
    proposal = {**DEFAULT_PROPOSAL, **params.pop("proposal", {}), **dict(map(_option, option or ()))}
    with connect(context) as marey:
        clips = [clips_at(marey, address) for address in addresses]
        project = marey.project(addresses[0].project)
        submitted = project.annotate(clips, proposal=proposal, into=into.strip("/"), **job, **params)
        ended = follow(marey, submitted, wait=wait, as_json=as_json)
    if ended is not None:
        print_ended(ended, as_json, print_labelled)


@annotation.command("import")
def import_annotation(
    context: typer.Context,
    clip: Annotated[str, typer.Argument(help="The clip: project/folder/name, or project/id.")],
    file: Annotated[
        Path,
        typer.Argument(
            exists=True,
            dir_okay=False,
            help="File in the format of Marey's predecessor, the older programs that Marey replaces: JSON, BSON "
            "or compressed BSON.",
        ),
    ],
    layer: Annotated[str, typer.Option(help="Name of the annotation layer, such as steps.")] = "imported",
    name: Annotated[
        str | None,
        typer.Option(help="Name of the annotation; default: name of the clip, space, name of the layer."),
    ] = None,
    end_index: Annotated[
        EndIndex,
        typer.Option(
            help="Meaning of end_idx in the file. inclusive: the last frame of a segment, as in the editor of Marey's "
            "predecessor. exclusive: the frame after the last frame."
        ),
    ] = DEFAULT_END_INDEX,
    label: Annotated[
        list[str] | None, typer.Option(help="Import only this label; may be repeated. Default: all labels.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Import an annotation of a clip from a file of Marey's predecessor.

    `marey annotation export` writes this file again, byte for byte, unless the annotation was changed.
    """
    from marey_schemas.kinds import Kind

    options = {"layer": layer, "name": name, "end_index": end_index, "labels": tuple(label) if label else None}
    with connect(context) as marey:
        found = require_item(marey, Address.parse(clip), [Kind.CLIP])
        made = found.import_annotation(file, **{key: value for key, value in options.items() if value is not None})
    return print_json(made.item) if as_json else typer.echo(f"{made.project}/{made.path}")


@annotation.command("export")
def export_annotation(
    context: typer.Context,
    place: Place,
    output: Annotated[Path, output_option("Folder to write to.")] = Path(),
    form: Annotated[
        AnnotationForm | None,
        typer.Option(
            help="Layout of the file. labels: the segments of each label. list: one list of all segments, "
            "without labels. frames: the frames of each label. Default: the layout of the imported file if the "
            f"annotation is unchanged and --end-index is not given; otherwise {DEFAULT_FORM}."
        ),
    ] = None,
    end_index: Annotated[
        EndIndex | None,
        typer.Option(
            help="Meaning of end_idx in the file. inclusive: the last frame of a segment, as in the editor of "
            "Marey's predecessor. exclusive: the frame after the last frame. Default: the meaning in the imported "
            f"file if the annotation is unchanged and --form is not given; otherwise {DEFAULT_END_INDEX}."
        ),
    ] = None,
) -> None:
    """Write an annotation to a file for Marey's predecessor, the older programs that Marey replaces.

    Without `--form` and `--end-index`, an annotation that was imported from a file and not changed since is written as
    this file.
    """
    with connect(context) as marey:
        found = annotation_at(marey, place)
        typer.echo(found.export(output, format="predecessor", form=form, end_index=end_index))


def annotation_at(marey: Marey, place: str) -> AnnotationHandle:
    """Return the annotation at an address. Raises `WrongUsage` if there is none."""
    from marey_schemas.kinds import Kind

    found: AnnotationHandle = require_item(marey, Address.parse(place), [Kind.ANNOTATION])
    return found


def _apply(context: typer.Context, place: str, **command: Any) -> None:
    with connect(context) as marey:
        found = annotation_at(marey, place)
        item = found.apply([{name: value for name, value in command.items() if value is not None}])
    summary = item.summary
    held = f"{counted(summary['segments'], 'segment')}, {counted(summary['keyframes'], 'keyframe')}"
    typer.echo(f"{place}: revision {item.revision}, {held}")


def _segment(text: str) -> tuple[str, int, int]:
    label, _, frames = text.rpartition("=")
    first, colon, end = frames.partition(":")
    if not (label and colon and is_frame(first) and is_frame(end)):
        raise WrongUsage(f"{text!r}: write label=first:end, as in step_left=120:180")
    return label, int(first), int(end)


def _keyframe(text: str) -> tuple[str, int]:
    label, _, frame = text.rpartition("=")
    if not (label and is_frame(frame)):
        raise WrongUsage(f"{text!r}: write label=frame, as in contact=120")
    return label, int(frame)


def _option(text: str) -> tuple[str, Any]:
    """Split the option `name=value` of an annotation method into name and value; a value with commas becomes a list."""
    name, value = assignment(text)
    read = json_or_text(value)
    return name, value.split(",") if read == value and ("," in value or name == "joints") else read
