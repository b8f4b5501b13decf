"""Commands `archive`: a version of a dataset, with its history, as one file."""

from __future__ import annotations

from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from marey_client.cli.datasets.places import DatasetPlace, VersionPlace, imported, parse, short
from marey_client.cli.terminal.failures import Refused
from marey_client.cli.terminal.invocation import AllowExpiredConsent, AsJson, connect, output_option
from marey_client.cli.terminal.output import print_json, print_message, print_pairs
from marey_client.progress import progress
from marey_schemas.wording import counted

if TYPE_CHECKING:
    from collections.abc import Iterator

    from marey_versions.archive.reading import Archive

archive = typer.Typer(
    no_args_is_help=True,
    rich_markup_mode=None,
    help="Manage archives. An archive contains a version of a dataset and all versions before it, as one file that can "
    "be checked without a server.",
)

ArchivePath = Annotated[
    Path, typer.Argument(metavar="FILE", help="The archive, a tar file.", exists=True, dir_okay=False, readable=True)
]


def add_to(app: typer.Typer) -> None:
    """Add the commands of archives to the application `app`."""
    app.add_typer(archive, name="archive")


@archive.command("create")
def create_archive(
    context: typer.Context,
    place: VersionPlace,
    file: Annotated[
        Path, typer.Argument(metavar="FILE", help="File to write, such as gaits.tar; an existing file is replaced.")
    ],
    since: Annotated[
        list[str] | None,
        typer.Option(
            metavar="VERSION",
            help="Leave out this version and all versions before it. The archive can be imported only into datasets "
            "that have this version. May be repeated.",
        ),
    ] = None,
    allow_expired_consent: AllowExpiredConsent = None,
    as_json: AsJson = False,
) -> None:
    """Write a version, all versions before it, and everything that they contain to one file, and check the file.

    If the command is interrupted, run it again: it continues to write the unfinished file, whose name ends in .part.
    """
    at = parse(place, version=True)
    with connect(context) as marey, progress() as advance:
        made = at.on(marey).archive(
            file, at.version, since=since, allow_expired_consent=allow_expired_consent, on_progress=advance
        )
    if as_json:
        return print_json({"file": str(file), "commit": made.digest, "bytes": file.stat().st_size})
    size_mb = file.stat().st_size / 1e6
    return print_message(
        f"{file} contains the version {short(made.digest)} of {at.project}/{at.dataset} ({size_mb:,.1f} MB)"
    )


@archive.command("verify")
def verify(file: ArchivePath, as_json: AsJson = False) -> None:
    """Check that an archive is complete, and that nothing in it was changed. No server is needed.

    The commit is printed last. Compare it with the commit that you expect: a new archive with other content also
    passes this check. The digest of the commit covers everything except facets, the numbers that jobs have published.
    """
    from marey_versions.archive.checking import check_archive

    with _opened(file) as opened, progress() as advance:
        check_archive(opened, lambda done, total: advance("checking", done, total))
        manifest = opened.manifest
        facts: dict[str, object] = {"dataset": manifest.dataset, "versions": len(opened.history())}
        if manifest.base:
            facts["without"] = ", ".join(manifest.base)
        else:
            facts["entries"] = sum(1 for _ in opened.versions().entries(manifest.commit))
        if facets := opened.facets():
            facts["revisions with facets"] = len(facets)
        facts |= {"members": len(opened.members), "commit": manifest.commit}
    print_json(facts) if as_json else print_pairs(facts.items())


@archive.command("extract")
def extract(
    file: ArchivePath,
    output: Annotated[Path, output_option("Folder to write to.")] = Path(),
    as_json: AsJson = False,
) -> None:
    """Write the version in an archive to files: each entry as JSON, each clip also as the file that was imported.

    No server is needed. An existing file is replaced.
    """
    from marey_client.archives.extraction import extract_archive

    with _opened(file) as opened:
        written = list(extract_archive(opened, output))
    if as_json:
        return print_json([str(one) for one in written])
    return print_message(f"wrote {counted(len(written), 'file')} to {output}")


@archive.command("import")
def import_archive(
    context: typer.Context,
    file: ArchivePath,
    place: DatasetPlace,
    branch: Annotated[str, typer.Option(help="Branch to move to the imported version.")] = "main",
    as_json: AsJson = False,
) -> None:
    """Check an archive, and record its versions in a dataset, which is created if it does not exist.

    The versions keep their digests, authors and times. Only data that the server lacks is sent. The import changes no
    folder: check out the version to get its clips. If the branch has versions that the archive lacks, the branch does
    not move: merge the imported version into the branch.
    """
    at = parse(place)
    with connect(context) as marey, _opened(file), progress() as advance:
        datasets = marey.project(at.project).datasets
        made = datasets.import_archive(file, at.dataset, into=branch, on_progress=advance)
    if as_json:
        return print_json({"commit": made.commit.digest, "branch": made.branch, "moved": made.moved})
    return print_message(imported(at, made))


@contextmanager
def _opened(path: Path) -> Iterator[Archive]:
    """Open an archive for the `with` block; the command fails if the file is damaged or is not an archive."""
    from marey_versions.archive.members import BadArchive
    from marey_versions.archive.reading import Archive

    try:
        with path.open("rb") as file:
            yield Archive(file)
    except BadArchive as error:
        print_message(f"{path}: {error}")
        raise Refused from error
