"""Command `download`, which writes clips and other items to files."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer

from marey_client.cli.addresses import Address, advice
from marey_client.cli.revisions import RevisionNumber, at_revision, find_revision, find_version
from marey_client.cli.terminal.failures import Refused, WrongUsage
from marey_client.cli.terminal.invocation import AllowExpiredConsent, AsJson, connect, output_option
from marey_client.cli.terminal.output import print_json, print_message
from marey_client.progress import progress
from marey_schemas.formats import EXPORT_FORMATS
from marey_schemas.wording import counted, one_of

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from marey_client.items import ItemHandle
    from marey_client.marey import Marey
    from marey_client.project import ProjectHandle
    from marey_schemas.queue.jobs import DatasetInput


DOWNLOADS_AT_ONCE = 4


def add_to(app: typer.Typer) -> None:
    """Add the command of this module to the application `app`."""
    app.command()(download)


def download(
    context: typer.Context,
    place: Annotated[
        str,
        typer.Argument(
            help="A clip, a folder of clips, or a version of a dataset: project/folder[/name[@revision]], "
            "project/dataset@version[/folder]."
        ),
    ],
    format: Annotated[  # noqa: A002
        str, typer.Option(help=f"Format of the files: {one_of(EXPORT_FORMATS)}.")
    ] = "original",
    revision: RevisionNumber = None,
    output: Annotated[Path, output_option("Folder to write to.")] = Path(),
    unit: Annotated[str | None, typer.Option(help="Unit of length of BVH files: cm or m. Default: cm.")] = None,
    part: Annotated[
        str | None,
        typer.Option(
            help="With --format predecessor: part to write instead of the whole item: tree (of a model), alignment "
            "(of an aligned clip), or skeleton_model (of a skeleton)."
        ),
    ] = None,
    layout: Annotated[
        str | None,
        typer.Option(
            help="With --format predecessor: layout of the file: 2 or 3 for models, database or file for "
            "skeletons. Default: the layout of the imported file if the item is unchanged; otherwise, database for "
            "skeletons, and for models the layout that contains the time function exactly, or else 3."
        ),
    ] = None,
    fold_positions: Annotated[
        bool,
        typer.Option(
            "--fold-positions",
            help="Write positions only for the root joint of BVH files, for programs that ignore positions of other "
            "joints.",
        ),
    ] = False,
    restored: Annotated[
        bool, typer.Option(help="Export aligned clips with the timing and position of their source clips.")
    ] = False,
    allow_expired_consent: AllowExpiredConsent = None,
    as_json: AsJson = False,
) -> None:
    """Write clips to files: one clip, or all clips in a folder and its subfolders.

    Aligned clips in a folder are written only if there are no other clips in it. After `@`, name a revision of the
    clip, or a version of the dataset. Other items, such as edits and evaluations, are written with `--format json`. For
    models, graphs, skeletons and annotations, there is also `--format predecessor`, the format of Marey's predecessor.

    An existing file is replaced; if several clips would have the same file name, later clips get a number.
    """
    if format not in EXPORT_FORMATS:
        raise WrongUsage(f"{format!r} is not a format; the formats are {', '.join(EXPORT_FORMATS)}")
    address = Address.parse(at_revision(place, revision))
    with connect(context) as marey:
        options = {
            "format": format,
            "unit": unit,
            "allow_expired_consent": allow_expired_consent,
            "fold_positions": fold_positions,
            "part": part,
            "layout": layout,
        }
        options |= {"time": "source"} if restored else {}
        written, refused = _download_all(_exported_at(marey, address), output, options)
    if as_json:
        print_json({"files": [str(path) for path in written], "refused": refused})
    else:
        typer.echo(f"wrote {counted(len(written), 'file')} to {output}")
        for name, reason in refused.items():
            print_message(f"{name}: {reason}")
    if refused:
        raise Refused


class _Exported(NamedTuple):
    """Item and revision to write to a file; the revision None means the newest one."""

    item: ItemHandle
    revision: int | None
    folder: str
    """Folder of the file, relative to the output."""
    name: str


def _exported_at(marey: Marey, address: Address) -> list[_Exported]:
    """Return the item at an address, the clips in a folder and its subfolders, or the clips of a dataset version."""
    from marey_schemas.kinds import Kind

    project = marey.project(address.project)
    single = find_revision(marey, address, [Kind.CLIP, Kind.PROCESSED])
    version = None if single is not None else find_version(marey, address)
    if version is not None:
        return _entries_of(project, version)
    below: list[ItemHandle] = [] if single is not None else list(project.clips.list(collection=address.path))
    if single is None and not below:
        below += project.processed.list(collection=address.path)
    if single is None and not below:
        single = find_revision(marey, address, [one for one in Kind if one not in (Kind.CLIP, Kind.PROCESSED)])
    if single is not None:
        return [_Exported(*single, "", single[0].name)]
    if not below:
        raise WrongUsage(
            f"there is no item and no folder with clips at {address}; {advice(project, address.path, Kind)}"
        )
    return [_Exported(one, None, one.item.collection.removeprefix(address.path).strip("/"), one.name) for one in below]


def _entries_of(project: ProjectHandle, version: DatasetInput) -> list[_Exported]:
    from marey_client.handles.clips import ClipHandle
    from marey_client.places import entries_at

    found: list[_Exported] = []
    for entry, item in entries_at(project.clips, version):
        folder, _, name = entry.path.removeprefix(version.path).strip("/").rpartition("/")
        handle = ClipHandle(project.transport, project.name, item)
        found.append(_Exported(handle, entry.revision, folder, name or item.name))
    if not found:
        raise WrongUsage(
            f"{version.dataset}@{version.version} has no clip at {version.path or 'any path'}; `marey dataset "
            "entries` lists its entries"
        )
    return found


def _download_all(
    chosen: Sequence[_Exported], output: Path, options: Mapping[str, Any]
) -> tuple[list[Path], dict[str, str]]:
    from marey_client.cli.terminal.failures import sentence
    from marey_client.downloads import TakenPaths, safe_file_name
    from marey_client.errors import RequestFailed

    written: list[Path] = []
    refused: dict[str, str] = {}
    paths = TakenPaths()

    def write(one: _Exported) -> Path | str:
        try:
            folder = output.joinpath(*(safe_file_name(name) for name in one.folder.split("/") if name))
            return one.item.export(folder, revision=one.revision, beside=paths, **options)
        except RequestFailed as error:
            if error.status >= 500 or error.status == 401:
                raise
            return sentence(error)

    try:
        with ThreadPoolExecutor(DOWNLOADS_AT_ONCE) as pool, progress() as advance:
            for one, outcome in zip(chosen, pool.map(write, chosen), strict=True):
                if isinstance(outcome, Path):
                    written.append(outcome)
                else:
                    refused[f"{one.folder}/{one.name}".strip("/")] = outcome
                advance("downloading", len(written) + len(refused), len(chosen))
    except KeyboardInterrupt:
        print_message(
            f"interrupted; files that are complete in {output}: at least {len(written)} of {len(chosen)}; no file is "
            "cut off; repeating the command writes all files again"
        )
        raise
    return written, refused
