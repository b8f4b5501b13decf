"""Reading of items, of their parts, and of the documents of parts."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from sqlalchemy import Row, Select, and_, bindparam, not_, or_, select, type_coerce
from sqlalchemy.types import NullType

from marey_schemas.items import Item, PartPlace, PartSummary
from marey_schemas.kinds import PARTS, Kind
from marey_schemas.sizes import MIB
from marey_server.errors import GoneProblem, InvalidProblem, NotFoundProblem
from marey_server.store import documents, projects
from marey_server.store.database.clock import datetime_of
from marey_server.store.database.prepared import Prepared, padded
from marey_server.store.items.slices import slice_motion
from marey_server.store.jobs import reach
from marey_server.store.projects import ProjectRow
from marey_server.store.tables import collection, document, item, item_facet, item_tag, revision_part
from marey_server.store.transaction import Transaction


def find_contents(tx: Transaction, project: str, kind: Kind, part: str, digests: Collection[str]) -> set[str]:
    """Return the digests, among `digests`, of documents that items of the project contain as their part `part`.

    Only the newest revisions of items of the kind `kind` are searched, without deleted items.
    """
    row = projects.require(tx, project)
    statement = (
        select(revision_part.c.document_digest)
        .join(item, and_(item.c.id == revision_part.c.item_id, item.c.head == revision_part.c.number))
        .where(
            item.c.project_id == row.id,
            item.c.kind == kind.value,
            item.c.deleted_us.is_(None),
            revision_part.c.part == part,
            revision_part.c.document_digest.in_(sorted(digests)),
        )
    )
    return set(tx.execute(statement).scalars())


def read_item(tx: Transaction, project: str, kind: Kind, item_id: str) -> Item:
    """Return an item at its newest revision. Raises `NotFoundProblem` if it does not exist."""
    project_row = projects.require(tx, project)
    if reach.unreachable_items(tx, [item_id]):
        raise no_item(kind, item_id)
    return shown_items(tx, [find_item(tx, project_row, kind, item_id)])[0]


def item_rows() -> Select[*tuple[Any, ...]]:
    """Return a query for the rows of items, each with the path of its collection."""
    return select(item, collection.c.path).join(collection, collection.c.id == item.c.collection_id)


_THIS_ITEM = (
    item.c.id == bindparam("item_id"),
    item.c.project_id == bindparam("project_id"),
    item.c.kind == bindparam("kind"),
)
_ITEM = Prepared(item_rows().where(*_THIS_ITEM, item.c.deleted_us.is_(None)))
_DELETED_ITEM = (
    item_rows()
    .add_columns(collection.c.deleted_us.label("folder_deleted_us"))
    .where(*_THIS_ITEM, item.c.deleted_us.is_not(None))
)
_TAGS = Prepared(
    select(item_tag.c.item_id, item_tag.c.tag).where(item_tag.c.item_id.in_(bindparam("items", expanding=True)))
)
_FACETS = Prepared(  # of which drivers return the values as floats, without a conversion
    select(item_facet.c.item_id, item_facet.c.name, type_coerce(item_facet.c.value, NullType).label("value"))
    .join(item, and_(item.c.id == item_facet.c.item_id, item.c.head == item_facet.c.number))
    .where(item_facet.c.item_id.in_(bindparam("items", expanding=True)))
    .order_by(item_facet.c.item_id, item_facet.c.name)
)
_PARTS = Prepared(
    select(
        revision_part.c.item_id, revision_part.c.number, revision_part.c.part,
        document.c.digest, document.c.schema, document.c.size_bytes,
    )
    .join(document, document.c.digest == revision_part.c.document_digest)
    .where(
        # Not pairs: SQLite would scan the table for them. What this finds beyond them is one row here and there.
        revision_part.c.item_id.in_(bindparam("items", expanding=True)),
        revision_part.c.number.in_(bindparam("numbers", expanding=True)),
    )
)  # fmt: skip
_PART = (
    select(item.c.rev, revision_part.c.number, revision_part.c.document_digest, document.c.size_bytes)
    .join(revision_part, revision_part.c.item_id == item.c.id)
    .join(document, document.c.digest == revision_part.c.document_digest)
    .where(*_THIS_ITEM, revision_part.c.part == bindparam("part"))
)
_NEEDED_DELETED = and_(item.c.kind == Kind.SKELETON.value, item.c.purged_us.is_(None))
"""SQL condition that revisions of a deleted item can be read: it is a skeleton, which clips may still use."""
_PARTS_OF_PROJECT = Prepared(
    select(
        item.c.kind, and_(item.c.deleted_us.is_not(None), not_(_NEEDED_DELETED)).label("is_deleted"),
        revision_part.c.item_id, revision_part.c.number, revision_part.c.part,
        document.c.digest, document.c.size_bytes,
    )
    .join(item, item.c.id == revision_part.c.item_id)
    .join(document, document.c.digest == revision_part.c.document_digest)
    .where(
        item.c.project_id == bindparam("project_id"),
        revision_part.c.item_id.in_(bindparam("items", expanding=True)),
        revision_part.c.number.in_(bindparam("numbers", expanding=True)),
    )
)  # fmt: skip
_PART_OF_HEAD = Prepared(_PART.where(item.c.deleted_us.is_(None), revision_part.c.number == item.c.head))
_PART_OF_REVISION = Prepared(
    _PART.where(or_(item.c.deleted_us.is_(None), _NEEDED_DELETED), revision_part.c.number == bindparam("number"))
)


def find_item(tx: Transaction, project_row: ProjectRow, kind: Kind, item_id: str, *, deleted: bool = False) -> Any:
    """Return the row of an item; with `deleted`, the row of a deleted item.

    Raises `NotFoundProblem` if the project has no such item of this kind. With `deleted`, raises `GoneProblem` if the
    item was purged.
    """
    which = {"item_id": item_id, "project_id": project_row.id, "kind": kind.value}
    row = tx.execute(_DELETED_ITEM, which).one_or_none() if deleted else tx.first(_ITEM, which)
    if row is None:
        raise no_item(kind, item_id)
    if row.purged_us is not None:
        raise was_purged(kind, item_id, row.purged_us)
    return row


def no_item(kind: Kind, item_id: str) -> NotFoundProblem:
    """Return the error for an item that does not exist."""
    return NotFoundProblem(f"There is no {kind} {item_id!r} in this project.", code="no-item")


def was_purged(kind: Kind, item_id: str, purged_us: int) -> GoneProblem:
    """Return the error for an item that cannot be restored, because it was purged."""
    at = f"{datetime_of(purged_us):%Y-%m-%d %H:%M} UTC"
    return GoneProblem(
        f"The {kind} {item_id!r} was purged on {at}: its content was deleted for good, and nothing can restore it.",
        code="purged",
    )


def shown_items(
    tx: Transaction, rows: Sequence[Row[Any]], *, tags: bool = True, parts: bool = True, facets: bool = True
) -> list[Item]:
    """Return items as documents; one query each reads the tags, the parts and the facets of all items."""
    ids = {"items": [row.id for row in rows]}
    runs = {
        "tags": (_TAGS, ids),
        "parts": (_PARTS, _keys_of([(row.id, row.head) for row in rows])),
        "facets": (_FACETS, ids),
    }
    asked = [name for name, wanted in (("tags", tags), ("parts", parts), ("facets", facets)) if wanted and rows]
    found = dict(zip(asked, tx.run_together(*(runs[name] for name in asked)), strict=True))
    tags_of, parts_of, facets_of = (
        _tags(found.get("tags", ())), _parts(found.get("parts", ())), _facets(found.get("facets", ()))
    )  # fmt: skip
    return [
        Item(
            id=row.id, kind=Kind(row.kind), name=row.name, collection=row.path, tags=tags_of.get(row.id, ()),
            revision=row.head, parts=parts_of.get((row.id, row.head), {}), summary=row.summary,
            facets=facets_of.get(row.id, {}),
            created_at=datetime_of(row.created_us), updated_at=datetime_of(row.updated_us),
            deleted_at=None if row.deleted_us is None else datetime_of(row.deleted_us), rev=row.rev,
        )
        for row in rows
    ]  # fmt: skip


def _tags(rows: Iterable[Any]) -> dict[str, tuple[str, ...]]:
    """Return the sorted tags of each item."""
    found: dict[str, list[str]] = {}
    for row in rows:
        found.setdefault(row.item_id, []).append(row.tag)
    return {item_id: tuple(sorted(tags)) for item_id, tags in found.items()}


def _facets(rows: Iterable[Any]) -> dict[str, dict[str, float]]:
    """Return the facets of each item, sorted by name."""
    found: dict[str, dict[str, float]] = {}
    for row in rows:
        found.setdefault(row.item_id, {})[row.name] = row.value
    return found


def read_parts(
    tx: Transaction, revisions: Collection[tuple[str, int]]
) -> dict[tuple[str, int], dict[str, PartSummary]]:
    """Return the parts of the given revisions, by item id and revision number, then by name of the part.

    The result may contain further revisions of the same items. Revisions that do not exist are left out.
    """
    return _parts(tx.run(_PARTS, _keys_of(revisions)))


def _keys_of(revisions: Collection[tuple[str, int]]) -> dict[str, list[Any]]:
    return {"items": list({item_id for item_id, _ in revisions}), "numbers": list({number for _, number in revisions})}


def _parts(rows: Iterable[Any]) -> dict[tuple[str, int], dict[str, PartSummary]]:
    found: dict[tuple[str, int], dict[str, PartSummary]] = {}
    for row in rows:
        summary = PartSummary(document=row.digest, schema_=row.schema, size_bytes=row.size_bytes)
        found.setdefault((row.item_id, row.number), {})[row.part] = summary
    return found


@dataclass(frozen=True, slots=True)
class FoundPart:
    """Part of a revision that the caller may read."""

    digest: str
    revision: int
    rev: int
    """The `rev` of the item; a request that changes the newest revision must name this `rev`."""
    size_bytes: int
    """Size of the stored document."""


def find_part(
    tx: Transaction, project: str, kind: Kind, item_id: str, part: str, *, revision: int | None = None
) -> FoundPart:
    """Return a part of an item at the given revision, by default the newest one.

    With `revision`, parts of deleted skeletons are found, too. Raises `NotFoundProblem` if there is no such part.
    """
    project_row = projects.require(tx, project)
    which = {"item_id": item_id, "project_id": project_row.id, "kind": kind.value, "part": part}
    if revision is None:
        row = tx.first(_PART_OF_HEAD, which)
    else:
        row = tx.first(_PART_OF_REVISION, {**which, "number": revision})
    if row is None:
        newest = None if revision is None else tx.first(_PART_OF_HEAD, which)
        if newest is not None and revision is not None and revision > newest.number:
            detail = f"The {kind} {item_id!r} has no revision {revision}; the newest one is {newest.number}."
        elif tx.first(_ITEM, {name: which[name] for name in ("item_id", "project_id", "kind")}) is None:
            raise no_item(kind, item_id)
        else:
            detail = (
                f"The {kind} {item_id!r} has no part {part!r} at the requested revision; a {kind} can have the parts "
                f"{', '.join(PARTS[kind])}."
            )
        raise NotFoundProblem(detail, code="no-part")
    return FoundPart(row.document_digest, row.number, row.rev, row.size_bytes)


def load_part(
    tx: Transaction, found: FoundPart, *, arrays: Literal["encoded", "decoded", "none"] = "encoded"
) -> dict[str, Any]:
    """Load the document of a part; `arrays` says whether its arrays are encoded, decoded (numpy) or references."""
    return documents.load_document(tx, found.digest, arrays=arrays)


def cut_part(
    tree: dict[str, Any], frames: slice | None, joints: Sequence[str] | None, *, encoded: bool
) -> dict[str, Any]:
    """Cut a motion to the given frames and joints; its arrays must be encoded, and stay encoded if `encoded` is true.

    `frames` is half-open and clipped to the motion; `joints` are names, in the order of the result. Raises
    `InvalidProblem` if the document is not a motion or has no such frames or joints.
    """
    if tree["schema"] != "marey/motion@1":
        raise InvalidProblem(
            "The parameters `frames` and `joints` select parts of a motion, but this document is not a motion.",
            code="not-a-motion",
        )
    return slice_motion(tree, frames, joints, encoded=encoded)


@dataclass(frozen=True, slots=True)
class Part(FoundPart):
    """Part of a revision with its document."""

    tree: dict[str, Any]


def read_part(
    tx: Transaction,
    project: str,
    kind: Kind,
    item_id: str,
    part: str,
    *,
    revision: int | None = None,
    arrays: Literal["encoded", "decoded", "none"] = "encoded",
) -> Part:
    """Find a part of an item and load its whole document."""
    found = find_part(tx, project, kind, item_id, part, revision=revision)
    tree = load_part(tx, found, arrays=arrays)
    return Part(found.digest, found.revision, found.rev, found.size_bytes, tree)


MOST_BYTES_AT_ONCE = 12 * MIB
"""Greatest total size in bytes of the documents in one answer; the first document may be larger.

