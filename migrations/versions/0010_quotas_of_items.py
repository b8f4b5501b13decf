"""Counters of the items and bytes of projects and users."""

import sqlalchemy as sa
from alembic import op
from sqlalchemy.dialects import postgresql

ID = sa.String(40)
DOCUMENT = sa.JSON().with_variant(postgresql.JSONB(), "postgresql")

revision = "0010"
down_revision = "0009"
branch_labels = None
depends_on = None

BYTES_OF_FILES = """
    UPDATE document SET file_bytes = (
        SELECT COALESCE(SUM(size_bytes), 0) FROM blob WHERE digest IN (
            SELECT blob_digest FROM document_blob
            WHERE document_digest = document.digest AND (pointer LIKE '%/blob'
                OR document.schema = 'marey/clip-info@1' AND pointer IN ('/source/file', '/source/companion'))
        )
    )
    WHERE digest IN (
        SELECT document_digest FROM document_blob
        WHERE pointer LIKE '%/blob' OR pointer IN ('/source/file', '/source/companion')
    )
"""

CREATORS = """
    UPDATE item SET creator_id = (
        SELECT author_id FROM revision WHERE revision.item_id = item.id AND revision.number = 1
    )
"""

BYTES_OF_ITEMS = """
    UPDATE item SET stored_bytes = (
        SELECT COALESCE(SUM(document.size_bytes + document.file_bytes), 0)
        FROM revision_part AS part JOIN document ON document.digest = part.document_digest
        WHERE part.item_id = item.id AND NOT EXISTS (
            SELECT 1 FROM revision_part AS earlier
            WHERE earlier.item_id = part.item_id AND earlier.number = part.number - 1 AND earlier.part = part.part
                AND earlier.document_digest = part.document_digest
        )
    )
"""

HELD = """
    INSERT INTO holding (owner_id, items, stored_bytes, limits)
    SELECT {owner}, COUNT(*), SUM(stored_bytes), '{{}}' FROM item
    WHERE deleted_us IS NULL AND {owner} IS NOT NULL GROUP BY {owner}
"""


def upgrade() -> None:
    """Create the table `holding` of counters, and count the existing items and their bytes."""
    op.create_table(
        "holding",
        sa.Column("owner_id", ID, nullable=False),
        sa.Column("items", sa.BigInteger(), nullable=False, server_default=sa.text("0")),
        sa.Column("stored_bytes", sa.BigInteger(), nullable=False, server_default=sa.text("0")),
        sa.Column("limits", DOCUMENT, nullable=False),
        sa.PrimaryKeyConstraint("owner_id", name="pk_holding"),
    )
    op.add_column("document", sa.Column("file_bytes", sa.BigInteger(), nullable=False, server_default=sa.text("0")))
    op.add_column("item", sa.Column("creator_id", ID))
    op.add_column("item", sa.Column("stored_bytes", sa.BigInteger(), nullable=False, server_default=sa.text("0")))
    for statement in (BYTES_OF_FILES, CREATORS, BYTES_OF_ITEMS):
        op.execute(statement)
    for owner in ("project_id", "creator_id"):
        op.execute(HELD.format(owner=owner))


def downgrade() -> None:
    """Drop the counters of items and bytes, and the limits that administrators have set."""
    op.drop_column("item", "stored_bytes")
    op.drop_column("item", "creator_id")
    op.drop_column("document", "file_bytes")
    op.drop_table("holding")
