"""Writes revisions, and updates which revision is the newest of its item."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from sqlalchemy import ColumnElement, insert, select, update

from marey_schemas.items import Item
from marey_schemas.kinds import Kind
from marey_server.store.documents import load_body
from marey_server.store.items.summaries import summarise
from marey_server.store.projects import ProjectRow
from marey_server.store.tables import item, revision, revision_part
from marey_server.store.transaction import Transaction, in_lists
from marey_versions.records import RevisionKey


def read_part_digests(tx: Transaction, revisions: Collection[tuple[str, int]]) -> dict[tuple[str, int], dict[str, str]]:
    """Return, for each of the given revisions (item id and number), the digests of its documents by name of the part.

    A revision that does not exist has an empty mapping.
    """
    found: dict[tuple[str, int], dict[str, str]] = {one: {} for one in revisions}
    for some in in_lists(sorted(found)):
        ids, numbers = {item_id for item_id, _ in some}, {number for _, number in some}
        # Not pairs: SQLite would scan the table for them. What this finds beyond them is one row here and there.
        chosen = (revision_part.c.item_id.in_(sorted(ids)), revision_part.c.number.in_(sorted(numbers)))
        for row in tx.execute(select(revision_part).where(*chosen)):
            if (row.item_id, row.number) in found:
                found[row.item_id, row.number][row.part] = row.document_digest
    return found


def write_head(
    tx: Transaction,
    kind: Kind,
    item_id: str,
    parts: Mapping[str, str],
    bodies: Mapping[str, dict[str, Any]],
    *conditions: ColumnElement[bool],
    added_bytes: int,
) -> bool:
    """Increase the number of the item's newest revision by one, and update the summary of the item.

    Returns false, and changes nothing, if the item is deleted or does not meet `conditions`. `parts` are the digests of
    the new revision's parts, by name. `bodies` are the documents of these parts; documents of unchanged parts may be
    omitted. `added_bytes` is the size of the changed parts, which counts towards quotas.
    """
    known = dict(bodies)
    for part, digest in parts.items():
        if part not in known:
            known[part] = load_body(tx, digest)
    summary = summarise(kind, known)
    statement = (
        update(item)
        .where(item.c.id == item_id, item.c.deleted_us.is_(None), *conditions)
        .values(
            head=item.c.head + 1, rev=item.c.rev + 1, updated_us=tx.now_us,
            summary=summary.shown, frames=summary.frames, skeleton_id=summary.skeleton_id,
            stored_bytes=item.c.stored_bytes + added_bytes,
        )
    )  # fmt: skip
    return tx.execute(statement).rowcount == 1


@dataclass(frozen=True, slots=True)
class NewRevision:
    """Revision to insert; `parts` maps the name of each part to the digest of its document."""

    item_id: str
    number: int
    parts: Mapping[str, str]
    message: str


class StoredContent(NamedTuple):
    """Revision that exists, and the digests of its documents by the name of the part."""

    key: RevisionKey
    parts: Mapping[str, str]


def write_revisions(
    tx: Transaction, revisions: Sequence[NewRevision], *, author_id: str | None, job_id: str | None
) -> None:
    """Insert revisions and their parts."""
    common = {"author_id": author_id, "job_id": job_id, "created_us": tx.now_us}
    rows = [{"item_id": one.item_id, "number": one.number, "message": one.message, **common} for one in revisions]
    tx.execute(insert(revision), rows)
    tx.execute(
        insert(revision_part),
        [
            {"item_id": one.item_id, "number": one.number, "part": part, "document_digest": digest}
            for one in revisions
            for part, digest in one.parts.items()
        ],
    )


def event_of_item(project_row: ProjectRow, subject: Item) -> dict[str, Any]:
    """Return the values that events about an item have in common, as arguments of `Transaction.emit` and `audit`."""
    return {
        "subject": subject.id, "project_id": project_row.id, "item_kind": subject.kind.value, "name": subject.name,
        "collection": subject.collection,
    }  # fmt: skip
