"""Rows of revisions, and the reference of an item to its newest revision."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from sqlalchemy import ColumnElement, insert, select, update

from marey_schemas.items import Item
from marey_schemas.kinds import Kind
from marey_server.store.documents import load_body
from marey_server.store.items.summaries import summarise
from marey_server.store.projects import ProjectRow
from marey_server.store.tables import item, revision, revision_part
from marey_server.store.transaction import Transaction


def read_part_digests(tx: Transaction, item_id: str, number: int) -> dict[str, str]:
    """Return the digest of the document of each part of a revision."""
    statement = select(revision_part.c.part, revision_part.c.document_digest).where(
        revision_part.c.item_id == item_id, revision_part.c.number == number
    )
    return {row.part: row.document_digest for row in tx.execute(statement)}


def write_head(
    tx: Transaction,
    kind: Kind,
    item_id: str,
    parts: Mapping[str, str],
    bodies: Mapping[str, dict[str, Any]],
    *conditions: ColumnElement[bool],
) -> bool:
    """Set the item's newest revision to the next one; return false if the item does not meet `conditions`.

    `bodies` may omit parts that do not change.
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
        )
    )  # fmt: skip
    return tx.execute(statement).rowcount == 1


def write_revision(
    tx: Transaction,
    item_id: str,
    number: int,
    parts: Mapping[str, str],
    author_id: str | None,
    message: str,
    job_id: str | None,
) -> None:
    """Insert a revision and its parts."""
    row = {"item_id": item_id, "number": number, "author_id": author_id, "message": message, "job_id": job_id}
    tx.execute(insert(revision), row | {"created_us": tx.now_us})
    tx.execute(
        insert(revision_part),
        [
            {"item_id": item_id, "number": number, "part": part, "document_digest": digest}
            for part, digest in parts.items()
        ],
    )


def emit_item(tx: Transaction, event: str, project_row: ProjectRow, subject: Item, **body: Any) -> None:
    """Record an event about an item."""
    tx.emit(
        event, subject.id, project_id=project_row.id, item_kind=subject.kind.value, name=subject.name,
        collection=subject.collection, **body,
    )  # fmt: skip
