"""History of an item: its revisions, their lineage, and whether their inputs have newer revisions."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any

from sqlalchemy import ColumnElement, Row, Select, and_, exists, func, select, tuple_

from marey_schemas.documents.skeleton_merges import SKELETON_MERGE
from marey_schemas.items import Lineage, LineageEdge, Page, Revision, Staleness
from marey_schemas.kinds import Kind
from marey_schemas.lineage import MERGED, RESTORED
from marey_schemas.tracing.context import HEADER
from marey_server.errors import NotFoundProblem
from marey_server.store import listing, projects
from marey_server.store.database.clock import datetime_of
from marey_server.store.items.listing import ItemFilters, list_items
from marey_server.store.items.reading import find_item, read_parts
from marey_server.store.tables import item, job, lineage, project, revision, user
from marey_server.store.transaction import Transaction, in_lists

MAX_EDGES = 1000


def list_revisions(
    tx: Transaction,
    project_name: str,
    kind: Kind,
    item_id: str,
    *,
    cursor: str | None = None,
    limit: int = listing.DEFAULT_LIMIT,
) -> Page:
    """List the revisions of an item, newest first."""
    find_item(tx, projects.require(tx, project_name), kind, item_id)
    order = listing.parse_order("-number", {"number": revision.c.number}, unique="number")
    statement = _revision_rows().where(revision.c.item_id == item_id)
    rows, next_cursor = listing.read_page(tx, statement, order, ["revisions", item_id], cursor, limit)
    return Page(items=tuple(_shown(tx, rows)), next_cursor=next_cursor)


def read_revision(tx: Transaction, project_name: str, kind: Kind, item_id: str, number: int) -> Revision:
    """Return one revision of an item."""
    find_item(tx, projects.require(tx, project_name), kind, item_id)
    return _shown(tx, [find_revision(tx, item_id, number)])[0]


def _revision_rows() -> Select[*tuple[Any, ...]]:
    return select(revision, user.c.name.label("author")).outerjoin(user, user.c.id == revision.c.author_id)


def find_revision(tx: Transaction, item_id: str, number: int) -> Row[Any]:
    row = tx.execute(_revision_rows().where(revision.c.item_id == item_id, revision.c.number == number)).first()
    if row is None:
        newest = tx.execute(select(func.max(revision.c.number)).where(revision.c.item_id == item_id)).scalar()
        raise no_revision(item_id, number, newest)
    return row


def no_revision(item_id: str, number: int, newest: int | None = None) -> NotFoundProblem:
    """Return the error for a revision that does not exist; `newest` is the number of the newest one, if known."""
    hint = "" if newest is None else f"; the newest is revision {newest}"
    return NotFoundProblem(f"The item {item_id!r} has no revision {number}{hint}.", code="no-revision")


def _shown(tx: Transaction, rows: Collection[Row[Any]]) -> list[Revision]:
    parts = read_parts(tx, [(row.item_id, row.number) for row in rows]) if rows else {}
    return [
        Revision(
            item=row.item_id, revision=row.number, author=row.author, message=row.message, job=row.job_id,
            created_at=datetime_of(row.created_us), parts=parts.get((row.item_id, row.number), {}),
        )
        for row in rows
    ]  # fmt: skip


def read_lineage(
    tx: Transaction, project_name: str, kind: Kind, item_id: str, *, revision_number: int | None = None
) -> Lineage:
    """Return the inputs of a revision, the job that created it, and the revisions that were made from it.

    If `revision_number` is None, this is the newest revision. Items that the caller may not see are left out.
    """
    found = find_item(tx, projects.require(tx, project_name), kind, item_id)
    number = revision_number or found.head
    made = find_revision(tx, item_id, number)
    how = None if made.job_id is None else tx.execute(select(job).where(job.c.id == made.job_id)).first()
    source = and_(lineage.c.item_id == item_id, lineage.c.number == number)
    inputs = _edges(tx, lineage.c.input_item_id, lineage.c.input_number, source)
    target = and_(lineage.c.input_item_id == item_id, lineage.c.input_number == number)
    outputs = _edges(tx, lineage.c.item_id, lineage.c.number, target)
    return Lineage(
        item=item_id, revision=number, inputs=inputs, outputs=outputs,
        job_kind=how.kind if how else None, params=how.params if how else None, seed=how.seed if how else None,
        code_version=how.code_version if how else None, environment=_versions(how.environment) if how else {},
    )  # fmt: skip


def _versions(environment: Mapping[str, str] | None) -> dict[str, str]:
    """Return the versions of libraries from the environment of a job, without its trace header."""
    return {name: text for name, text in (environment or {}).items() if name != HEADER}


def _edges(tx: Transaction, other: Any, number: Any, condition: Any) -> tuple[LineageEdge, ...]:
    """Return at most `MAX_EDGES` revisions that are named in the rows of `lineage` that meet `condition`.

    A row names two revisions: an input and a result. `other` and `number` are the two columns, item id and revision
    number, of the revision that is returned. Revisions in projects that the caller may not see are left out.
    """
    statement = (
        select(other.label("item"), number.label("revision"), item.c.kind, item.c.name)
        .add_columns(item.c.purged_us.is_not(None).label("purged"))
        .add_columns(lineage.c.job_id.label("job"), lineage.c.role)
        .join(item, item.c.id == other)
        .join(project, project.c.id == item.c.project_id)
        .where(condition, projects.is_visible(tx.principal))
        .order_by(lineage.c.role, lineage.c.position, other, number)
        .limit(MAX_EDGES)
    )
    return tuple(LineageEdge(**row._asdict()) for row in tx.execute(statement))


def _has_newer_content(item_id: Any, number: Any) -> ColumnElement[bool]:
    """Return the SQL condition that an item has a revision after `number` that no merge of skeletons made."""
    later, merge = revision.alias("later"), lineage.alias("merge")
    is_merge = and_(
        merge.c.item_id == later.c.item_id, merge.c.number == later.c.number, merge.c.role == SKELETON_MERGE
    )
    return exists().where(later.c.item_id == item_id, later.c.number > number, ~exists().where(is_merge))


def list_staleness(
    tx: Transaction,
    project_name: str,
    kind: Kind,
    filters: ItemFilters,
    *,
    cursor: str | None = None,
    limit: int = listing.DEFAULT_LIMIT,
) -> Page:
    """List the items of a kind that have an input with a newer revision, in the order of the names of the items.

    See `read_staleness` for the inputs that count. A page examines `limit` items, so it may list fewer, even none.
    """
    examined = list_items(
        tx, project_name, kind, filters, sort="name", cursor=cursor, limit=limit, fields=("id", "revision")
    )
    heads = [(one["id"], one["revision"]) for one in examined.items]
    made = _with_inputs(tx, [item_id for item_id, _ in heads])
    found = (_staleness(tx, item_id, head) for item_id, head in heads if item_id in made)
    return Page(items=tuple(one for one in found if one.stale), next_cursor=examined.next_cursor)


def _with_inputs(tx: Transaction, items: Collection[str]) -> set[str]:
    """Return the items that have a revision with inputs; only such items can be outdated."""
    found: set[str] = set()
    for some in in_lists(sorted(items)):
        found.update(tx.execute(select(lineage.c.item_id).where(lineage.c.item_id.in_(some)).distinct()).scalars())
    return found


def read_staleness(tx: Transaction, project_name: str, kind: Kind, item_id: str) -> Staleness:
    """Return whether a direct or indirect input of the newest revision has a newer revision.

    An earlier revision of an item can be an input of the same item: the tree of a model is computed from its previous
    revision. Such an input does not count as outdated, but its own inputs are examined. The same holds for a revision
    whose content was only taken over, by a merge, a checkout or a revert. Revisions that a merge of skeletons made do
    not count as newer, because the motion is the same.
    """
    found = find_item(tx, projects.require(tx, project_name), kind, item_id)
    return _staleness(tx, item_id, found.head)


def _staleness(tx: Transaction, item_id: str, head: int) -> Staleness:
    ancestry = (
        select(revision.c.item_id, revision.c.number)
        .where(revision.c.item_id == item_id, revision.c.number == head)
        .cte("ancestry", recursive=True)
    )
    made_from = and_(lineage.c.item_id == ancestry.c.item_id, lineage.c.number == ancestry.c.number)
    ancestry = ancestry.union(select(lineage.c.input_item_id, lineage.c.input_number).join(ancestry, made_from))
    outdated = and_(
        tuple_(lineage.c.item_id, lineage.c.number).in_(select(ancestry.c.item_id, ancestry.c.number)),
        lineage.c.input_item_id != lineage.c.item_id,
        lineage.c.role.not_in((MERGED, RESTORED)),
        item.c.head > lineage.c.input_number,
        _has_newer_content(lineage.c.input_item_id, lineage.c.input_number),
    )
    newer = select(lineage.c.item_id).join(item, item.c.id == lineage.c.input_item_id).where(outdated)
    stale = tx.execute(newer.limit(1)).first() is not None
    because = _edges(tx, lineage.c.input_item_id, lineage.c.input_number, outdated) if stale else ()
    return Staleness(item=item_id, revision=head, stale=stale, because=because)
