"""Commands `mv`, `rm`, `restore`, `revert` and `tag`, which organise a project. Removed items can be restored."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Annotated, Any

import typer

from marey_client.cli.addresses import FOLDER, Address, Thing, require_apart, the_thing
from marey_client.cli.revisions import require_revision
from marey_client.cli.terminal.failures import Refused, WrongUsage, sentence
from marey_client.cli.terminal.invocation import AsJson, connect
from marey_client.cli.terminal.output import print_json, print_message
from marey_schemas.wording import counted

if TYPE_CHECKING:
    from marey_client.items import ItemHandle
    from marey_client.marey import Marey

Places = Annotated[
    list[str], typer.Argument(help="One or more items or folders: project/folder/name, project/folder/ or project/id.")
]
KindOf = Annotated[
    str | None,
    typer.Option(
        "--kind", help="Kind of the item, needed if items of several kinds have this name; `collection` means a folder."
    ),
]


def add_to(app: typer.Typer) -> None:
    """Register the commands of this module."""
    for command in (mv, rm, restore, revert, tag):
        app.command()(command)


def mv(
    context: typer.Context,
    places: Annotated[
        list[str],
        typer.Argument(
            help="Items or folders to move, then the destination: a new name, or a folder, which ends with /."
        ),
    ],
    kind: KindOf = None,
    as_json: AsJson = False,
) -> None:
    """Move or rename items and folders within a project. Ids and history do not change."""
    *sources, target = places
    if not sources:
        raise WrongUsage("give the items to move and the destination, such as: marey mv lab/raw/walk lab/raw/stroll")
    to = Address.parse(target)
    for source in sources:
        if Address.parse(source).project != to.project:
            raise WrongUsage(f"{source} cannot move to another project; download it, and upload it to {to.project}")
    with connect(context) as marey:
        into_folder = target.endswith("/") or not to.path or len(sources) > 1 or _is_folder(marey, to)
        things = [the_thing(marey, source, kind) for source in sources]
        require_apart(things)
        folder, name = (to.path, None) if into_folder else _parted(to.path)

        def move(thing: Thing) -> Any:
            was = thing.place
            moved = thing.move(folder, name or was.rpartition("/")[2])
            print_message(f"{was} is {to.project}/{moved.path} now")
            return moved

        _do_each(things, move, "moved", as_json)


def rm(
    context: typer.Context,
    places: Places,
    kind: KindOf = None,
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Remove without asking for confirmation.")] = False,
    as_json: AsJson = False,
) -> None:
    """Remove items, and folders with their contents; `marey restore` restores them."""
    with connect(context) as marey:
        things = [the_thing(marey, place, kind) for place in places]
        require_apart(things)
        count = sum(thing.count() for thing in things)
        if count > 1 and not yes:
            _ask(f"remove {counted(count, 'item')} ({_named(things)})?")

        def remove(thing: Thing) -> Any:
            thing.delete()
            print_message(f"{thing.place} is removed; to undo this, run marey restore {_typed(thing)}")
            return {"id": thing.id, "kind": thing.kind, "place": thing.place}

        _do_each(things, remove, "removed", as_json)


def restore(context: typer.Context, places: Places, kind: KindOf = None, as_json: AsJson = False) -> None:
    """Restore removed items, and folders with the contents removed along with them; `marey ls --deleted` lists them."""
    from marey_client.errors import Conflict

    with connect(context) as marey:
        things = [the_thing(marey, place, kind, deleted=True) for place in places]
        require_apart(things)

        def bring_back(thing: Thing) -> Any:
            try:
                restored = thing.restore()
            except Conflict as error:
                error.add_note("first move the item at that place away, with marey mv")
                raise
            print_message(f"{thing.place} is back")
            return restored

        _do_each(things, bring_back, "restored", as_json)


def revert(
    context: typer.Context,
    place: Annotated[str, typer.Argument(help="Item and earlier revision: project/folder/name@revision.")],
    message: Annotated[str, typer.Option("--message", "-m", help="Message of the new revision.")] = "",
    as_json: AsJson = False,
) -> None:
    """Create a revision of an item with the content of an earlier one. Name, folder and tags stay."""
    from marey_schemas.kinds import Kind

    with connect(context) as marey:
        item, revision = require_revision(marey, Address.parse(place), list(Kind))
        if revision is None:
            raise WrongUsage(f"{place} names no revision; write project/folder/name@2 for the second one")
        before = item.item.revision
        made = item.revert(revision, message=message)
    if as_json:
        return print_json(made)
    if made.revision == before:
        return print_message(f"{made.path} has the content of revision {revision} already")
    return print_message(f"{made.path}: revision {made.revision} has the content of revision {revision}")


def tag(
    context: typer.Context,
    places: Annotated[list[str], typer.Argument(help="One or more items: project/folder/name, or project/id.")],
    add: Annotated[list[str] | None, typer.Option(help="A tag to add; may be repeated.")] = None,
    remove: Annotated[list[str] | None, typer.Option(help="A tag to remove; may be repeated.")] = None,
    kind: KindOf = None,
    as_json: AsJson = False,
) -> None:
    """Add tags to items, and remove others; `marey ls --tag` lists items by tag."""
    from marey_schemas.items import ItemChange

    added, removed = tuple(add or ()), frozenset(remove or ())
    if not added and not removed:
        raise WrongUsage("no tags to change; give them with --add NAME or --remove NAME")
    ItemChange(tags=added)  # a tag that is none is told before anything changes
    with connect(context) as marey:
        things = [the_thing(marey, place, kind) for place in places]
        require_apart(things)
        for thing in things:
            if thing.kind == FOLDER:
                raise WrongUsage(f"{thing.place} is a folder, and folders have no tags; give the items in it")

        def put_tags(thing: Any) -> Any:
            handle: ItemHandle = thing.handle
            kept = (one for one in (*handle.item.tags, *added) if one not in removed)
            changed = handle.change(ItemChange(tags=tuple(dict.fromkeys(kept))))
            print_message(f"{thing.place}: {' '.join(changed.tags) or 'no tags'}")
            return changed

        _do_each(things, put_tags, "changed", as_json)


def _is_folder(marey: Marey, address: Address) -> bool:
    return marey.project(address.project).collections.at(address.path) is not None


def _parted(path: str) -> tuple[str, str]:
    folder, _, name = path.rpartition("/")
    return folder, name


def _typed(thing: Thing) -> str:
    """Return the address of a folder or item as users type it; the address of a folder ends with a slash."""
    place = f"{thing.place}/" if thing.kind == FOLDER else thing.place
    return place if place.isascii() and " " not in place else f"'{place}'"


def _named(things: Sequence[Thing]) -> str:
    first, others = _typed(things[0]), len(things) - 1
    return f"{first} and {others} more" if others else first


def _ask(question: str) -> None:
    """Ask for confirmation. Raises `Refused` unless the answer is yes, and `WrongUsage` without a terminal."""
    if not sys.stdin.isatty():
        raise WrongUsage(
            f"{question} This needs a confirmation, but standard input is not a terminal; confirm with --yes"
        )
    if not typer.confirm(question, err=True):
        print_message("nothing is removed")
        raise Refused


def _do_each(things: Sequence[Thing], do: Callable[[Thing], Any], done: str, as_json: bool) -> None:
    """Apply a function to each folder or item, and print refusals. Raises `Refused` at the end if there were any."""
    from marey_client.errors import RequestFailed

    results: list[Any] = []
    refused: dict[str, str] = {}
    for thing in things:
        place = thing.place
        try:
            results.append(do(thing))
        except RequestFailed as error:
            if error.status >= 500 or error.status == 401:
                raise
            refused[place] = sentence(error)
            print_message(f"{place}: {refused[place]}")
    if as_json:
        report: Mapping[str, Any] = {done: results, "refused": refused}
        print_json(report)
    if refused:
        raise Refused
