"""Commands `mv`, `rm`, `restore`, `revert` and `tag`, which organise a project. Removed items can be restored."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence, Set
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import typer

from marey_client.cli.addresses import (
    FOLDER,
    REQUESTS_AT_ONCE,
    Address,
    FolderOrItem,
    SingleItem,
    folder_or_item,
    items_selected,
    require_apart,
)
from marey_client.cli.revisions import require_revision
from marey_client.cli.terminal.confirming import ask
from marey_client.cli.terminal.failures import Refused, WrongUsage, sentence
from marey_client.cli.terminal.invocation import AsJson, QueryText, connect
from marey_client.cli.terminal.output import print_json, print_message, print_table
from marey_client.progress import progress
from marey_schemas.validation.reasons import plain_reason
from marey_schemas.wording import counted

if TYPE_CHECKING:
    from marey_client.marey import Marey
    from marey_schemas.items import ItemChange

AnyFolderOrItem = TypeVar("AnyFolderOrItem", bound=FolderOrItem)
Places = Annotated[
    list[str], typer.Argument(help="One or more items or folders: project/folder/name, project/folder/ or project/id.")
]
KindOf = Annotated[
    str | None,
    typer.Option(
        "--kind", help="Kind of the item, needed if items of several kinds have this name; `collection` means a folder."
    ),
]
PlacesOrFolders = Annotated[
    list[str],
    typer.Argument(
        help="One or more items or folders: project/folder/name, project/folder/ or project/id. With --query: the "
        "projects or folders in which items are selected."
    ),
]
KindOrClips = Annotated[
    str | None,
    typer.Option(
        "--kind",
        help="Kind of the item, needed if items of several kinds have this name; `collection` means a folder. With "
        "--query: kind of the items that are selected; default: clip.",
    ),
]
Preview = Annotated[bool, typer.Option("--preview", help="List what the command would change, but change nothing.")]


def add_to(app: typer.Typer) -> None:
    """Add the commands of this module to the application `app`."""
    for command in (mv, rm, restore, revert, tag):
        app.command()(command)


def mv(
    context: typer.Context,
    places: Annotated[
        list[str],
        typer.Argument(
            help="Items or folders to move, then the destination: a new name, an existing folder, or a new folder, "
            "which ends with /. Several items or folders are always moved into a folder."
        ),
    ],
    kind: KindOf = None,
    as_json: AsJson = False,
) -> None:
    """Move or rename items and folders within a project. Ids and history do not change."""
    *sources, destination = places
    if not sources:
        raise WrongUsage("give the items to move and the destination, such as: marey mv lab/raw/walk lab/raw/stroll")
    to = Address.parse(destination)
    for source in sources:
        if Address.parse(source).project != to.project:
            raise WrongUsage(f"{source} cannot be moved to another project; download it, and upload it to {to.project}")
    with connect(context) as marey:
        into_folder = to.is_folder or not to.path or len(sources) > 1 or _is_folder(marey, to)
        targets = [folder_or_item(marey, source, kind) for source in sources]
        require_apart(targets)
        folder, name = (to.path, None) if into_folder else _parted(to.path)

        def move(target: FolderOrItem) -> Any:
            was = target.place
            moved = target.move(folder, name or was.rpartition("/")[2])
            place = f"{to.project}/{moved.path}"
            print_message(f"{was} is moved to {place}" if place != was else f"{was} is already there")
            return moved

        _do_each(targets, move, "moved", as_json)


def rm(
    context: typer.Context,
    places: PlacesOrFolders,
    kind: KindOrClips = None,
    query: QueryText = None,
    preview: Preview = False,
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Remove without asking for confirmation.")] = False,
    as_json: AsJson = False,
) -> None:
    """Remove items, and folders with their contents; `marey restore` restores them.

    Each item or folder is removed by a request of its own. If the server refuses a request, for example because
    somebody has changed the item since it was selected, the other requests are still sent, and the exit status is 1.
    """
    with connect(context) as marey:
        targets = _named_or_selected(marey, places, kind, query)
        count = sum(target.count() for target in targets)
        if preview:
            return _preview(("name", "kind"), [(one.place, one.kind) for one in targets], targets, "removed", as_json)
        if (count > 1 or query is not None) and not yes:
            ask(f"remove {counted(count, 'item')} ({_named(targets)})?", otherwise="nothing was removed")

        def remove(target: FolderOrItem) -> Any:
            target.delete()
            if query is None:
                print_message(f"{target.place} is removed; to undo this, run marey restore {_typed(target)}")
            return _identified(target)

        return _do_each(targets, remove, "removed", as_json, selected=query is not None)


def restore(
    context: typer.Context,
    places: PlacesOrFolders,
    kind: KindOrClips = None,
    query: QueryText = None,
    preview: Annotated[
        bool, typer.Option("--preview", help="List what --query would restore, but change nothing.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Restore removed items, and folders with the contents removed along with them; `marey ls --deleted` lists them.

    If several removed items had the same path, the one that was removed last is restored. With --query, each item is
    restored by a request of its own. If the server refuses a request, for example because another item has the path
    now, the other requests are still sent, and the exit status is 1.
    """
    from marey_client.errors import Conflict

    if preview and query is None:
        raise WrongUsage("--preview lists the items that a query selects; add --query, or leave out --preview")
    with connect(context) as marey:
        targets = _named_or_selected(marey, places, kind, query, deleted=True)
        if query is not None:
            targets = _last_at_each_path(targets)
        if preview:
            return _preview(("name", "kind"), [(one.place, one.kind) for one in targets], targets, "restored", as_json)

        def bring_back(target: FolderOrItem) -> Any:
            try:
                restored = target.restore()
            except Conflict as error:
                error.add_note("first move or rename the item that has this address now, with marey mv")
                raise
            if query is None:
                print_message(f"{target.place} is restored")
            return restored

        return _do_each(targets, bring_back, "restored", as_json, selected=query is not None)


