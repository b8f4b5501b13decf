"""Commands `upload`, `ls`, `show` and `download`."""

from __future__ import annotations

from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from marey_client.cli.addresses import Address, find_item, kind_named, require_item
from marey_client.cli.failures import Refused, WrongUsage
from marey_client.cli.invocation import AsJson, connect
from marey_client.cli.output import print_json, print_message, print_pairs, print_table, progress
from marey_client.cli.schema_options import Chosen, OptionsOf, add_command
from marey_schemas.formats import EXPORT_FORMATS
from marey_schemas.wording import counted, one_of

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from marey_client.items import ItemHandle
    from marey_client.marey import Marey
    from marey_schemas.imports import ImportEntry
    from marey_schemas.kinds import Kind

UPLOAD = OptionsOf("marey_schemas.options.imports:ImportOptions", short={"frame_rate_hz": "--fps"})
DOWNLOADS_AT_ONCE = 4
NEW_REVISION = "new revision"
OUTCOMES = ("created", NEW_REVISION, "unchanged", "companion", "failed")  # in the order of the summary

WARNINGS_SHOWN = 2  # of each code: a folder of thousands shows what it has, not everything it has


def add_to(app: typer.Typer) -> None:
    """Register the commands of this module."""
    add_command(app, upload, options=UPLOAD)
    for command in (ls, show, download):
        app.command()(command)


