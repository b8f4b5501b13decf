"""Take records in the summaries of clips, for lists and queries."""

import sqlalchemy as sa
from alembic import op
from sqlalchemy.dialects.postgresql import JSONB

revision = "0016"
down_revision = "0015"
branch_labels = None
depends_on = None

DOCUMENT = sa.JSON().with_variant(JSONB(), "postgresql")
RECORDED = ("subject", "action", "licence", "capture_system")
"""Fields of a take record that descriptions of clips already had before this revision."""
BATCH = 1000

ITEM = sa.table("item", sa.column("id"), sa.column("kind"), sa.column("head"), sa.column("summary", DOCUMENT))
PART = sa.table(
    "revision_part", sa.column("item_id"), sa.column("number"), sa.column("part"), sa.column("document_digest")
)
DESCRIPTION = sa.table("document", sa.column("digest"), sa.column("body", DOCUMENT))


def upgrade() -> None:
    """Copy the take record of each clip to its summary."""
    connection = op.get_bind()
    described = (
        sa.select(ITEM.c.id, ITEM.c.summary, DESCRIPTION.c.body)
        .join(PART, sa.and_(PART.c.item_id == ITEM.c.id, PART.c.number == ITEM.c.head, PART.c.part == "info"))
        .join(DESCRIPTION, DESCRIPTION.c.digest == PART.c.document_digest)
        .where(ITEM.c.kind == "clip", ITEM.c.id > sa.bindparam("behind"))
        .order_by(ITEM.c.id)
        .limit(BATCH)
    )
    change = sa.update(ITEM).where(ITEM.c.id == sa.bindparam("changed")).values(summary=sa.bindparam("shown"))
    behind = ""
    while rows := connection.execute(described, {"behind": behind}).all():
        behind = rows[-1].id
        changes = [
            {"changed": row.id, "shown": {**row.summary, **record}}
            for row in rows
            if (record := {name: row.body[name] for name in RECORDED if row.body.get(name)})
        ]
        if changes:
            connection.execute(change, changes)


def downgrade() -> None:
    """Change nothing: earlier versions show all members of a summary, also those of take records."""
