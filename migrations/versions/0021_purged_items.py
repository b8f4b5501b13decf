"""Items that were purged, and the items to which documents refer."""

from collections.abc import Iterator
from typing import Any

import sqlalchemy as sa
from alembic import op
from sqlalchemy.dialects.postgresql import JSONB

revision = "0021"
down_revision = "0020"
branch_labels = None
depends_on = None

ID = sa.String(40)
DIGEST = sa.String(71)
DOCUMENT = sa.JSON().with_variant(JSONB(), "postgresql")
PURGED = sa.text("purged_us IS NOT NULL")
PAGE = 500

document = sa.table("document", sa.column("digest", DIGEST), sa.column("body", DOCUMENT))


def upgrade() -> None:
    """Add `purged_us` to `item`, create the table `document_item`, and record to which items documents refer.

    This reads each document once.
    """
    op.add_column("item", sa.Column("purged_us", sa.BigInteger(), nullable=True))
    op.create_index("ix_item_purged", "item", ["project_id", "purged_us"], sqlite_where=PURGED, postgresql_where=PURGED)
    references = op.create_table(
        "document_item",
        sa.Column("document_digest", DIGEST, nullable=False),
        sa.Column("item_id", ID, nullable=False),
        sa.ForeignKeyConstraint(
            ["document_digest"], ["document.digest"], name="fk_document_item_document_digest_document"
        ),
        sa.PrimaryKeyConstraint("document_digest", "item_id", name="pk_document_item"),
    )
    connection, behind = op.get_bind(), ""
    page = sa.select(document.c.digest, document.c.body).order_by(document.c.digest).limit(PAGE)
    while rows := connection.execute(page.where(document.c.digest > behind)).all():
        behind = rows[-1].digest
        found = [
            {"document_digest": row.digest, "item_id": item} for row in rows for item in sorted(set(items_in(row.body)))
        ]
        if found:
            connection.execute(sa.insert(references), found)
    op.create_index("ix_document_item_item_id", "document_item", ["item_id"])


def items_in(body: Any) -> Iterator[str]:
    """Yield the ids of the items to which `body`, the body of a document, refers."""
    waiting = [body]
    while waiting:
        one = waiting.pop()
        if isinstance(one, dict):
            item, number = one.get("item"), one.get("revision")
            if isinstance(item, str) and len(item) <= 40 and isinstance(number, int) and not isinstance(number, bool):
                yield item
            if one.get("schema") == "marey/edit@1":
                yield from (command["source"] for command in one["commands"] if "source" in command)
        members = one.values() if isinstance(one, dict) else one
        waiting.extend(member for member in members if isinstance(member, dict | list))


def downgrade() -> None:
    """Drop the table `document_item` and the column `purged_us`.

    Purged items remain without content, and look like deleted items.
    """
    op.drop_table("document_item")
    op.drop_index("ix_item_purged", "item")
    op.drop_column("item", "purged_us")
