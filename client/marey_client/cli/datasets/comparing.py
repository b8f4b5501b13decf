"""Command `dataset diff`: how two versions differ, by entry or folder, and in terms of motion."""

from __future__ import annotations

from itertools import islice
from typing import TYPE_CHECKING, Annotated

import typer

from marey_client.cli.datasets.places import NamedVersion, VersionPlace, parse, short
from marey_client.cli.terminal.invocation import AsJson, connect
from marey_client.cli.terminal.output import print_json, print_message, print_table

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from marey_client.marey import Marey
    from marey_schemas.datasets.differences import ChangeKind, DatasetDifference, EntryDifference

MOST_DETAILED = 20
"""Greatest number of entries that `--details` describes; each needs a request of its own."""


def add_to(dataset: typer.Typer) -> None:
    """Add the command of this module to the group `marey dataset`."""
    dataset.command()(diff)


def diff(
    context: typer.Context,
    place: VersionPlace,
    after: Annotated[
        str | None,
        typer.Argument(
            help="Later version. Without it, the first argument is the later version, and is compared with the version "
            "before it."
        ),
    ] = None,
    path: Annotated[str, typer.Option(help="Entry or folder to compare. Default: all entries.")] = "",
    most: Annotated[
        int, typer.Option("--limit", "-n", min=1, max=10_000, help="Greatest number of entries to list.")
    ] = 1000,
    by_folder: Annotated[
        bool, typer.Option("--folders", help="Show only the number of changes in each folder.")
    ] = False,
    details: Annotated[
        bool,
        typer.Option(
            "--details", help=f"Describe how the content of the first {MOST_DETAILED} changed entries differs."
        ),
    ] = False,
    as_json: AsJson = False,
) -> None:
    """List the entries that were added, removed, moved or changed between two versions."""
    at = parse(place, version=True)
    before, later = (f"{at.version}~1", at.version) if after is None else (at.version, after)
    with connect(context) as marey:
        found = at.on(marey).difference(before, later, path=path.strip("/"), limit=most)
        if as_json:
            return print_json(found)
        if by_folder:
            print_table(
                ("folder", "changes"),
                [(name or "/", counts_in_words(counts)) for name, counts in found.folders.items()],
            )
        else:
            rows = [(one.change, one.kind, one.path, _what(one)) for one in found.entries]
            print_table(("change", "kind", "path", "what"), rows)
        if details:
            for line in _detailed(marey, at, found):
                typer.echo(line)
    heading = f"{short(found.before.digest)} to {short(found.after.digest)}"
    return print_message(f"{heading}: {counts_in_words(found.counts) or 'no difference'}")


def counts_in_words(counts: Mapping[ChangeKind, int]) -> str:
    """Return the numbers of entries by kind of change, such as `2 added, 1 removed`."""
    return ", ".join(f"{count:,} {change}" for change, count in sorted(counts.items()))


def _what(one: EntryDifference) -> str:
    changes = [f"was {one.was}"] if one.was else []
    if one.before is not None and one.after is not None:
        changes += [f"{part} {change}" for part, change in one.parts.items()]
    changes += [f"+{tag}" for tag in one.tags_added if one.before is not None]
    changes += [f"-{tag}" for tag in one.tags_removed if one.after is not None]
    return ", ".join(changes)


def _detailed(marey: Marey, at: NamedVersion, found: DatasetDifference) -> Iterator[str]:
    """Yield lines that describe how the content of changed entries differs."""
    changed = [one for one in found.entries if one.before and one.after and one.parts]
    for one in islice(changed, MOST_DETAILED):
        yield ""
        yield f"{one.path}:"
        yield from (f"  {line}" for line in _described(marey, at, one))
    if len(changed) > MOST_DETAILED:
        yield ""
        yield f"{len(changed) - MOST_DETAILED:,} more changed entries are not described; --path chooses a folder"


def _described(marey: Marey, at: NamedVersion, one: EntryDifference) -> Iterator[str]:
    from marey_client.cli.difference.words import changes_in_words
    from marey_client.errors import NotFound

    assert one.before is not None
    assert one.after is not None
    if one.before.item is None or one.after.item is None:
        yield "cannot be compared: the project has no revision with this content"
        return
    items = marey.project(at.project).items(one.kind)
    try:
        before = items.get(one.before.item)
        other = None if one.after.item == before.id else items.get(one.after.item)
    except NotFound:
        yield "cannot be compared: the item was deleted; marey restore restores it"
        return
    yield from changes_in_words(before.difference(one.before.revision, one.after.revision, other=other))
