"""Commands `dataset`: versions of datasets, with branches, tags and differences."""

from __future__ import annotations

from itertools import islice
from typing import TYPE_CHECKING, Annotated, NamedTuple

import typer

from marey_client.cli.failures import WrongUsage
from marey_client.cli.invocation import AsJson, ProjectName, connect
from marey_client.cli.output import print_json, print_message, print_pairs, print_table
from marey_schemas.wording import counted

if TYPE_CHECKING:
    from collections.abc import Sequence

    from marey_client.handles.datasets import DatasetHandle
    from marey_client.marey import Marey
    from marey_schemas.datasets.commits import Commit
    from marey_schemas.datasets.differences import EntryDifference
    from marey_schemas.datasets.merges import MergeAnswer, Resolution

dataset = typer.Typer(
    no_args_is_help=True, rich_markup_mode=None, help="Versions of datasets: commits, branches, tags, differences."
)

SHOWN_DIGITS = 12
"""Number of digits of a commit's digest that tables show."""

DatasetPlace = Annotated[str, typer.Argument(metavar="PROJECT/DATASET", help="Dataset, such as lab/gaits.")]
VersionPlace = Annotated[
    str,
    typer.Argument(
        metavar="PROJECT/DATASET[@VERSION]",
        help="Dataset and version, such as lab/gaits@v1: a branch, a tag or a commit, with ~n for n commits earlier. "
        "Default: @main.",
    ),
]


def add_to(app: typer.Typer) -> None:
    """Register the commands of this module."""
    app.add_typer(dataset, name="dataset")


class _Place(NamedTuple):
    """Dataset and version that an argument names."""

    project: str
    dataset: str
    version: str

    def on(self, marey: Marey) -> DatasetHandle:
        return marey.project(self.project).datasets.at(self.dataset)


def _parse(text: str, *, version: bool = False) -> _Place:
    place, at, named = text.partition("@")
    project, _, name = place.strip("/").partition("/")
    if not project or not name or "/" in name or (at and not named):
        raise WrongUsage(f"{text!r} names no dataset; write project/dataset, such as lab/gaits")
    if at and not version:
        raise WrongUsage(f"{text!r} names a version, but this command works on the dataset; write {place}")
    return _Place(project, name, named or "main")


@dataset.command("create")
def create_dataset(
    context: typer.Context,
    place: DatasetPlace,
    folder: Annotated[
        str | None,
        typer.Option(
            "--folder", help="Folder of the project whose content the commits record; default: the folder of this name."
        ),
    ] = None,
    description: Annotated[str, typer.Option(help="Purpose of the dataset.")] = "",
    as_json: AsJson = False,
) -> None:
    """Create a dataset. Its commits record the content of a folder of the project."""
    at = _parse(place)
    with connect(context) as marey:
        handle = marey.project(at.project).datasets.create(
            at.dataset, collection=(folder or at.dataset).strip("/"), description=description
        )
        made = handle.read()
    if as_json:
        return print_json(made)
    return print_message(f"dataset {at.project}/{made.name} records the folder {at.project}/{made.collection}")


@dataset.command("ls")
def list_datasets(context: typer.Context, project_name: ProjectName, as_json: AsJson = False) -> None:
    """List the datasets of a project."""
    with connect(context) as marey:
        found = list(marey.project(project_name).datasets.list())
    if as_json:
        return print_json(found)
    rows = [(one.name, one.collection, one.created_at.date(), one.description) for one in found]
    return print_table(("dataset", "folder", "created", "description"), rows)


@dataset.command("commit")
def commit(
    context: typer.Context,
    place: DatasetPlace,
    message: Annotated[str, typer.Option("--message", "-m", help="What has changed, and why.")],
    branch: Annotated[str, typer.Option(help="Branch that the new version follows.")] = "main",
    as_json: AsJson = False,
) -> None:
    """Record the present content of the dataset's folder as a new version."""
    at = _parse(place)
    with connect(context) as marey:
        made = at.on(marey).commit(message, branch=branch)
    if as_json:
        return print_json(made)
    return print_message(f"{branch} is at {_short(made.digest)} now, with {counted(made.entries, 'entry')}")


