"""Command `purge`, which deletes removed items for good."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated, Any

import typer

from marey_client.cli.addresses import FOLDER, Address, addresses_in_one_project, kind_named
from marey_client.cli.terminal.confirming import ask
from marey_client.cli.terminal.failures import Refused, WrongUsage
from marey_client.cli.terminal.invocation import AsJson, QueryText, connect
from marey_client.cli.terminal.output import print_json, print_message, print_table
from marey_client.progress import progress
from marey_schemas.wording import counted

if TYPE_CHECKING:
    from marey_client.project import ProjectHandle
    from marey_schemas.purges import HeldItem, PurgeAnswer, PurgedItem, PurgeRequest

MOST_SHOWN = 100
"""Greatest number of refused items that are printed, each with the objects that still need it."""


def add_to(app: typer.Typer) -> None:
    """Add the command of this module to the application `app`."""
    app.command()(purge)


def purge(
    context: typer.Context,
    places: Annotated[
        list[str],
        typer.Argument(
            help="Removed items to purge: project/folder/name or project/id. Or places whose removed items are all "
            "purged: a folder as project/folder/, or a project."
        ),
    ],
    kind: Annotated[
        str | None,
        typer.Option(
            "--kind",
            help="Kind of the items; default: all kinds. With --query, the default is clip. `collection` means a "
            "folder.",
        ),
    ] = None,
    query: QueryText = None,
    older_than: Annotated[
        int | None,
        typer.Option(
            "--older-than",
            min=0,
            help="Purge only items that were removed at least this many days ago. Default: all removed items.",
        ),
    ] = None,
    dataset: Annotated[
        str | None,
        typer.Option("--dataset", help="Name or id of a deleted dataset of the project, to purge instead of items."),
    ] = None,
    preview: Annotated[
        bool, typer.Option("--preview", help="List what the command would delete and what it would refuse.")
    ] = False,
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Purge without asking for confirmation.")] = False,
    as_json: AsJson = False,
) -> None:
    """Delete removed items for good: content, history, name and tags. Nothing can restore them.

    Garbage collection then frees the bytes that nothing else needs. Items that something still needs, such as a version
    of a dataset, are refused: the command prints what needs them, purges the other items, and exits with status 1. With
    `--dataset`, a deleted dataset is purged: its versions, branches, tags and proposals, but not its items. Only owners
    of the project may purge.
    """
    from marey_client.handles.purges import combined, purge_items, purge_step_by_step, without_contained

    addresses = addresses_in_one_project(places)
    with connect(context) as marey:
        project = marey.project(addresses[0].project)
        if dataset is not None:
            if len(places) != 1 or addresses[0].path or kind or query or older_than is not None:
                raise WrongUsage("with --dataset, give only the project of the dataset")
            return _purge_dataset(project, dataset, preview=preview, yes=yes, as_json=as_json)
        requests = [_request(project, place, kind, query, older_than) for place in places]
        previews = [
            purge_items(project.transport, project.name, one.model_copy(update={"preview": True})) for one in requests
        ]
        needed = without_contained(previews)
        if not needed:
            raise WrongUsage(
                f"there is nothing to purge at {', '.join(places)}; `marey ls --deleted {project.name}` lists the "
                "removed items"
            )
        expected = combined([previews[place] for place in needed])
        if preview or not expected.purged:
            return _report(project.name, expected, as_json)
        if not yes:
            question = f"delete {_named(project.name, expected.purged)} for good? Nothing can restore what is purged."
            ask(question, otherwise="nothing was purged")
        answers: list[PurgeAnswer] = []
        with progress() as advance:
            for answer in (
                one for place in needed for one in purge_step_by_step(project.transport, project.name, requests[place])
            ):
                answers.append(answer)
                done = sum(len(one.purged) + len(one.refused) for one in answers)
                advance("items examined", done, len(expected.purged) + len(expected.refused))
        return _report(project.name, combined(answers), as_json)


def _purge_dataset(project: ProjectHandle, name: str, *, preview: bool, yes: bool, as_json: bool) -> None:
    """Purge a deleted dataset, or print what the purge would do.

    Raises `Refused` if an object refers to a version of the dataset.
    """
    answer = project.purge_dataset(name, preview=True)
    if not answer.holders and not preview:
        if not yes:
            what = f"{counted(answer.commits, 'version')} and {counted(answer.proposals, 'proposal')}"
            question = f"delete the dataset {answer.name} with {what} for good? Nothing can restore what is purged."
            ask(question, otherwise="nothing was purged")
        answer = project.purge_dataset(answer.dataset)
    if as_json:
        print_json(answer)
    if answer.holders:
        from marey_schemas.purges import words_of

        more = f" and {answer.others:,} more" if answer.others else ""
        print_message(f"{answer.name} is cited by {', '.join(map(words_of, answer.holders))}{more}")
        raise Refused
    done = "would be purged" if answer.preview else "was purged for good"
    further = f"; {counted(answer.same_name, 'other deleted dataset')} with this name" if answer.same_name else ""
    print_message(f"{answer.name} ({answer.dataset}) {done}: {_size(answer.freed_bytes)} of versions{further}")


def _named(project: str, items: Sequence[PurgedItem]) -> str:
    others = f" and {len(items) - 1:,} more" if len(items) > 1 else ""
    return f"{counted(len(items), 'item')} ({project}/{items[0].path}{others})"


def _request(
    project: ProjectHandle, place: str, kind: str | None, query: str | None, older_than: int | None
) -> PurgeRequest:
    """Return the request to purge removed items; `place` is a folder, or the id or the former path of an item."""
    from marey_schemas.purges import PurgeRequest

    address = Address.parse(place)
    of_kind = None if kind in (None, FOLDER) else kind_named(str(kind))
    if query is not None and kind is None:
        of_kind = kind_named("clip")
    wanted: dict[str, Any] = {"kind": of_kind, "query": query, "older_than_days": older_than}
    if address.has_id:
        if address.name.startswith(f"{FOLDER}_"):
            raise WrongUsage(f"{place} is the id of a folder; give its path with a final /, or the ids of items")
        wanted["item"] = address.name
    elif not address.path or address.is_folder or kind == FOLDER or query is not None or _is_folder(project, address):
        wanted["collection"] = address.path
    else:
        wanted["path"] = address.path
    return PurgeRequest.model_validate(wanted)


def _is_folder(project: ProjectHandle, address: Address) -> bool:
    """Return whether an address belongs to a folder, existing or removed.

    Raises `WrongUsage` if removed items have the same address.
    """
    folders = project.collections
    if folders.at(address.path) is None and folders.at(address.path, deleted=True) is None:
        return False
    items = project.purge(path=address.path, preview=True)
    if items.purged or items.refused:
        raise WrongUsage(
            f"{address} names both a folder and a removed item; write {address}/ for all items removed from the "
            "folder, or the id of the item"
        )
    return True


def _report(project: str, answer: PurgeAnswer, as_json: bool) -> None:
    """Print which items were, or would be, purged or refused. Raises `Refused` if an item was refused."""
    if as_json:
        print_json(answer)
    elif answer.preview and answer.purged:
        print_table(("name", "kind", "id"), [_row(project, one) for one in answer.purged])
    _print_refused(project, answer.refused)
    done = "would be purged" if answer.preview else "purged for good"
    freed = f"; garbage collection can free about {_size(answer.freed_bytes)}" if answer.purged else ""
    refused = f", {len(answer.refused):,} refused" if answer.refused else ""
    print_message(f"{counted(len(answer.purged), 'item')} {done}{refused}{freed}")
    if answer.refused:
        raise Refused


def _row(project: str, one: PurgedItem) -> tuple[str, str, str]:
    return f"{project}/{one.path}", one.kind.value, one.item


def _print_refused(project: str, refused: Sequence[HeldItem]) -> None:
    from marey_schemas.purges import words_of

    for one in refused[:MOST_SHOWN]:
        held = ", ".join(map(words_of, one.holders)) + (f" and {one.others:,} more" if one.others else "")
        print_message(f"{project}/{one.path} ({one.item}) is still needed by {held}")
    if len(refused) > MOST_SHOWN:
        print_message(f"and {len(refused) - MOST_SHOWN:,} more; --json lists all of them")


def _size(size_bytes: int) -> str:
    """Return a number of bytes in the unit that keeps it short: "812 bytes", "3.4 kB", "1.2 GB"."""
    for place, unit in reversed(list(enumerate(("kB", "MB", "GB", "TB"), 1))):
        if size_bytes >= 1000**place:
            return f"{size_bytes / 1000**place:.1f} {unit}"
    return counted(size_bytes, "byte")
