"""Content digests of revisions; equal content has the same digest on every server.

A digest is computed when a commit first needs it, and stored with the revision.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

from sqlalchemy import ColumnElement, and_, bindparam, select, update

from marey_server.store.tables import document, item, revision, revision_part
from marey_server.store.transaction import Transaction, in_lists
from marey_versions.records import RevisionKey, document_content, references_in, revision_content


@dataclass
class Contents:
    """Content digests of revisions (`revisions`) and of their parts by name (`parts`)."""

    revisions: dict[RevisionKey, str] = field(default_factory=dict)
    parts: dict[RevisionKey, dict[str, str]] = field(default_factory=dict)
    computed: dict[RevisionKey, dict[str, str]] = field(default_factory=dict)
    """Content digests of parts that are not stored yet: by revision, then by name of the part."""


def find_contents_of(tx: Transaction, project_id: str, wanted: Iterable[RevisionKey]) -> Contents:
    """Return the content digests of the wanted revisions of a project, and of the revisions to which they refer.

    Revisions that do not exist or belong to other projects are left out. Missing digests are computed.
    """
    found = Contents()
    waiting: dict[RevisionKey, _Waiting] = {}
    further = set(wanted)
    while further:
        read = _read(tx, project_id, sorted(further), found)
        waiting |= read
        referred = {reference for one in read.values() for reference in one.references}
        further = referred - waiting.keys() - found.revisions.keys() - further
    for reference in _in_order(waiting):
        _compute(found, reference, waiting[reference])
    return found


def _in_order(waiting: Mapping[RevisionKey, _Waiting]) -> list[RevisionKey]:
    """Return the keys of revisions in an order in which each comes after the revisions that it refers to.

    If references form a circle, the order inside the circle is arbitrary.
    """
    ordered: dict[RevisionKey, None] = {}
    entered: set[RevisionKey] = set()
    path = list(waiting)
    while path:
        one = path[-1]
        if one in entered:
            ordered[path.pop()] = None
        else:
            entered.add(one)
            path += [other for other in sorted(waiting[one].references) if other in waiting and other not in entered]
    return list(ordered)


@dataclass
class _Waiting:
    """Revision whose content digest is not stored yet."""

    kind: str
    parts: Mapping[str, str]
    """Digest of the document of each part."""
    bodies: Mapping[str, Any]

    @cached_property
    def references(self) -> set[RevisionKey]:
        """The revisions that the documents refer to."""
        return {reference for body in self.bodies.values() for reference in references_in(body)}


def _read(
    tx: Transaction, project_id: str, wanted: Sequence[RevisionKey], found: Contents
) -> dict[RevisionKey, _Waiting]:
    """Add the stored digests of the wanted revisions to `found`, and return the revisions without a stored digest.

    Only revisions of the project are read. Anybody can write a reference to a revision of another project into free
    members of a document. The digest of this revision would show whether the revision exists and what it contains.
    """
    waiting: dict[RevisionKey, _Waiting] = {}
    for some in map(set, in_lists(wanted)):
        rows = [
            row
            for row in tx.execute(_PARTS.where(*_among(some)))
            if row.project_id == project_id and RevisionKey(row.item_id, row.number) in some
        ]
        lacking = {row.document_digest for row in rows if row.of_revision is None}
        bodies = bodies_of(tx, lacking)
        by_revision: dict[RevisionKey, list[Any]] = {}
        for row in rows:
            by_revision.setdefault(RevisionKey(row.item_id, row.number), []).append(row)
        for reference, parts in by_revision.items():
            if parts[0].of_revision is None:
                digests = {row.part: row.document_digest for row in parts}
                waiting[reference] = _Waiting(
                    parts[0].kind, digests, {part: bodies[digest] for part, digest in digests.items()}
                )
            else:
                found.revisions[reference] = parts[0].of_revision
                found.parts[reference] = {row.part: row.content or row.document_digest for row in parts}
    return waiting


_PARTS = (
    select(
        revision_part.c.item_id,
        revision_part.c.number,
        revision_part.c.part,
        revision_part.c.document_digest,
        revision_part.c.content,
        revision.c.content.label("of_revision"),
        item.c.kind,
        item.c.project_id,
    )
    .join(revision, and_(revision.c.item_id == revision_part.c.item_id, revision.c.number == revision_part.c.number))
    .join(item, item.c.id == revision_part.c.item_id)
)


def _among(wanted: Collection[RevisionKey]) -> tuple[ColumnElement[bool], ...]:
    """Return SQL conditions that the parts of all wanted revisions meet, and perhaps parts of other revisions.

    Ids and numbers are compared separately, because SQLite would scan the whole table to compare pairs. So parts of
    other revisions can meet the conditions, too, if their id and their number each occur in `wanted`. Callers skip such
    parts. Callers also compare the project themselves: with a condition on the project, SQLite would scan all its
    items.
    """
    ids, numbers = {one.item for one in wanted}, {one.revision for one in wanted}
    return revision_part.c.item_id.in_(sorted(ids)), revision_part.c.number.in_(sorted(numbers))


def bodies_of(tx: Transaction, digests: Collection[str]) -> dict[str, Any]:
    """Return the bodies of documents by digest; a body contains references in place of arrays."""
    rows = tx.execute(select(document.c.digest, document.c.body).where(document.c.digest.in_(sorted(digests))))
    return {row.digest: row.body for row in rows}


def _compute(found: Contents, reference: RevisionKey, waiting: _Waiting) -> None:
    parts = {
        part: document_content(body, found.revisions.get) if waiting.references else digest
        for (part, digest), body in zip(waiting.parts.items(), waiting.bodies.values(), strict=True)
    }
    found.parts[reference] = parts
    found.computed[reference] = {part: content for part, content in parts.items() if content != waiting.parts[part]}
    found.revisions[reference] = revision_content(waiting.kind, parts)


def store_contents(tx: Transaction, contents: Contents) -> None:
    """Store the digests that were computed. Storing them again has no effect."""
    of_revisions = [
        {"id": one.item, "at": one.revision, "digest": contents.revisions[one]} for one in contents.computed
    ]
    of_parts = [
        {"id": one.item, "at": one.revision, "of": part, "digest": digest}
        for one, parts in contents.computed.items()
        for part, digest in parts.items()
    ]
    if of_revisions:
        tx.execute(_SET_OF_REVISION, of_revisions)
    if of_parts:
        tx.execute(_SET_OF_PART, of_parts)


_SET_OF_REVISION = (
    update(revision)
    .where(revision.c.item_id == bindparam("id"), revision.c.number == bindparam("at"))
    .values(content=bindparam("digest"))
)
_SET_OF_PART = (
    update(revision_part)
    .where(
        revision_part.c.item_id == bindparam("id"),
        revision_part.c.number == bindparam("at"),
        revision_part.c.part == bindparam("of"),
    )
    .values(content=bindparam("digest"))
)
