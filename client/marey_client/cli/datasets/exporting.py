"""Command `dataset export`: a version as a folder that other programs read."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from marey_client.cli.datasets.places import VersionPlace, parse, short
from marey_client.cli.terminal.failures import WrongUsage
from marey_client.cli.terminal.invocation import AllowExpiredConsent, AsJson, connect
from marey_client.cli.terminal.output import print_json, print_message
from marey_client.progress import progress
from marey_schemas.datasets.layouts import LAYOUTS
from marey_schemas.formats import DEFAULT_FORMAT, WHOLE_FORMATS
from marey_schemas.kinds import Kind
from marey_schemas.wording import counted, one_of

if TYPE_CHECKING:
    from marey_client.bridges.files import ExportedVersion
    from marey_client.handles.versions import DatasetHandle
    from marey_client.progress import OnProgress

RENAMED_SHOWN = 5


def add_to(dataset: typer.Typer) -> None:
    """Add the command of this module to the group `marey dataset`."""
    dataset.command()(export)


def export(
    context: typer.Context,
    place: VersionPlace,
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="Folder to write; it must be new or empty.")],
    layout: Annotated[
        str,
        typer.Option(
            "--as",
            help=f"Layout of the folder. {one_of(LAYOUTS)}: a tree of motion files, a dataset repository of the "
            "Hugging Face Hub, or a LeRobotDataset v3.0.",
        ),
    ] = "files",
    path: Annotated[
        str, typer.Option(help="Folder of the version; only the clips below it are exported. Default: all clips.")
    ] = "",
    format: Annotated[  # noqa: A002
        str | None,
        typer.Option(help=f"Format of the motion files: {one_of(WHOLE_FORMATS)}. Default: {DEFAULT_FORMAT}."),
    ] = None,
    unit: Annotated[str | None, typer.Option(help="Unit of length of BVH files: cm or m. Default: cm.")] = None,
    allow_expired_consent: AllowExpiredConsent = None,
    as_json: AsJson = False,
) -> None:
    """Write the clips of a version to a folder, with the digest of the commit, and the licence and origin of each clip.

    The folder exists only when it is complete. `marey upload` reads a folder of motion files back, with the paths of
    the clips and their take records.
    """
    if layout not in LAYOUTS:
        raise WrongUsage(f"{layout!r} is not a layout; the layouts are {', '.join(LAYOUTS)}")
    chosen = {name: value for name, value in (("format", format), ("unit", unit)) if value is not None}
    if layout == "lerobot" and chosen:
        raise WrongUsage(f"--{next(iter(chosen))} has no meaning for lerobot, which has no motion files; leave it out")
    at = parse(place, version=True)
    options = {**chosen, "path": path, "allow_expired_consent": allow_expired_consent}
    with connect(context) as marey, progress() as advance:
        made = _export(at.on(marey), layout, folder, at.version, options, advance)
    if as_json:
        print_json(
            {
                "folder": str(folder),
                "commit": made.commit.digest,
                "clips": made.clips,
                "renamed": made.renamed,
                "left_out": made.left_out,
            }
        )
        return
    print_message(
        f"{folder} contains {counted(made.clips, 'clip')} of the version {short(made.commit.digest)} of "
        f"{at.project}/{at.dataset}"
    )
    _print_notes(made)


def _export(
    dataset: DatasetHandle, layout: str, folder: Path, version: str, options: dict[str, Any], advance: OnProgress
) -> ExportedVersion:
    write = {
        "files": dataset.export_files,
        "huggingface": dataset.export_huggingface,
        "lerobot": dataset.export_lerobot,
    }[layout]
    return write(folder, version, on_progress=advance, **options)


def _print_notes(made: ExportedVersion) -> None:
    """Print which files have other names than their clips, and how many entries that are not clips were left out."""
    for path, file in list(made.renamed.items())[:RENAMED_SHOWN]:
        print_message(f"{path} is in the file {file}, because not all systems accept its name")
    if len(made.renamed) > RENAMED_SHOWN:
        print_message(f"and {len(made.renamed) - RENAMED_SHOWN} more; the sidecar names the file of each clip")
    if made.left_out:
        kinds = ", ".join(counted(count, Kind(kind).noun) for kind, count in sorted(made.left_out.items()))
        print_message(f"left out, because only clips are exported: {kinds}; an archive contains everything")