def _last_at_each_path(targets: Sequence[FolderOrItem]) -> list[FolderOrItem]:
    """Return the item or folder that was removed last at each path; print how many earlier ones are left out.

    Among the `targets` with the same path, the one that was removed last must be the first.
    """
    chosen: dict[str, FolderOrItem] = {}
    for one in targets:
        chosen.setdefault(one.place, one)
    if others := len(targets) - len(chosen):
        print_message(
            f"left out {counted(others, 'item')} with the path of an item that was removed later; restore them by "
            "their ids"
        )
    return list(chosen.values())


def revert(
    context: typer.Context,
    place: Annotated[str, typer.Argument(help="Item and earlier revision: project/folder/name@revision.")],
    message: Annotated[
        str,
        typer.Option(
            "--message", "-m", help="Message of the new revision. Default: a sentence that names the earlier revision."
        ),
    ] = "",
    as_json: AsJson = False,
) -> None:
    """Create a revision of an item with the content of an earlier revision. Name, folder and tags do not change."""
    from marey_schemas.kinds import Kind

    with connect(context) as marey:
        item, revision = require_revision(marey, Address.parse(place), list(Kind))
        if revision is None:
            raise WrongUsage(f"{place} names no revision; write project/folder/name@2 for the second revision")
        before = item.item.revision
        made = item.revert(revision, message=message)
    if as_json:
        return print_json(made)
    if made.revision == before:
        return print_message(f"{made.path} has the content of revision {revision} already")
    return print_message(f"{made.path}: revision {made.revision} has the content of revision {revision}")


def tag(
    context: typer.Context,
    places: Annotated[
        list[str],
        typer.Argument(
            help="One or more items: project/folder/name, or project/id. With --query: the projects or folders in "
            "which items are selected."
        ),
    ],
    add: Annotated[list[str] | None, typer.Option(help="A tag to add; may be repeated.")] = None,
    remove: Annotated[list[str] | None, typer.Option(help="A tag to remove; may be repeated.")] = None,
    kind: KindOrClips = None,
    query: QueryText = None,
    preview: Preview = False,
    as_json: AsJson = False,
) -> None:
    """Add tags to items, and remove tags from items; `marey ls --tag` lists items by tag.

    Each item is changed by a request of its own. If the server refuses a request, for example because somebody has
    changed the item since it was selected, the other requests are still sent, and the exit status is 1.
    """
    from marey_schemas.items import ItemChange

    added, removed = tuple(add or ()), frozenset(remove or ())
    if not added and not removed:
        raise WrongUsage("no tags to change; give them with --add NAME or --remove NAME")
    ItemChange(tags=added)  # an invalid tag is refused before anything changes
    with connect(context) as marey:
        targets = _named_or_selected(marey, places, kind, query)
        wanted = {one.id: _with_tags(one, added, removed) for one in targets}
        items = [one for one in targets if isinstance(one, SingleItem)]
        if query is not None:
            items = [one for one in items if wanted[one.id].tags != one.handle.item.tags]
            if len(items) < len(targets):
                print_message(f"{len(targets) - len(items):,} of {counted(len(targets), 'item')} need no change")
        if preview:
            rows = [(one.place, " ".join(one.handle.item.tags), " ".join(wanted[one.id].tags or ())) for one in items]
            return _preview(("name", "tags", "new tags"), rows, items, "changed", as_json)

        def put_tags(item: SingleItem) -> Any:
            changed = item.handle.change(wanted[item.id])
            if query is None:
                print_message(f"{item.place}: {' '.join(changed.tags) or 'no tags'}")
            return changed

        return _do_each(items, put_tags, "changed", as_json, selected=query is not None)


