"""Commands `dataset`: versions of datasets, with branches, tags and differences."""

from __future__ import annotations

from itertools import islice
from typing import TYPE_CHECKING, Annotated

import typer

from marey_client.cli.addresses import kind_named
from marey_client.cli.datasets import bisecting, combining, comparing, copying, exporting, proposals
from marey_client.cli.datasets.places import DatasetPlace, VersionPlace, parse, short
from marey_client.cli.terminal.invocation import AsJson, ProjectName, connect
from marey_client.cli.terminal.output import print_json, print_message, print_pairs, print_table
from marey_schemas.wording import counted

if TYPE_CHECKING:
    from marey_schemas.datasets.commits import Commit, Origin
    from marey_schemas.datasets.differences import ListedCommit
    from marey_schemas.datasets.naming import Dataset
    from marey_schemas.datasets.protection import Protection

dataset = typer.Typer(
    no_args_is_help=True, rich_markup_mode=None, help="Manage datasets and their versions: commits, branches, tags."
)


def add_to(app: typer.Typer) -> None:
    """Add the commands of datasets to the application `app`."""
    bisecting.add_to(dataset)
    combining.add_to(dataset)
    comparing.add_to(dataset)
    copying.add_to(dataset)
    exporting.add_to(dataset)
    proposals.add_protection_to(dataset)
    app.add_typer(dataset, name="dataset")


@dataset.command("create")
def create_dataset(
    context: typer.Context,
    place: DatasetPlace,
    folder: Annotated[
        str | None,
        typer.Option(
            "--folder", help="Folder whose content the commits record; default: the folder with the dataset's name."
        ),
    ] = None,
    description: Annotated[str, typer.Option(help="Purpose of the dataset.")] = "",
    as_json: AsJson = False,
) -> None:
    """Create a dataset. Its commits record the content of a folder of the project."""
    at = parse(place)
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
    rows = [(one.name, one.collection, _checked_out(one), one.created_at.date(), one.description) for one in found]
    return print_table(("dataset", "folder", "checked out", "created", "description"), rows)


def _checked_out(one: Dataset) -> str:
    """Return the commit and the selection that are checked out, such as `1f3a9c07d2e4: tag = night; raw, rigs`."""
    if one.checked_out is None:
        return ""
    selection = "; ".join(filter(None, (one.checked_out.query, ", ".join(one.checked_out.paths))))
    return f"{short(one.checked_out.commit)}{f': {selection}' if selection else ''}"


@dataset.command("commit")
def commit(
    context: typer.Context,
    place: DatasetPlace,
    message: Annotated[str, typer.Option("--message", "-m", help="Message of the commit: what has changed, and why.")],
    branch: Annotated[str, typer.Option(help="Branch to which the new version is added.")] = "main",
    as_json: AsJson = False,
) -> None:
    """Record the present content of the dataset's folder as a new version."""
    at = parse(place)
    with connect(context) as marey:
        made = at.on(marey).commit(message, branch=branch)
    if as_json:
        return print_json(made)
    return print_message(f"{branch} is at {short(made.digest)} now, with {counted(made.entries, 'entry')}")


@dataset.command("log")
def log(
    context: typer.Context,
    place: VersionPlace,
    path: Annotated[
        str,
        typer.Option(
            help="Entry or folder. List only versions that changed the entry, or entries below the folder, and show "
            "how many of these entries were added, removed, moved or changed."
        ),
    ] = "",
    most: Annotated[int, typer.Option("--limit", "-n", min=1, help="Greatest number of versions to list.")] = 20,
    as_json: AsJson = False,
) -> None:
    """List a version and the versions before it, newest first.

    At a merge, the list continues only with the first parent, which is the branch into which another version was
    merged. The list contains the merge itself, but not the versions that were merged.
    """
    at = parse(place, version=True)
    with connect(context) as marey:
        found = list(islice(at.on(marey).log(at.version, path=path.strip("/")), most))
    if as_json:
        return print_json(found)
    columns = ("commit", "time", "author", "entries", *(("changes",) if path else ()), "job", "message")
    rows = [
        (short(one.digest), one.at, one.author, one.entries, *((_at_path(one),) if path else ()), one.job, one.message)
        for one in found
    ]
    return print_table(columns, rows, right=("entries",))


def _at_path(one: ListedCommit) -> str:
    """Return the changes of a commit at the path given to `log`, such as `1 moved to raw/stroll`."""
    where = [f" {way} {path}" for way, path in (("from", one.moved_from), ("to", one.moved_to)) if path]
    return "".join([comparing.counts_in_words(one.changes or {}), *where])


@dataset.command("show")
def show(context: typer.Context, place: VersionPlace, as_json: AsJson = False) -> None:
    """Show the commit that a version names: digest, parents, author, time, message and number of entries."""
    at = parse(place, version=True)
    with connect(context) as marey:
        found = at.on(marey).at(at.version)
    if as_json:
        return print_json(found)
    return print_pairs(_pairs(found))


@dataset.command("entries")
def entries(
    context: typer.Context,
    place: VersionPlace,
    path: Annotated[str, typer.Option(help="Folder below which entries are listed. Default: all entries.")] = "",
    as_json: AsJson = False,
) -> None:
    """List the entries of a version by path."""
    at = parse(place, version=True)
    with connect(context) as marey:
        found = list(at.on(marey).entries(at.version, path=path.strip("/")))
    if as_json:
        return print_json(found)
    rows = [(one.path, one.kind, ", ".join(one.tags), one.item, one.revision) for one in found]
    return print_table(("path", "kind", "tags", "item", "revision"), rows, right=("revision",))


