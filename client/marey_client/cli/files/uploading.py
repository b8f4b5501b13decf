"""Command `upload`, which imports motion files."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from marey_client.cli.terminal.failures import Refused, WrongUsage
from marey_client.cli.terminal.invocation import AsJson, connect
from marey_client.cli.terminal.output import print_json, print_message
from marey_client.cli.terminal.schema_options import Chosen, OptionsOf, add_command
from marey_client.progress import progress
from marey_schemas.wording import counted

if TYPE_CHECKING:
    from collections.abc import Sequence

    from marey_client.marey import Marey
    from marey_client.project import ProjectHandle
    from marey_schemas.imports import ImportEntry


UPLOAD = OptionsOf(
    "marey_schemas.options.imports:ImportOptions", short={"frame_rate_hz": "--fps", "replace_skeleton": "--replace"}
)
WARNINGS_SHOWN = 2  # of each code: a folder of thousands shows what it has, not everything it has


def add_to(app: typer.Typer) -> None:
    """Add the command of this module to the application `app`."""
    add_command(app, upload, options=UPLOAD)


def upload(
    context: typer.Context,
    places: Annotated[list[Path], typer.Argument(help="Motion files, or folders with motion files.")],
    project: Annotated[str, typer.Option(help="The project that receives the files.")],
    options: Chosen,
    left_handed: Annotated[
        bool, typer.Option("--left-handed", help="The same as --handedness left: the files have left-handed axes.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Import motion files. Refused files are listed with a reason.

    Importing the same file again changes nothing; a changed file of the same name becomes a new revision of its clip.
    A changed file that also has another skeleton is refused, unless --replace is given.
    Clips from a folder that `marey dataset export` wrote get the paths, take records and tags that they had in the
    export.
    """
    from marey_client.imports import find_files, left_out_texts
    from marey_client.uploads import upload as upload_found
    from marey_schemas.options.imports import ImportOptions

    if left_handed:
        if options.get("handedness", "left") != "left":
            raise WrongUsage("--left-handed and --handedness right contradict each other; give only one of them")
        options["handedness"] = "left"
    found = find_files(places)
    for text in left_out_texts(found.left_out):
        print_message(text)
    with connect(context) as marey:
        to = marey.project(project)
        to.read()  # a missing project is an error before any bytes are sent
        _note_doubled_project(to, options.get("collection", ""))
        if "/" in options.get("skeleton", ""):
            options["skeleton"] = _skeleton_at(marey, project, options["skeleton"])
        try:
            with progress() as advance:
                report = upload_found(to, found, ImportOptions.model_validate(options), advance)
        except KeyboardInterrupt:
            print_message(
                "interrupted; imported files stay imported, and repeating the command sends only the missing ones"
            )
            raise
    if as_json:
        print_json(report.entries)
    else:
        _print_entries(report.entries)
        _print_restored(report.restored, found.changed_tables, f"{project}/{options.get('collection', '')}".rstrip("/"))
    if found.motions_left_out or report.failed:
        raise Refused


def _note_doubled_project(project: ProjectHandle, collection: str) -> None:
    """Print a note if a folder is written with its project, as an address, although the project has no such folder."""
    first, _, rest = collection.partition("/")
    if rest and first == project.name and project.collections.at(first) is None:
        print_message(
            f"note: the clips get the folder {project.name}/{collection}; for {collection}, give --collection {rest}"
        )


def _skeleton_at(marey: Marey, project: str, place: str) -> str:
    """Return the id of the skeleton at an address, which must be in the project that receives the files."""
    from marey_client.cli.addresses import Address, require_item
    from marey_schemas.kinds import Kind

    address = Address.parse(place)
    if address.project != project:
        raise WrongUsage(
            f"the skeleton {place} is not in the project {project}, which receives the files; name a skeleton of this "
            "project"
        )
    return str(require_item(marey, address, [Kind.SKELETON]).id)


def _print_restored(restored: int, changed_tables: Sequence[Path], place: str) -> None:
    if restored:
        typer.echo(f"{counted(restored, 'clip')} got the take record and the tags of the export")
    for table in changed_tables:
        print_message(
            f"{table} was changed after the export and is not used; to apply it, run marey record {place} --table "
            f"{table}"
        )


def _print_entries(entries: Sequence[ImportEntry]) -> None:
    from marey_client.imports import refusal_text
    from marey_client.uploads import outcomes_text

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
    typer.echo(outcomes_text(entries))