@dataset.command("log")
def log(
    context: typer.Context,
    place: VersionPlace,
    most: Annotated[int, typer.Option("--limit", "-n", min=1, help="Greatest number of versions to list.")] = 20,
    as_json: AsJson = False,
) -> None:
    """List a version and the versions before it, newest first."""
    at = _parse(place, version=True)
    with connect(context) as marey:
        found = list(islice(at.on(marey).log(at.version), most))
    if as_json:
        return print_json(found)
    rows = [(_short(one.digest), one.at, one.author, one.entries, one.message) for one in found]
    return print_table(("commit", "time", "author", "entries", "message"), rows, right=("entries",))


@dataset.command("show")
def show(context: typer.Context, place: VersionPlace, as_json: AsJson = False) -> None:
    """Show the commit that a version names."""
    at = _parse(place, version=True)
    with connect(context) as marey:
        found = at.on(marey).at(at.version)
    if as_json:
        return print_json(found)
    return print_pairs(_pairs(found))


@dataset.command("entries")
def entries(
    context: typer.Context,
    place: VersionPlace,
    path: Annotated[str, typer.Option(help="Folder below which entries are listed.")] = "",
    as_json: AsJson = False,
) -> None:
    """List the entries of a version by path."""
    at = _parse(place, version=True)
    with connect(context) as marey:
        found = list(at.on(marey).entries(at.version, path=path.strip("/")))
    if as_json:
        return print_json(found)
    rows = [(one.path, one.kind, ", ".join(one.tags), one.item, one.revision) for one in found]
    return print_table(("path", "kind", "tags", "item", "revision"), rows, right=("revision",))


@dataset.command("refs")
def refs(context: typer.Context, place: DatasetPlace, as_json: AsJson = False) -> None:
    """List the branches and tags of a dataset."""
    at = _parse(place)
    with connect(context) as marey:
        found = list(at.on(marey).refs())
    if as_json:
        return print_json(found)
    rows = [(one.name, one.kind, _short(one.commit), one.updated_at) for one in found]
    return print_table(("name", "kind", "commit", "changed"), rows)


@dataset.command("branch")
def branch(
    context: typer.Context,
    place: VersionPlace,
    name: Annotated[str, typer.Argument(help="Name of the new branch.")],
) -> None:
    """Create a branch at a version."""
    at = _parse(place, version=True)
    with connect(context) as marey:
        made = at.on(marey).create_branch(name, at.version)
    print_message(f"branch {made.name} is at {_short(made.commit)}")


@dataset.command("tag")
def tag(
    context: typer.Context,
    place: VersionPlace,
    name: Annotated[str, typer.Argument(help="Name of the new tag.")],
) -> None:
    """Create a tag at a version; it never moves."""
    at = _parse(place, version=True)
    with connect(context) as marey:
        made = at.on(marey).create_tag(name, at.version)
    print_message(f"tag {made.name} is at {_short(made.commit)}")


@dataset.command("diff")
def diff(
    context: typer.Context,
    place: VersionPlace,
    after: Annotated[
        str | None, typer.Argument(help="Later version; default: the given version is compared with the one before it.")
    ] = None,
    most: Annotated[int, typer.Option("--limit", "-n", min=1, max=10_000, help="Greatest number of entries.")] = 1000,
    as_json: AsJson = False,
) -> None:
    """List the entries that were added, removed, moved or changed between two versions."""
    at = _parse(place, version=True)
    before, later = (f"{at.version}~1", at.version) if after is None else (at.version, after)
    with connect(context) as marey:
        found = at.on(marey).difference(before, later, limit=most)
    if as_json:
        return print_json(found)
    print_table(
        ("change", "kind", "path", "what"), [(one.change, one.kind, one.path, _what(one)) for one in found.entries]
    )
    counts = ", ".join(f"{count:,} {change}" for change, count in sorted(found.counts.items()))
    return print_message(f"{_short(found.before.digest)} to {_short(found.after.digest)}: {counts or 'no difference'}")


