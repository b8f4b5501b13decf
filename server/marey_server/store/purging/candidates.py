"""Choice of the deleted items that a request for a purge names, and the searches that precede the purge."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from sqlalchemy import Row, and_, select

from marey_schemas.kinds import Kind
from marey_schemas.purges import MOST_PURGED, PurgeRequest
from marey_server.errors import BadRequestProblem
from marey_server.store import projects
from marey_server.store.database.clock import DAY_US
from marey_server.store.items.listing import ItemFilters, conditions_of
from marey_server.store.items.reading import item_rows
from marey_server.store.projects import ProjectRow
from marey_server.store.purging.index_copies import IndexSearch
from marey_server.store.purging.versions import VersionSearch
from marey_server.store.tables import item, revision, revision_part
from marey_server.store.transaction import Transaction

MOST_REVISIONS = 20_000
"""Greatest number of revisions that one request purges; a single item may have more."""

_ORDER = (
    Kind.RECORD, Kind.INDEX, Kind.STUDY, Kind.METRIC, Kind.CHARACTER, Kind.EVALUATION, Kind.GRAPH, Kind.EDIT,
    Kind.ANNOTATION, Kind.MODEL, Kind.PROCESSED, Kind.CLIP, Kind.SKELETON,
)  # fmt: skip
"""Kinds of items in the order of a purge.

The documents of an item refer only to items of kinds that are later in this order. So an item is purged before the
items to which it refers, and does not prevent their purge.
"""
assert set(_ORDER) == set(Kind), "every kind needs a place in the order of a purge"


@dataclass(frozen=True)
class PreparedPurge:
    """Items that a request may purge, with a search for dataset versions and one for indexes that contain them."""

    ids: tuple[str, ...]
    search: VersionSearch
    copies: IndexSearch
    next: str | None = None
    """Id of the last item in `ids`, after which the next request continues; None if no items remain."""


def prepare_purge(tx: Transaction, project: str, request: PurgeRequest) -> PreparedPurge:
    """Choose the next items of a purge, and search all versions and indexes of motions of the project for them.

    Raises `BadRequestProblem` for a malformed query, and `ForbiddenProblem` if the caller lacks the scope `read`.
    """
    project_row = projects.require(tx, project)
    projects.require_scope(tx, project, "read")  # because the answer shows names
    rows = _candidates(tx, project_row, request)
    chosen: list[Row[Any]] = []
    left = MOST_REVISIONS
    for row in rows[:MOST_PURGED]:
        left -= row.head
        if chosen and left < 0:
            break
        chosen.append(row)
    ids = tuple(row.id for row in chosen)
    copies = IndexSearch(project_row.id, (row.id for row in chosen if row.kind == Kind.CLIP.value))
    _, parts = contents_of(tx, (*ids, *copies.update(tx)))
    search = VersionSearch(project_row.id, parts)
    search.update(tx)
    return PreparedPurge(ids, search, copies, ids[-1] if len(rows) > len(chosen) else None)


def _candidates(tx: Transaction, project_row: ProjectRow, request: PurgeRequest) -> list[Row[Any]]:
    """Return the next deleted items that a request selects: at most `MOST_PURGED`, and one more if any remain."""
    filters = ItemFilters(collection=request.collection or None, path=request.path, query=request.query, deleted=True)
    last = None if request.after is None else _kind_of(request.after)
    rows: list[Row[Any]] = []
    for kind in _ORDER if last is None else _ORDER[_ORDER.index(last) :]:
        if request.kind not in (None, kind):
            continue
        statement = item_rows().where(*conditions_of(project_row.id, filters, kind))
        if request.item is not None:
            statement = statement.where(item.c.id == request.item)
        if request.older_than_days is not None:
            statement = statement.where(item.c.deleted_us <= tx.now_us - request.older_than_days * DAY_US)
        if kind is last:
            statement = statement.where(item.c.id < request.after)
        rows += tx.execute(statement.order_by(item.c.id.desc()).limit(MOST_PURGED + 1 - len(rows))).all()
        if len(rows) > MOST_PURGED:
            break
    return rows


def _kind_of(last: str) -> Kind:
    """Return the kind of the item with the id `last`, which the previous request returned as `next`.

    Raises `BadRequestProblem` if `last` does not begin with a kind.
    """
    try:
        return Kind(last.partition("_")[0])
    except ValueError:
        raise BadRequestProblem(
            f"`after` is {last!r}, but must be the value of `next` in the last answer.", code="bad-cursor"
        ) from None


def contents_of(tx: Transaction, ids: Sequence[str]) -> tuple[dict[str, frozenset[str]], dict[str, frozenset[str]]]:
    """Return the content digests of each item's revisions, and the content digests of the parts of each revision.

    The first mapping has the ids of the items as keys, the second the content digests of the revisions. A content
    digest is computed when a commit first needs it; revisions without one are left out.
    """
    of_revision = and_(revision_part.c.item_id == revision.c.item_id, revision_part.c.number == revision.c.number)
    statement = (
        select(revision.c.item_id, revision.c.content, revision_part.c.content.label("other"))
        .add_columns(revision_part.c.document_digest)
        .join(revision_part, of_revision)
        .where(revision.c.item_id.in_(ids), revision.c.content.is_not(None))
    )
    contents: dict[str, set[str]] = {}
    parts: dict[str, set[str]] = {}
    for row in tx.execute(statement) if ids else ():
        contents.setdefault(row.item_id, set()).add(row.content)
        parts.setdefault(row.content, set()).add(row.other or row.document_digest)
    return (
        {item_id: frozenset(found) for item_id, found in contents.items()},
        {content: frozenset(found) for content, found in parts.items()},
    )