The documents, the request and the encoded answer together fit into the memory that the server gives to one unknown
client (`process/memory.py`).
"""


@dataclass(frozen=True, slots=True)
class LoadedParts:
    """Documents of several parts in the order of a request, None for a missing part, and their total size in bytes."""

    documents: list[dict[str, Any] | None]
    size_bytes: int


def load_parts(tx: Transaction, project: str, wanted: Sequence[PartPlace]) -> LoadedParts:
    """Load the documents of parts with encoded arrays, in the order of the request; None for a missing part.

    The parts of deleted items count as missing, with two exceptions. Parts of deleted skeletons are loaded, because
    revisions of clips may use them. An attempt of a job can load parts of its inputs, because a version of a dataset
    may contain items that were deleted later.

    The list ends before the first document with which all documents would have more than `MOST_BYTES_AT_ONCE`. The
    first document is always loaded.
    """
    project_row = projects.require(tx, project)
    keys = {
        "items": padded({place.item for place in wanted}),
        "numbers": padded({place.revision for place in wanted}),
    }
    rows = tx.run(_PARTS_OF_PROJECT, {"project_id": project_row.id, **keys})
    refused = reach.unreachable_places(tx, {(row.item_id, row.number) for row in rows})
    refused |= {(row.item_id, row.number) for row in rows if row.is_deleted} - reach.pinned_places(tx)
    found = {
        (row.kind, row.item_id, row.number, row.part): row for row in rows if (row.item_id, row.number) not in refused
    }
    chosen: list[str | None] = []
    size_bytes = 0
    for place in wanted:
        row = found.get((place.kind.value, place.item, place.revision, place.part))
        more_bytes = row.size_bytes if row is not None else 0
        if chosen and size_bytes + more_bytes > MOST_BYTES_AT_ONCE:
            break
        size_bytes += more_bytes
        chosen.append(None if row is None else row.digest)
    loaded = documents.load_documents(tx, {digest for digest in chosen if digest is not None})
    return LoadedParts([None if digest is None else loaded[digest] for digest in chosen], size_bytes)