@dataset.command("refs")
def refs(context: typer.Context, place: DatasetPlace, as_json: AsJson = False) -> None:
    """List the branches and tags of a dataset."""
    at = parse(place)
    with connect(context) as marey:
        found = list(at.on(marey).refs())
    if as_json:
        return print_json(found)
    rows = [(one.name, one.kind, short(one.commit), one.updated_at, _rule(one.protection)) for one in found]
    return print_table(("name", "kind", "commit", "changed", "protection"), rows)


def _rule(rule: Protection | None) -> str:
    if rule is None:
        return ""
    needs = [] if rule.direct_commits else ["proposals"]
    needs += [counted(rule.approvals, "approval")] if rule.approvals else []
    needs += [f"check {name}" for name in rule.checks]
    needs += ["up to date"] if rule.up_to_date else []
    return ", ".join([f"{rule.role} or higher", *needs])


@dataset.command("branch")
def branch(
    context: typer.Context,
    place: VersionPlace,
    name: Annotated[str, typer.Argument(help="Name of the new branch.")],
) -> None:
    """Create a branch that begins at a version."""
    at = parse(place, version=True)
    with connect(context) as marey:
        made = at.on(marey).create_branch(name, at.version)
    print_message(f"branch {made.name} is at {short(made.commit)}")


@dataset.command("tag")
def tag(
    context: typer.Context,
    place: VersionPlace,
    name: Annotated[str, typer.Argument(help="Name of the new tag.")],
) -> None:
    """Create a tag at a version. A tag never moves."""
    at = parse(place, version=True)
    with connect(context) as marey:
        made = at.on(marey).create_tag(name, at.version)
    print_message(f"tag {made.name} is at {short(made.commit)}")


@dataset.command("reset")
def reset(
    context: typer.Context,
    place: VersionPlace,
    name: Annotated[str, typer.Argument(help="Name of the branch to move.")],
) -> None:
    """Move a branch to any version, for example to an earlier one. No commit is deleted."""
    at = parse(place, version=True)
    with connect(context) as marey:
        moved = at.on(marey).move_branch(name, at.version)
    print_message(f"branch {moved.name} is at {short(moved.commit)} now")


@dataset.command("blame")
def blame(
    context: typer.Context,
    place: VersionPlace,
    path: Annotated[str, typer.Argument(help="Path of the entry in the dataset, such as raw/walk.")],
    kind: Annotated[
        str, typer.Option(help="Kind of the entry, because entries of several kinds may have this path.")
    ] = "clip",
    as_json: AsJson = False,
) -> None:
    """Show, for each part of an entry, for its tags and for its path, the last commit that changed it."""
    at = parse(place, version=True)
    with connect(context) as marey:
        found = at.on(marey).blame(path.strip("/"), kind_named(kind), at.version)
    if as_json:
        return print_json(found)
    origins = {**found.parts, "tags": found.tags, "path": found.place}
    rows = [_origin_row(name, one, found.path) for name, one in origins.items()]
    return print_table(("part", "commit", "time", "author", "job", "message", "note"), rows)


def _origin_row(name: str, one: Origin, path: str) -> tuple[object, ...]:
    notes = [] if one.path == path else [f"was {one.path}"]
    notes += [] if one.certain else ["or an earlier commit"]
    made = one.commit
    return name, short(made.digest), made.at, made.author, made.job, made.message, ", ".join(notes)


@dataset.command("checkout")
def checkout(
    context: typer.Context,
    place: VersionPlace,
    query: Annotated[
        str | None, typer.Option(help="Check out only the entries that this query selects, as in `marey ls --query`.")
    ] = None,
    path: Annotated[
        list[str] | None,
        typer.Option(help="Check out only this entry, or the entries below this folder; may be repeated."),
    ] = None,
    discard: Annotated[
        bool,
        typer.Option(
            "--discard",
            help="Discard changes in the folder that no commit has recorded. Without "
            "this option, such changes are an error.",
        ),
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Change the folder of a dataset to the content of a version. Items that the command removes can be restored.

    With --query or --path, only a part of the version is checked out. Marey stores which part: later commits of the
    folder keep all entries that were not checked out. To check out all entries, repeat the command without the option.
    """
    from marey_schemas.datasets.differences import CHANGE_KINDS

    at = parse(place, version=True)
    with connect(context) as marey:
        paths = [one.strip("/") for one in path or ()]
        found = at.on(marey).check_out(at.version, query=query, paths=paths, discard=discard)
    if as_json:
        return print_json(found)
    named = {name: getattr(found, name) for name in CHANGE_KINDS}
    counts = ", ".join(f"{count:,} {name}" for name, count in named.items() if count)
    content = short(found.commit)
    if found.taken is not None and found.entries is not None:
        content = f"{found.taken:,} of {counted(found.entries, 'entry')} of {content}"
    return print_message(f"the folder has {content} now: {counts or 'nothing differed'}")


def _pairs(one: Commit) -> list[tuple[str, object]]:
    return [
        ("commit", one.digest),
        ("parents", ", ".join(one.parents)),
        ("author", one.author),
        ("time", one.at),
        ("entries", one.entries),
        ("tree", one.tree),
        ("message", one.message),
        *([("job", one.job)] if one.job is not None else []),
    ]
