"""Lists of items: filters, order, pages, and selection of fields."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import asdict, dataclass, field, replace
from types import MappingProxyType
from typing import Any

from sqlalchemy import ColumnElement, and_, case, func, not_, select, true

from marey_schemas.access import Role
from marey_schemas.items import HidingCondition, Item, Page, QueryExplanation
from marey_schemas.kinds import Kind
from marey_schemas.queries.grammar import Query, QueryError, parse, parts_of, with_clips
from marey_server.errors import BadRequestProblem, ForbiddenProblem
from marey_server.store import collections, listing, projects
from marey_server.store.items import narrowing
from marey_server.store.items.querying import sql_of
from marey_server.store.items.reading import item_rows, shown_items
from marey_server.store.tables import collection, item, item_tag
from marey_server.store.transaction import Transaction, in_lists

SORT_KEYS: dict[str, ColumnElement[Any]] = {
    "id": item.c.id,
    "name": item.c.name,
    "created_at": item.c.created_us,
    "updated_at": item.c.updated_us,
    "frames": item.c.frames,
}


@dataclass(frozen=True, slots=True)
class ItemFilters:
    """Filters of a list of items; a filter that is None matches every item."""

    collection: str | None = None
    """Path of a folder; items in folders below it match, too."""
    directly_in: str | None = None
    """Path of a folder; items in folders below it do not match. The empty path is the root."""
    path: str | None = None
    """Path of an item: folder and name."""
    name: str | None = None
    """Exact name, or its beginning followed by `*`."""
    tags: tuple[str, ...] = ()
    """Tags; items with at least one of these match."""
    skeleton: str | None = None
    clip: str | None = None
    """Id of a clip; its annotations match."""
    frames_gte: int | None = None
    frames_lte: int | None = None
    q: str | None = None
    """Part of the name, without regard to case."""
    query: str | None = None
    """Query of `marey_schemas.queries`."""
    alike: Mapping[str, frozenset[str]] = field(default_factory=dict)
    """Ids of the clips that meet the conditions `like(...)` of the query, by the text of the condition."""
    deleted: bool = False

    @property
    def looks_up_name(self) -> bool:
        """Whether `name` is given without a wildcard, or ends in `**`.

        In `walk**`, only the last asterisk is a wildcard, so it selects the names that begin with `walk*`.
        """
        return bool(self.name) and (not str(self.name).endswith("*") or str(self.name).endswith("**"))

    @property
    def identity(self) -> dict[str, Any]:
        """The filters as the cursors of a list contain them.

        Without newer filters, they are the same as in version 0.1, so that its cursors stay valid after an upgrade.
        """
        found = {"exact_name": None, **asdict(replace(self, alike={}))}  # a filter that only version 0.1 had
        newer = () if self.query else ("query",)
        return {name: value for name, value in found.items() if name not in ("alike", *newer)}


def list_items(
    tx: Transaction,
    project: str,
    kind: Kind,
    filters: ItemFilters = ItemFilters(),
    *,
    sort: str = "-created_at",
    cursor: str | None = None,
    limit: int = listing.DEFAULT_LIMIT,
    fields: Collection[str] | None = None,
    count: bool = False,
) -> Page:
    """Return one page of a project's items of a kind; with `fields`, each item has only the members named there.

    With `count`, the page also contains the number of all items that match. Raises `ForbiddenProblem` if the caller is
    an attempt of a job, unless the filters name the items (`ItemFilters.looks_up_name`).
    """
    if tx.principal.kind == "attempt" and not filters.looks_up_name:
        raise ForbiddenProblem(
            "A running job can list only items of one name: send the parameter `name` with a whole name, without `*`.",
            code="not-for-attempts",
        )
    project_row = projects.require(tx, project, at_least=Role.CONTRIBUTOR if filters.deleted else Role.READER)
    order = listing.parse_order(sort, SORT_KEYS)
    identity = [project_row.id, kind.value, filters.identity]
    conditions = _fast_conditions(tx, project_row.id, filters, kind, order)
    total = None
    if count:
        total = tx.execute(select(func.count()).select_from(item).where(*conditions)).scalar_one()
    rows, next_cursor = listing.read_page(tx, item_rows().where(*conditions), order, identity, cursor, limit)
    return Page(items=tuple(_shown(tx, rows, fields)), next_cursor=next_cursor, count=total)


@dataclass(frozen=True, slots=True)
class Namesakes:
    """Items that have the same name: their number, and the first of them, each as path, id and newest revision."""

    count: int
    first: tuple[tuple[str, str, int], ...]


def find_namesakes(
    tx: Transaction, project: str, kind: Kind, names: Collection[str], *, directly_in: str | None, most: int
) -> dict[str, Namesakes]:
    """Find the items that have one of `names`; return them by name, with at most `most` items for each name.

    Names that no item has are left out. With `directly_in`, only items directly in this folder are found.
    """
    project_row = projects.require(tx, project)
    conditions = conditions_of(project_row.id, ItemFilters(directly_in=directly_in), kind)
    found: dict[str, Namesakes] = {}
    for some in in_lists(sorted(names)):
        ranked = (
            select(
                item.c.name, item.c.id, item.c.head, collection.c.path,
                func.count().over(partition_by=item.c.name).label("namesakes"),
                func.row_number().over(partition_by=item.c.name, order_by=item.c.id).label("place"),
            )
            .join(collection, collection.c.id == item.c.collection_id)
            .where(*conditions, item.c.name.in_(some))
            .subquery()
        )  # fmt: skip
        for row in tx.execute(select(ranked).where(ranked.c.place <= most).order_by(ranked.c.name, ranked.c.place)):
            before = found.get(row.name, Namesakes(row.namesakes, ()))
            path = f"{row.path}/{row.name}".lstrip("/")
            found[row.name] = replace(before, first=(*before.first, (path, row.id, row.head)))
    return found


def _shown(tx: Transaction, rows: Any, fields: Collection[str] | None) -> list[Any]:
    if fields is None:
        return shown_items(tx, rows)
    if unknown := sorted(set(fields) - set(Item.model_fields)):
        raise BadRequestProblem(
            f"An item has no field {unknown[0]!r}; remove it from the parameter `fields`.", code="bad-fields"
        )
    shown = shown_items(tx, rows, **{one: one in fields for one in ("tags", "parts", "facets")})
    return [found.model_dump(mode="json", include=set(fields)) for found in shown]


def _fast_conditions(
    tx: Transaction, project_id: str, filters: ItemFilters, kind: Kind, order: listing.Order
) -> list[ColumnElement[bool]]:
    """Return the conditions of `conditions_of`, in a form that lets the database use an index for the query."""
    if filters.query is None or filters.deleted:
        return conditions_of(project_id, filters, kind)
    few, ordered = narrowing.narrow(tx, project_id, kind, read_query(filters.query, filters.alike))
    if few is None:
        # In other orders, Postgres would find and sort all items with the value, although a page has only a few.
        usable = [] if ordered is None or order.columns[0][0] is not item.c.created_us else [ordered]
        return [*conditions_of(project_id, filters, kind), *usable]
    # The indexes of the orders begin with project and kind. SQLite prefers them, unless these are not plain columns.
    place = [item.c.project_id.concat("") == project_id, item.c.kind.concat("") == kind.value]
    return [few, *place, *_filter_conditions(project_id, filters)]


def conditions_of(project_id: str, filters: ItemFilters, *kinds: Kind) -> list[ColumnElement[bool]]:
    """Return the SQL conditions that the items of the given kinds meet if they match `filters`.

    Raises `BadRequestProblem` if the query of the filters is malformed.
    """
    names = [kind.value for kind in kinds]
    of_kinds = item.c.kind.in_(names) if len(names) > 1 else item.c.kind == names[0]
    return [item.c.project_id == project_id, of_kinds, *_filter_conditions(project_id, filters)]


def _filter_conditions(project_id: str, filters: ItemFilters) -> list[ColumnElement[bool]]:
    """Return the SQL conditions of the filters, without the conditions on the project and the kind."""
    conditions: list[ColumnElement[bool]] = []
    if filters.deleted:
        conditions += [item.c.deleted_us.is_not(None), item.c.purged_us.is_(None)]
    else:
        conditions.append(item.c.deleted_us.is_(None))
    if filters.collection:
        conditions.append(item.c.collection_id.in_(_below(project_id, filters.collection)))
    if filters.directly_in is not None:
        conditions.append(_directly_in(project_id, filters.directly_in, deleted=filters.deleted))
    if filters.path is not None:
        folder, _, name = filters.path.rpartition("/")
        conditions += [_directly_in(project_id, folder, deleted=filters.deleted), item.c.name == name]
    if filters.name is not None:
        conditions += _named(filters.name)
    if filters.tags:
        tagged = select(item_tag.c.item_id).where(item_tag.c.tag.in_(filters.tags))
        conditions.append(item.c.id.in_(tagged))
    if filters.skeleton is not None:
        conditions.append(item.c.skeleton_id == filters.skeleton)
    if filters.clip is not None:
        conditions.append(item.c.summary["clip"].as_string() == filters.clip)
    if filters.frames_gte is not None:
        conditions.append(item.c.frames >= filters.frames_gte)
    if filters.frames_lte is not None:
        conditions.append(item.c.frames <= filters.frames_lte)
    if filters.q:
        conditions.append(item.c.name_folded.contains(filters.q.casefold(), autoescape=True))
    if filters.query is not None:
        conditions.append(sql_of(read_query(filters.query, filters.alike), project_id))
    return conditions


def read_query(text: str, alike: Mapping[str, frozenset[str]] = MappingProxyType({})) -> Query:
    """Parse the text of a query.

    `alike` maps the text of each condition `like(...)` to the ids of the clips that meet it (`ItemFilters.alike`).
    Raises `BadRequestProblem`, with the column of the first fault, if the query is malformed.
    """
    try:
        return with_clips(parse(text), alike)
    except QueryError as error:
        raise BadRequestProblem(str(error), code="bad-query", context={"column": error.column}) from None


def explain_query(tx: Transaction, project: str, kind: Kind, filters: ItemFilters, query: str) -> QueryExplanation:
    """Explain which conditions of a query exclude how many of the items that match `filters`.

    The answer contains the number of all these items, and of those that the query selects. For each condition, it
    contains the number of items that the condition excludes, and of those that no other condition excludes. The
    conditions are the operands of the outermost `and`; a query without an outermost `and` is one condition.
    """
    project_row = projects.require(tx, project)
    parts = parts_of(read_query(query, filters.alike))
    met = [sql_of(part, project_row.id) for part in parts]
    columns: list[ColumnElement[int]] = [func.count(), func.count(case((and_(*met), 1)))]
    for number, one in enumerate(met):
        others = [other for at, other in enumerate(met) if at != number]
        columns += [func.count(case((not_(one), 1))), func.count(case((and_(true(), *others, not_(one)), 1)))]
    conditions = conditions_of(project_row.id, filters, kind)
    counts = tx.execute(select(*columns).select_from(item).where(*conditions)).one()
    total, selected, *hidden = tuple(counts)
    shown = [
        HidingCondition(condition=part.source, hides=hides, alone=alone)
        for part, hides, alone in zip(parts, hidden[::2], hidden[1::2], strict=True)
    ]
    return QueryExplanation(items=total, selected=selected, conditions=tuple(shown))


def _below(project_id: str, path: str) -> Any:
    return select(collection.c.id).where(collection.c.project_id == project_id, collections.at_or_below(path))


def _directly_in(project_id: str, path: str, *, deleted: bool) -> ColumnElement[bool]:
    found = select(collection.c.id).where(collection.c.project_id == project_id, collection.c.path == path)
    if deleted:  # what was deleted may have been in folders of this path that were deleted, too
        return item.c.collection_id.in_(found)
    # Equal to one id, not in a set of ids: so SQLite sees that the index by folder is in the order of names.
    return item.c.collection_id == found.where(collection.c.deleted_us.is_(None)).scalar_subquery()


def _named(name: str) -> list[ColumnElement[bool]]:
    if not name.endswith("*"):
        return [item.c.name == name]
    start = name[:-1]
    return [item.c.name >= start, func.substr(item.c.name, 1, len(start)) == start]
