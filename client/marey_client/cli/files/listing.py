"""Commands `ls`, which lists items and folders, and `show`, which describes an item."""

from __future__ import annotations

import shlex
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Annotated, Any

import typer

from marey_client.cli.addresses import REQUESTS_AT_ONCE, Address, advice, find_item, kind_named
from marey_client.cli.holdings import outdated
from marey_client.cli.revisions import RevisionNumber, at_revision, require_revision
from marey_client.cli.terminal.failures import WrongUsage
from marey_client.cli.terminal.invocation import AsJson, QueryText, connect
from marey_client.cli.terminal.output import print_json, print_message, print_pairs, print_table
from marey_schemas.queries.fields import FACET_PREFIX
from marey_schemas.wording import counted

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterator, Sequence

    from marey_client.items import ItemHandle
    from marey_client.marey import Marey
    from marey_schemas.items import Item, Revision, Staleness
    from marey_schemas.kinds import Kind


def _of_summary(name: str) -> Callable[[Item], object]:
    return lambda item: item.summary.get(name)


RECORDED = ("subject", "action", "take", "shoot_day", "select", "licence", "capture_system", "consent_until")
"""Columns whose values are fields of the take record of a clip."""
STALE = "stale"
COLUMNS: dict[str, Callable[[Item], object]] = {
    "kind": lambda item: item.kind,
    "revision": lambda item: item.revision,
    "joints": lambda item: item.summary.get("joints"),
    "frames": lambda item: item.summary.get("frames"),
    "Hz": lambda item: _rounded(item.summary.get("frame_rate_hz")),
    "seconds": lambda item: None if (given := item.summary.get("duration_s")) is None else round(given, 3),
    "warnings": lambda item: " ".join(item.summary.get("warnings", ())),
    "tags": lambda item: " ".join(item.tags),
    **{name: _of_summary(name) for name in RECORDED},
    "created": lambda item: item.created_at,
    "updated": lambda item: item.updated_at,
    "id": lambda item: item.id,
    STALE: lambda item: None,  # noqa: ARG005 - what the server answers decides, see `_value`
}
"""Columns that follow the name in a list of items; the values of `stale` come from a separate request."""
DEFAULT_COLUMNS = "kind,revision,joints,frames,Hz,tags"
REASONS_SHOWN = 3
"""Number of outdated inputs of an item that are named one by one."""
FIGURES = ("revision", "joints", "frames", "Hz", "seconds")
"""Columns with numbers, which are aligned to the right."""


def add_to(app: typer.Typer) -> None:
    """Add the commands of this module to the application `app`."""
    for command in (ls, show):
        app.command()(command)


