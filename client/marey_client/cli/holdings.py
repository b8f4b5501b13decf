"""Commands `df` and `stale`: what projects hold, and which results are outdated."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from itertools import takewhile
from typing import TYPE_CHECKING, Annotated

import typer

from marey_client.cli.addresses import REQUESTS_AT_ONCE, Address
from marey_client.cli.terminal.invocation import AsJson, connect
from marey_client.cli.terminal.output import print_json, print_message, print_table
from marey_schemas.sizes import GIB, MIB
from marey_schemas.wording import counted

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from marey_client.items import ItemHandle
    from marey_client.project import ProjectHandle
    from marey_schemas.items import Staleness

FEW = 50
"""Greatest number of items that are examined one by one; for more items, one request examines a whole folder."""


def add_to(app: typer.Typer) -> None:
    """Add the commands of this module to the application `app`."""
    for command in (df, stale):
        app.command()(command)


def df(
    context: typer.Context,
    projects: Annotated[list[str] | None, typer.Argument(help="Projects; default: all that you may read.")] = None,
    as_json: AsJson = False,
) -> None:
    """Show how many items and bytes projects contain, and their limits on bytes; most bytes first.

    With --json, also the limits on items. Deleted items do not count; `marey purge` frees what they occupy.
    """
    with connect(context) as marey:
        names = projects or [one.name for one in marey.projects()]
        with ThreadPoolExecutor(REQUESTS_AT_ONCE) as pool:
            held = dict(zip(names, pool.map(lambda name: marey.project(name).quotas(), names), strict=True))
    largest_first = sorted(held.items(), key=lambda pair: -pair[1].stored_bytes.used)
    if as_json:
        return print_json(dict(largest_first))
    rows = [
        (
            name, f"{one.items.used:,}", size_text(one.stored_bytes.used), size_text(one.stored_bytes.allowed),
            f"{100 * one.stored_bytes.used / max(1, one.stored_bytes.allowed):.0f} %",
        )
        for name, one in largest_first
    ]  # fmt: skip
    columns = ("project", "items", "stored", "allowed", "used")
    return print_table(columns, rows, right=columns[1:])


def size_text(size_bytes: int) -> str:
    """Return a size for people: rounded to three digits, in MiB or GiB."""
    unit, name = (GIB, "GiB") if size_bytes >= GIB else (MIB, "MiB")
    size = size_bytes / unit
    return f"{size:,.{max(0, 2 - len(str(int(size))) + 1)}f} {name}"


def stale(
    context: typer.Context,
    place: Annotated[str, typer.Argument(help="Project or folder whose results are examined: project[/folder].")],
    as_json: AsJson = False,
) -> None:
    """List the results in a folder and below that are outdated, each with the inputs that have newer revisions."""
    from marey_client.listing.paths import require_folder
    from marey_schemas.kinds import Kind

    address = Address.parse(place)
    with connect(context) as marey:
        project = marey.project(address.project)
        if address.path:
            require_folder(marey.transport, address.project, address.path)
        items: list[ItemHandle] = [
            one for kind in Kind for one in project.items(kind).list(collection=address.path or None, sort="name")
        ]
        found = outdated(project, items)
    if as_json:
        return print_json([{"path": one.path, **answer.model_dump(mode="json")} for one, answer in found])
    if not found:
        return print_message(f"nothing is stale among {counted(len(items), 'item')} at {address}")
    print_table(
        ("name", "kind", "revision", "newer inputs"),
        [(one.path, one.item.kind, answer.revision, _reasons(answer)) for one, answer in found],
        right=["revision"],
    )
    return print_message("`marey lineage PLACE` shows the job that made a result; `marey job rerun JOB` repeats it")


def outdated(project: ProjectHandle, items: Sequence[ItemHandle]) -> list[tuple[ItemHandle, Staleness]]:
    """Return the items that are outdated, because an input has a newer revision, each with these inputs.

    Up to `FEW` items are examined one by one. For more items, the server examines all items of the same kinds in the
    deepest folder that contains all given items; the result contains only the given items.
    """
    with ThreadPoolExecutor(REQUESTS_AT_ONCE) as pool:
        if len(items) <= FEW:
            by_item = {answer.item: answer for answer in pool.map(lambda one: one.staleness(), items) if answer.stale}
        else:
            folder = _common_folder([one.item.collection for one in items])
            kinds = dict.fromkeys(one.item.kind for one in items)
            answers = pool.map(lambda kind: list(project.items(kind).outdated(collection=folder)), kinds)
            by_item = {answer.item: answer for some in answers for answer in some}
    return [(one, by_item[one.id]) for one in items if one.id in by_item]


def _common_folder(folders: Sequence[str]) -> str:
    """Return the path of the deepest folder that contains all the folders or is one of them; empty: the root."""
    parts = [folder.split("/") for folder in folders]
    shared: Iterator[str] = (step[0] for step in takewhile(lambda step: len(set(step)) == 1, zip(*parts, strict=False)))
    return "/".join(shared)


def _reasons(answer: Staleness) -> str:
    return ", ".join(f"{edge.name} (used {edge.revision})" for edge in answer.because)