def upload(
    context: typer.Context,
    places: Annotated[list[Path], typer.Argument(help="Motion files, or folders of them.")],
    project: Annotated[str, typer.Option(help="The project that receives the files.")],
    options: Chosen,
    left_handed: Annotated[
        bool, typer.Option("--left-handed", help="The same as --handedness left: the files have left-handed axes.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Import motion files. Refused files are listed with a reason.

    Importing the same file again changes nothing; a changed file of the same name becomes a new revision of its clip.
    """
    from marey_client.imports import find_files, left_out_text
    from marey_schemas.options.imports import ImportOptions

    if left_handed:
        options["handedness"] = "left"
    found = find_files(places)
    if found.left_out:
        print_message(left_out_text(found.left_out))
    with connect(context) as marey:
        to = marey.project(project)
        to.read()  # a missing project is an error before any bytes are sent
        try:
            with progress() as advance:
                entries = to.imports.upload(found.files, ImportOptions.model_validate(options), notice=advance)
        except KeyboardInterrupt:
            print_message(
                "interrupted; imported files stay imported, and repeating the command sends only the missing ones"
            )
            raise
    if as_json:
        print_json(entries)
    else:
        _print_entries(entries)
    if any(entry.status == "failed" for entry in entries):
        raise Refused


def _print_entries(entries: Sequence[ImportEntry]) -> None:
    from marey_client.imports import refusal_text

    found: dict[str, list[str]] = {}
    for entry in entries:
        if entry.error is not None:
            print_message(refusal_text(entry))
        for warning in entry.warnings:
            found.setdefault(warning.code, []).append(f"{entry.name}: {warning.message}")
    for code, texts in found.items():
        others = len(texts) - WARNINGS_SHOWN
        more = [f"and {counted(others, 'more file')}; --json shows all"] if others > 0 else []
        for text in [*texts[:WARNINGS_SHOWN], *more]:
            print_message(f"warning {code}: {text}")
    counts = Counter(_outcome(entry) for entry in entries)
    frames = sum(entry.frames or 0 for entry in entries)
    outcomes = ", ".join(f"{counts[outcome]} {outcome}" for outcome in OUTCOMES if counts[outcome])
    typer.echo(f"{counted(len(entries), 'file')}: {outcomes}; {counted(frames, 'frame')}")


def _outcome(entry: ImportEntry) -> str:
    """Return the word for the result of an import: `new revision` if an item of this name existed before."""
    return NEW_REVISION if entry.status == "created" and (entry.revision or 1) > 1 else entry.status


def ls(
    context: typer.Context,
    place: Annotated[
        str | None, typer.Argument(help="Project or folder to list: project[/folder]; default: all projects.")
    ] = None,
    recursive: Annotated[
        bool, typer.Option("--recursive", "-r", help="Also list the contents of all subfolders.")
    ] = False,
    kind: Annotated[list[str] | None, typer.Option(help="List only items of this kind; may be repeated.")] = None,
    tag: Annotated[
        str | None, typer.Option(help="List only items with one of these tags, separated by commas.")
    ] = None,
    deleted: Annotated[bool, typer.Option("--deleted", help="List removed items, in the folder and below.")] = False,
    as_json: AsJson = False,
) -> None:
    """List the contents of a folder."""
    if place is None:
        from marey_client.cli.projects import list_projects

        return list_projects(context, as_json)
    address = Address.parse(place)
    if deleted:
        return _show_deleted(context, address, kind, tag, as_json)
    with connect(context) as marey:
        folders = [] if recursive else _folders_in(marey, address)
        items = _items_in(marey, address, recursive=recursive, kinds=kind, tag=tag)
        if not folders and not items and marey.project(address.project).collections.at(address.path) is None:
            items = _items_called(marey, address)
    if as_json:
        return print_json({"collections": folders, "items": [one.item for one in items]})
    rows: list[tuple[object, ...]] = [(f"{name}/", "collection", *[""] * 5) for name in folders]
    for one in items:
        summary = one.item.summary
        rows.append(
            (
                one.path if recursive else one.name,
                one.item.kind,
                one.item.revision,
                summary.get("joints"),
                summary.get("frames"),
                summary.get("frame_rate_hz"),
                " ".join(one.item.tags),
            )
        )
    figures = ("revision", "joints", "frames", "Hz")
    return print_table(("name", "kind", *figures, "tags"), rows, right=figures)


def _show_deleted(
    context: typer.Context, address: Address, kinds: Sequence[str] | None, tag: str | None, as_json: bool
) -> None:
    with connect(context) as marey:
        folders = list(marey.project(address.project).collections.list(path=address.path, deleted=True))
        items = _items_in(marey, address, recursive=True, kinds=kinds, tag=tag, deleted=True)
    if as_json:
        return print_json({"collections": folders, "items": [one.item for one in items]})
    rows = [(f"{one.path}/", "collection", one.deleted_at, one.id) for one in folders]
    rows += [(one.path, one.item.kind, one.item.deleted_at, one.id) for one in items]
    print_table(("name", "kind", "deleted", "id"), rows)
    return print_message(
        f"marey restore {address.project}/NAME restores an item; if several items have this name, give an id"
    )


def _items_called(marey: Marey, address: Address) -> list[ItemHandle]:
    """Return the items at an address that is not a folder. Raises `WrongUsage` if there are none."""
    from marey_schemas.kinds import Kind

    item = find_item(marey, address, list(Kind))
    if item is None and address.path:
        raise WrongUsage(f"there is no item or folder at {address}; `marey ls {address.project}` lists the project")
    return [] if item is None else [item]


def _folders_in(marey: Marey, address: Address) -> list[str]:
    """Return the names of the folders directly in the folder at an address."""
    below = marey.project(address.project).collections.list(path=address.path)
    names = (one.path.removeprefix(address.path).strip("/").partition("/")[0] for one in below)
    return sorted({name for name in names if name})


def _items_in(
    marey: Marey,
    address: Address,
    *,
    recursive: bool,
    kinds: Sequence[str] | None,
    tag: str | None,
    deleted: bool = False,
) -> list[ItemHandle]:
    from marey_schemas.kinds import Kind

    wanted = [kind_named(name) for name in kinds] if kinds else list(Kind)
    project = marey.project(address.project)

    def of_kind(kind: Kind) -> list[ItemHandle]:
        folder = "collection" if recursive else "directly_in"
        filters = {folder: address.path, "tag.in": tag}
        found: list[ItemHandle] = list(project.items(kind).list(filters=filters, deleted=deleted))
        return sorted(found, key=lambda item: item.path)

    with ThreadPoolExecutor(4) as pool:
        return [item for items in pool.map(of_kind, wanted) for item in items]


def show(
    context: typer.Context,
    place: Annotated[str, typer.Argument(help="The item: project/folder/name, or project/id.")],
    part: Annotated[str | None, typer.Option(help="Print only the document of this part, as JSON.")] = None,
    history: Annotated[bool, typer.Option("--history", help="Show every revision and its inputs.")] = False,
    as_json: AsJson = False,
) -> None:
    """Show an item: its parts, its place, and the findings of its import."""
    from marey_schemas.kinds import Kind

    with connect(context) as marey:
        item = require_item(marey, Address.parse(place), list(Kind))
        if part is not None:
            from marey_schemas.encoding.codecs import encode_tree

            return typer.echo(encode_tree(item.part(part), "application/json"))
        if history:
            return _show_history(item, as_json)
        if as_json:
            return print_json(item.item)
        return print_pairs(_described(marey, item))


def _described(marey: Marey, item: ItemHandle) -> Iterator[tuple[str, object]]:
    """Yield names and values that describe an item; for a clip also its skeleton, source and warnings."""
    from marey_client.handles.clips import ClipHandle

    yield from item.item.model_dump(mode="json", exclude={"parts", "summary", "rev", "tags"}).items()
    yield "tags", " ".join(item.item.tags)
    for name, value in item.item.summary.items():
        if isinstance(item, ClipHandle) and name == "skeleton":
            yield name, f"{marey.project(item.project).skeletons.get(value).path} ({value})"
        elif name != "warnings":
            yield name, value
    for edge in item.staleness().because:
        yield "stale", f"{edge.kind} {edge.name} has newer revisions than {edge.revision}"
    for name, one in item.item.parts.items():
        yield f"part {name}", f"{one.size_bytes} bytes, {one.schema_}, {one.document}"
    if isinstance(item, ClipHandle) and "info" in item.item.parts:
        info = item.info()
        if info.source is not None:
            yield "source", info.source.file_name
            yield from (("evidence", found) for found in info.source.details.get("evidence", ()))
        for check in info.checks:
            frames = f", frames {check.frames[0]} to {check.frames[1] - 1}" if check.frames else ""
            joints = f", joints {' '.join(check.joints)}" if check.joints else ""
            yield f"warning {check.code}", f"{check.message}{frames}{joints}"


def _show_history(item: ItemHandle, as_json: bool) -> None:
    revisions, lineage, staleness = list(item.revisions()), item.lineage(), item.staleness()
    if as_json:
        return print_json({"revisions": revisions, "lineage": lineage, "staleness": staleness})
    rows = [(one.revision, one.created_at, one.author, one.job, one.message) for one in revisions]
    print_table(("revision", "made", "author", "job", "message"), rows)
    for edge in lineage.inputs:
        typer.echo(f"made from {edge.kind} {edge.name} ({edge.item} revision {edge.revision}) as {edge.role}")
    for edge in lineage.outputs:
        typer.echo(f"used for  {edge.kind} {edge.name} ({edge.item} revision {edge.revision}) as {edge.role}")
    for edge in staleness.because:
        typer.echo(f"stale: {edge.kind} {edge.name} has newer revisions than {edge.revision}")
    return None


def download(
    context: typer.Context,
    place: Annotated[str, typer.Argument(help="A clip, or a folder of clips: project/folder[/name].")],
    format: Annotated[str, typer.Option(help=f"{one_of(EXPORT_FORMATS)}.")] = "original",  # noqa: A002
    output: Annotated[Path, typer.Option("--output", "--out", "-o", help="Folder to write to.")] = Path(),
    unit: Annotated[str | None, typer.Option(help="Unit of length of BVH files: cm or m.")] = None,
    restored: Annotated[
        bool, typer.Option(help="Export aligned clips with the time and place of their source clips.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Write clips to files: one clip, or all clips in a folder and below, or its aligned clips if it has no others.

    An existing file is replaced; if several clips would have the same file name, the later ones get a number.
    """
    if format not in EXPORT_FORMATS:
        raise WrongUsage(f"{format!r} is not a format; the formats are {', '.join(EXPORT_FORMATS)}")
    address = Address.parse(place)
    with connect(context) as marey:
        clips, base = _clips_at(marey, address)
        options = {"format": format, "unit": unit}
        written, refused = _download_all(clips, base, output, options | {"time": "source"} if restored else options)
    if as_json:
        print_json({"files": [str(path) for path in written], "refused": refused})
    else:
        typer.echo(f"wrote {counted(len(written), 'file')} to {output}")
        for name, reason in refused.items():
            print_message(f"{name}: {reason}")
    if refused:
        raise Refused


def _clips_at(marey: Marey, address: Address) -> tuple[list[ItemHandle], str]:
    """Return the items at an address, and the folder that their file paths are relative to."""
    from marey_schemas.kinds import Kind

    project = marey.project(address.project)
    clip = find_item(marey, address, [Kind.CLIP, Kind.PROCESSED])
    below: list[ItemHandle] = []
    if clip is None:
        below += project.clips.list(collection=address.path)
    if clip is None and not below:
        below += project.processed.list(collection=address.path)
    others = [Kind.SKELETON, Kind.MODEL, Kind.GRAPH, Kind.ANNOTATION]
    single = clip or (None if below else find_item(marey, address, others))
    if single is not None:
        return [single], single.item.collection
    if not below:
        raise WrongUsage(f"there is no clip at {address}; `marey ls {address.project}` lists the project")
    return below, address.path


def _download_all(
    clips: Sequence[ItemHandle], base: str, output: Path, options: Mapping[str, Any]
) -> tuple[list[Path], dict[str, str]]:
    from marey_client.cli.failures import sentence
    from marey_client.downloads import TakenPaths, safe_file_name
    from marey_client.errors import RequestFailed

    written: list[Path] = []
    refused: dict[str, str] = {}
    paths = TakenPaths()

    def one(clip: ItemHandle) -> Path | str:
        below = clip.item.collection.removeprefix(base).strip("/")
        try:
            folder = output.joinpath(*(safe_file_name(name) for name in below.split("/") if name))
            return clip.export(folder, beside=paths, **options)
        except RequestFailed as error:
            if error.status >= 500 or error.status == 401:
                raise
            return sentence(error)

    with ThreadPoolExecutor(DOWNLOADS_AT_ONCE) as pool, progress() as advance:
        for clip, outcome in zip(clips, pool.map(one, clips), strict=True):
            if isinstance(outcome, Path):
                written.append(outcome)
            else:
                refused[clip.path] = outcome
            advance("downloading", len(written) + len(refused), len(clips))
    return written, refused