def ls(
    context: typer.Context,
    place: Annotated[
        str | None, typer.Argument(help="Project or folder to list: project[/folder]; default: all projects.")
    ] = None,
    recursive: Annotated[
        bool, typer.Option("--recursive", "-r", help="Also list the contents of all subfolders.")
    ] = False,
    kind: Annotated[list[str] | None, typer.Option(help="List only items of this kind; may be repeated.")] = None,
    tag: Annotated[
        str | None, typer.Option(help="List only items with one of these tags, separated by commas.")
    ] = None,
    find: Annotated[
        str, typer.Option(help="List only items whose names contain this text, including items in subfolders.")
    ] = "",
    query: QueryText = None,
    explain: Annotated[
        bool,
        typer.Option("--explain", help="Print no list, but count the items that each condition of --query excludes."),
    ] = False,
    stale: Annotated[
        bool,
        typer.Option(
            "--stale",
            help="List only stale results: items of which a direct or indirect input has a newer revision now.",
        ),
    ] = False,
    sort: Annotated[
        str,
        typer.Option(
            help="Column by which the items are sorted; a minus sign before the column reverses the order, as in "
            "-updated."
        ),
    ] = "name",
    columns: Annotated[
        str,
        typer.Option(
            help=f"Columns to show beside the name, separated by commas: {', '.join(COLUMNS)}, "
            f"or {FACET_PREFIX}NAME for a number that a job published."
        ),
    ] = DEFAULT_COLUMNS,
    deleted: Annotated[
        bool, typer.Option("--deleted", help="List removed items in the folder and its subfolders.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """List the folders and items in a folder, the projects that you may read, or the items that options select."""
    if place is None:
        from marey_client.cli.projects import list_projects

        return list_projects(context, as_json)
    address = Address.parse(place)
    if deleted:
        if explain or stale:
            raise WrongUsage("--deleted cannot be combined with --explain or --stale; leave out one of these options")
        return _show_deleted(context, address, kind, tag, find, query, as_json)
    if explain:
        if tag or find or stale:
            raise WrongUsage("--explain counts only what --query excludes; leave out --tag, --find and --stale")
        return _explain(context, address, kind, query, as_json)
    everywhere = bool(recursive or find or query)
    shown, order = _columns(columns), _columns(sort.removeprefix("-"), also=("name",))[:1]
    with connect(context) as marey:
        folders = [] if everywhere or stale else _folders_in(marey, address)
        items = _items_in(marey, address, recursive=everywhere, kinds=kind, tag=tag, find=find, query=query)
        if not folders and not items and marey.project(address.project).collections.at(address.path) is None:
            items = _items_called(marey, address)
        old: set[str] = set()
        if stale or STALE in (*shown, *order):
            old = {one.id for one, _ in outdated(marey.project(address.project), items)}
    items = [one for one in items if one.id in old] if stale else items
    items = _sorted(items, order[0], old, reverse=sort.startswith("-"))
    if as_json:
        return print_json({"collections": folders, "items": [one.item for one in items]})
    if not folders and not items:
        return print_message(_nothing_at(address, chosen=bool(kind or tag or find or query or stale)))
    rows: list[tuple[object, ...]] = [
        (f"{name}/", *("collection" if column == "kind" else "" for column in shown)) for name in folders
    ]
    for one in items:
        name = one.path if everywhere else one.name
        rows.append((name, *(_value(one.item, column, old) for column in shown)))
    return print_table(
        ("name", *shown),
        rows,
        right=[column for column in shown if column in FIGURES or column.startswith(FACET_PREFIX)],
    )


def _nothing_at(address: Address, *, chosen: bool) -> str:
    """Return the message for an empty list; `chosen` states whether options limited the list."""
    if chosen:
        return f"{address} contains nothing that meets the options"
    return f"{address} is empty; `marey upload FOLDER --project {address.project}` stores motion files"


def _explain(
    context: typer.Context, address: Address, kinds: Sequence[str] | None, query: str | None, as_json: bool
) -> None:
    """Print how many items each condition of a query excludes, for each of `kinds`; default: for clips."""
    if query is None:
        raise WrongUsage("--explain counts the items that each condition of a query excludes; add --query")
    with connect(context) as marey:
        project = marey.project(address.project)
        wanted = [kind_named(name) for name in kinds or ["clip"]]
        answers = [project.items(kind).explain(query, collection=address.path or None) for kind in wanted]
    if as_json:
        print_json(answers[0] if len(answers) == 1 else answers)
    else:
        for kind, explained in zip(wanted, answers, strict=True):
            print_message(f"{explained.selected:,} of {counted(explained.items, kind.noun)}")
            rows = [(one.condition, one.hides, one.alone) for one in explained.conditions]
            print_table(("condition", "hides", "alone"), rows, right=["hides", "alone"])


def _columns(text: str, *, also: Sequence[str] = ()) -> list[str]:
    """Return the column names in a comma-separated text. Raises `WrongUsage` for an unknown column."""
    names = [name.strip() for name in text.split(",")]
    for name in names:
        if name not in COLUMNS and name not in also and not name.startswith(FACET_PREFIX):
            known = ", ".join((*also, *COLUMNS, f"{FACET_PREFIX}NAME"))
            raise WrongUsage(f"there is no column {name!r}; the columns are {known}")
    return names


def _value(item: Item, column: str, old: Collection[str]) -> object:
    """Return the value of a column for an item; None if the item has no value.

    Facets are rounded to four significant digits. `old` are the ids of stale items.
    """
    if column == STALE:
        return STALE if item.id in old else None
    if column.startswith(FACET_PREFIX):
        value = item.facets.get(column.removeprefix(FACET_PREFIX))
        return None if value is None else float(f"{value:.4g}")
    return COLUMNS[column](item)


def _sorted(items: Sequence[ItemHandle], column: str, old: Collection[str], *, reverse: bool) -> list[ItemHandle]:
    """Sort items by a column; items without a value come last in either order."""
    if column == "name":
        return list(reversed(items)) if reverse else list(items)
    values: dict[str, Any] = {one.id: _value(one.item, column, old) for one in items}
    with_value = [one for one in items if values[one.id] not in (None, "")]
    without = [one for one in items if values[one.id] in (None, "")]
    return [*sorted(with_value, key=lambda one: values[one.id], reverse=reverse), *without]


def _show_deleted(
    context: typer.Context,
    address: Address,
    kinds: Sequence[str] | None,
    tag: str | None,
    find: str,
    query: str | None,
    as_json: bool,
) -> None:
    """List removed items and, unless `find` or `query` selects items, removed folders."""
    with connect(context) as marey:
        selected = bool(find or query)
        listed = () if selected else marey.project(address.project).collections.list(path=address.path, deleted=True)
        folders = list(listed)
        items = _items_in(marey, address, recursive=True, kinds=kinds, tag=tag, find=find, query=query, deleted=True)
    if as_json:
        return print_json({"collections": folders, "items": [one.item for one in items]})
    rows = [(f"{one.path}/", "collection", one.deleted_at, one.id) for one in folders]
    rows += [(one.path, one.item.kind, one.item.deleted_at, one.id) for one in items]
    print_table(("name", "kind", "deleted", "id"), rows)
    return print_message(
        f"`marey restore {address.project}/NAME` restores an item or a folder; if several have this name, give the id"
    )


def _items_called(marey: Marey, address: Address) -> list[ItemHandle]:
    """Return the item at an address that is not a folder, as a list; empty for a project.

    Raises `WrongUsage` if there is no such item.
    """
    from marey_schemas.kinds import Kind

    item = find_item(marey, address, list(Kind))
    if item is None and address.path:
        raise WrongUsage(
            f"there is no item or folder at {address}; {advice(marey.project(address.project), address.path, Kind)}"
        )
    return [] if item is None else [item]


def _folders_in(marey: Marey, address: Address) -> list[str]:
    """Return the names of the folders directly in the folder at an address, sorted."""
    below = marey.project(address.project).collections.list(path=address.path)
    names = (one.path.removeprefix(address.path).strip("/").partition("/")[0] for one in below)
    return sorted({name for name in names if name})


def _items_in(
    marey: Marey,
    address: Address,
    *,
    recursive: bool,
    kinds: Sequence[str] | None,
    tag: str | None,
    find: str = "",
    query: str | None = None,
    deleted: bool = False,
) -> list[ItemHandle]:
    from marey_schemas.kinds import Kind

    wanted = [kind_named(name) for name in kinds] if kinds else list(Kind)
    project = marey.project(address.project)

    def of_kind(kind: Kind) -> list[ItemHandle]:
        folder = "collection" if recursive else "directly_in"
        filters = {folder: address.path, "tag.in": tag, "q": find or None}
        found: list[ItemHandle] = list(project.items(kind).list(query=query, filters=filters, deleted=deleted))
        return sorted(found, key=lambda item: item.path)

    with ThreadPoolExecutor(REQUESTS_AT_ONCE) as pool:
        return [item for items in pool.map(of_kind, wanted) for item in items]


def show(
    context: typer.Context,
    place: Annotated[str, typer.Argument(help="The item: project/folder/name[@revision], or project/id[@revision].")],
    part: Annotated[
        str | None,
        typer.Option(
            help="Print only one part of the item, as JSON, such as motion or info of a clip; without this option, "
            "`marey show` lists the parts."
        ),
    ] = None,
    revision: RevisionNumber = None,
    history: Annotated[bool, typer.Option("--history", help="Show every revision and its inputs.")] = False,
    as_json: AsJson = False,
) -> None:
    """Show an item: its path, tags and parts, and, for a clip, the warnings of its import."""
    from marey_schemas.kinds import Kind

    with connect(context) as marey:
        item, number = require_revision(marey, Address.parse(at_revision(place, revision)), list(Kind))
        if part is not None:
            from marey_schemas.encoding.codecs import encode_tree

            return typer.echo(encode_tree(item.part(part, revision=number), "application/json"))
        if history:
            return _show_history(item, as_json)
        if number is not None:
            return _show_revision(item, item.revision(number), as_json)
        if as_json:
            return print_json(item.item)
        return print_pairs(_described(marey, item))


def _rounded(value: object) -> object:
    """Return a number rounded to six significant digits, for people; `--json` prints all digits."""
    return float(f"{value:.6g}") if isinstance(value, float) else value


def _described(marey: Marey, item: ItemHandle) -> Iterator[tuple[str, object]]:
    """Yield names and values that describe an item; for a clip also its skeleton, source and warnings.

    For a record of the predecessor, yield also its fields.
    """
    from marey_client.errors import NotFound
    from marey_client.handles.clips import ClipHandle
    from marey_schemas.kinds import Kind

    yield from item.item.model_dump(mode="json", exclude={"parts", "summary", "facets", "rev", "tags"}).items()
    yield "tags", " ".join(item.item.tags)
    for name, value in item.item.summary.items():
        if isinstance(item, ClipHandle) and name == "skeleton":
            try:
                yield name, f"{marey.project(item.project).skeletons.get(value).path} ({value})"
            except NotFound:
                yield name, f"deleted; `marey restore {item.project}/{value}` restores it"
        elif name != "warnings":
            yield name, _rounded(value)
    yield from ((f"{FACET_PREFIX}{name}", _rounded(value)) for name, value in item.item.facets.items())
    yield from (("stale", reason) for reason in _stale_reasons(item.staleness(), item))
    for name, one in item.item.parts.items():
        yield f"part {name}", f"{one.size_bytes} bytes, {one.schema_}, {one.document}"
    if item.item.kind is Kind.RECORD:
        yield from item.part("record").get("fields", {}).items()
    if isinstance(item, ClipHandle) and "info" in item.item.parts:
        info = item.info()
        if info.source is not None:
            yield "source", info.source.file_name
            yield from (("evidence", found) for found in info.source.details.get("evidence", ()))
        for check in info.checks:
            frames = f", frames {check.frames[0]} to {check.frames[1] - 1}" if check.frames else ""
            joints = f", joints {' '.join(check.joints)}" if check.joints else ""
            yield f"warning {check.code}", f"{check.message}{frames}{joints}"


def _show_revision(item: ItemHandle, found: Revision, as_json: bool) -> None:
    if as_json:
        return print_json(found)
    parts = [
        (f"part {name}", f"{one.size_bytes} bytes, {one.schema_}, {one.document}") for name, one in found.parts.items()
    ]
    described = found.model_dump(mode="json", exclude={"parts"}).items()
    return print_pairs([("name", item.path), *described, *parts])


def _show_history(item: ItemHandle, as_json: bool) -> None:
    revisions, lineage, staleness = list(item.revisions()), item.lineage(), item.staleness()
    if as_json:
        return print_json({"revisions": revisions, "lineage": lineage, "staleness": staleness})
    rows = [(one.revision, one.created_at, one.author, one.job, one.message) for one in revisions]
    print_table(("revision", "made", "author", "job", "message"), rows)
    for edge in lineage.inputs:
        typer.echo(f"made from {edge.kind} {edge.name} ({edge.item} revision {edge.revision}) as {edge.role}")
    for edge in lineage.outputs:
        typer.echo(f"used for  {edge.kind} {edge.name} ({edge.item} revision {edge.revision}) as {edge.role}")
    for reason in _stale_reasons(staleness, item):
        typer.echo(f"stale: {reason}")
    return None


def _stale_reasons(staleness: Staleness, item: ItemHandle) -> Iterator[str]:
    """Yield a text for each of the first outdated inputs, and one text with the number of all further inputs."""
    for edge in staleness.because[:REASONS_SHOWN]:
        yield f"{edge.kind} {edge.name} has newer revisions than {edge.revision}"
    if (others := len(staleness.because) - REASONS_SHOWN) > 0:
        command = f"marey show {shlex.quote(f'{item.project}/{item.path}')} --history --json"
        yield f"and {counted(others, 'more input')}; `{command}` lists all"