@dataset.command("checkout")
def checkout(
    context: typer.Context,
    place: VersionPlace,
    discard: Annotated[
        bool, typer.Option("--discard", help="Discard changes in the folder that no commit has recorded.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Give the folder of a dataset the entries of a version. Removed items can be restored."""
    at = _parse(place, version=True)
    with connect(context) as marey:
        found = at.on(marey).check_out(at.version, discard=discard)
    if as_json:
        return print_json(found)
    counts = ", ".join(f"{count:,} {name}" for name, count in found.model_dump(exclude={"commit"}).items() if count)
    return print_message(f"the folder has the entries of {_short(found.commit)} now: {counts or 'nothing differed'}")


@dataset.command("merge")
def merge(
    context: typer.Context,
    place: VersionPlace,
    into: Annotated[str, typer.Option(help="Branch that gets the changes.")] = "main",
    message: Annotated[str, typer.Option("--message", "-m", help="Message of the commit.")] = "",
    preview: Annotated[bool, typer.Option("--preview", help="Show the result without recording it.")] = False,
    ours: Annotated[
        list[str] | None, typer.Option(metavar="PATH:KIND", help="Conflict in which the branch wins; can be repeated.")
    ] = None,
    theirs: Annotated[
        list[str] | None,
        typer.Option(metavar="PATH:KIND", help="Conflict in which the merged version wins; can be repeated."),
    ] = None,
    base: Annotated[
        list[str] | None,
        typer.Option(metavar="PATH:KIND", help="Conflict in which the entry stays as before both; can be repeated."),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Merge a version into a branch. Changes of different parts of one entry are combined.

    If both sides have changed the same part of an entry, nothing is merged until each such conflict is decided by
    --ours, --theirs or --base. In that case, the exit status is 1.
    """
    from marey_client.errors import Conflict
    from marey_schemas.datasets.merges import MergeAnswer

    at = _parse(place, version=True)
    resolutions = [*_resolutions(ours, "ours"), *_resolutions(theirs, "theirs"), *_resolutions(base, "base")]
    with connect(context) as marey:
        try:
            found = at.on(marey).merge(at.version, into=into, message=message, resolutions=resolutions, preview=preview)
        except Conflict as error:
            if error.code != "merge-conflicts":
                raise
            found = MergeAnswer.model_validate(error.context)
    if as_json:
        print_json(found)
    else:
        _print_merge(found, into)
    if found.conflict_count:
        raise typer.Exit(1)


def _resolutions(places: Sequence[str] | None, side: str) -> list[Resolution]:
    from marey_schemas.datasets.merges import Resolution

    found = []
    for place in places or ():
        path, colon, kind = place.rpartition(":")
        if not colon:
            raise WrongUsage(f"{place!r} names no kind; write path:kind, such as raw/walk:clip")
        found.append(Resolution.model_validate({"path": path.strip("/"), "kind": kind, "take": side}))
    return found


def _print_merge(found: MergeAnswer, into: str) -> None:
    if found.conflict_count:
        rows = [(one.path, one.kind, ", ".join(one.parts)) for one in found.conflicts]
        print_table(("conflict", "kind", "changed on both sides"), rows)
        print_message(
            f"{counted(found.conflict_count, 'conflict')}; nothing is merged. Decide each by --ours, --theirs or --base"
        )
    elif found.commit is None:
        print_message(f"{counted(found.changes, 'entry')} of {into} would change, without conflicts")
    else:
        print_message(
            f"{into} is at {_short(found.commit.digest)} now; {counted(found.changes, 'entry')} changed. "
            "marey dataset checkout gives the folder its entries"
        )


def _what(one: EntryDifference) -> str:
    changes = [f"was {one.was}"] if one.was else []
    if one.before is not None and one.after is not None:
        changes += [f"{part} {change}" for part, change in one.parts.items()]
    changes += [f"+{tag}" for tag in one.tags_added if one.before is not None]
    changes += [f"-{tag}" for tag in one.tags_removed if one.after is not None]
    return ", ".join(changes)


def _pairs(one: Commit) -> list[tuple[str, object]]:
    return [
        ("commit", one.digest),
        ("parents", ", ".join(one.parents)),
        ("author", one.author),
        ("time", one.at),
        ("entries", one.entries),
        ("tree", one.tree),
        ("message", one.message),
    ]


def _short(digest: str | None) -> str | None:
    return None if digest is None else digest.partition(":")[2][:SHOWN_DIGITS]