def _with_tags(target: FolderOrItem, added: Sequence[str], removed: Set[str]) -> ItemChange:
    """Return the change that adds and removes tags of an item.

    Raises `WrongUsage` for a folder, and for more tags than an item can have.
    """
    from pydantic import ValidationError

    from marey_schemas.items import ItemChange

    if not isinstance(target, SingleItem):
        raise WrongUsage(f"{target.place} is a folder, and folders have no tags; give the items in it")
    tags = dict.fromkeys(one for one in (*target.handle.item.tags, *added) if one not in removed)
    try:
        return ItemChange(tags=tuple(tags))
    except ValidationError as error:
        reason = plain_reason(error.errors(include_url=False)[0])
        raise WrongUsage(
            f"{target.place} cannot have {counted(len(tags), 'tag')}: {reason}; nothing was changed"
        ) from None


def _named_or_selected(
    marey: Marey, places: Sequence[str], kind: str | None, query: str | None, *, deleted: bool = False
) -> Sequence[FolderOrItem]:
    """Return the folders and items at addresses. With `query`, return the items in these places that the query selects.

    With `deleted`, these are deleted folders and items.
    """
    if query is not None:
        return items_selected(marey, places, query, kind, deleted=deleted)
    targets = [folder_or_item(marey, place, kind, deleted=deleted) for place in places]
    require_apart(targets)
    return targets


def _identified(target: FolderOrItem) -> dict[str, str]:
    return {"id": target.id, "kind": target.kind, "place": target.place}


def _preview(
    columns: Sequence[str], rows: Sequence[Sequence[object]], targets: Sequence[FolderOrItem], done: str, as_json: bool
) -> None:
    """Print what a command would change."""
    if as_json:
        return print_json({"preview": list(map(_identified, targets))})
    print_table(columns, rows)
    count = sum(target.count() for target in targets)
    return print_message(f"{counted(count, 'item')} would be {done}; nothing was changed")


def _is_folder(marey: Marey, address: Address) -> bool:
    return marey.project(address.project).collections.at(address.path) is not None


def _parted(path: str) -> tuple[str, str]:
    folder, _, name = path.rpartition("/")
    return folder, name


def _typed(target: FolderOrItem) -> str:
    """Return the address of a folder or item as users type it; the address of a folder ends with a slash."""
    place = f"{target.place}/" if target.kind == FOLDER else target.place
    return place if place.isascii() and " " not in place else f"'{place}'"


def _named(targets: Sequence[FolderOrItem]) -> str:
    first, others = _typed(targets[0]), len(targets) - 1
    return f"{first} and {others} more" if others else first


def _do_each(
    targets: Sequence[AnyFolderOrItem],
    do: Callable[[AnyFolderOrItem], Any],
    done: str,
    as_json: bool,
    *,
    selected: bool = False,
) -> None:
    """Apply `do` to each folder or item, and print refusals. Raises `Refused` at the end if there was a refusal.

    `done` is the past participle for messages, such as "moved". With `selected`, a query selected the items: several
    requests are then sent at a time, because the items do not depend on each other, and the number of changed items is
    printed.
    """
    from marey_client.errors import RequestFailed

    def attempt(target: AnyFolderOrItem) -> tuple[Any, str | None]:
        try:
            return do(target), None
        except RequestFailed as error:
            if error.status >= 500 or error.status == 401:
                raise
            print_message(f"{target.place}: {sentence(error)}")
            return None, sentence(error)

    results: list[Any] = []
    refused: dict[str, str] = {}
    with progress() as advance, ThreadPoolExecutor(REQUESTS_AT_ONCE if selected else 1) as pool:
        for number, (target, (result, refusal)) in enumerate(zip(targets, pool.map(attempt, targets), strict=True), 1):
            if refusal is None:
                results.append(result)
            else:
                refused[target.place] = refusal
            if selected:
                advance(f"items {done}", number, len(targets))
    if selected:
        print_message(f"{counted(len(results), 'item')} {done}" + (f", {len(refused)} refused" if refused else ""))
    if as_json:
        report: Mapping[str, Any] = {done: results, "refused": refused}
        print_json(report)
    if refused:
        raise Refused
