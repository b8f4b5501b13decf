"""Blobs whose bytes stay in the pieces of their upload."""

import sqlalchemy as sa
from alembic import op

revision = "0008"
down_revision = "0007"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Add `upload_id` to `blob`, and `actual_digest` and `dropped` to `upload`."""
    op.add_column("blob", sa.Column("upload_id", sa.String(40)))
    of_upload = sa.text("upload_id IS NOT NULL")
    op.create_index("ix_blob_upload", "blob", ["upload_id"], sqlite_where=of_upload, postgresql_where=of_upload)
    op.add_column("upload", sa.Column("actual_digest", sa.String(71)))
    op.add_column("upload", sa.Column("dropped", sa.Boolean(), nullable=False, server_default=sa.false()))


def downgrade() -> None:
    """Copy the pieces of uploads that are blobs into chunks of 1 MiB of these blobs.

    The columns that `upgrade` has added are dropped, and so are the uploads that were marked as dropped.
    """
    connection = op.get_bind()
    rows = connection.execute(sa.text("SELECT digest, upload_id FROM blob WHERE upload_id IS NOT NULL")).all()
    for digest, upload_id in rows:
        _copy_pieces(connection, digest, upload_id)
    op.execute("DELETE FROM upload_chunk WHERE upload_id IN (SELECT id FROM upload WHERE dropped)")
    op.execute("DELETE FROM upload WHERE dropped")
    op.drop_column("upload", "dropped")
    op.drop_column("upload", "actual_digest")
    op.drop_index("ix_blob_upload", "blob")
    op.drop_column("blob", "upload_id")


def _copy_pieces(connection: sa.Connection, digest: str, upload_id: str) -> None:
    one = sa.text('SELECT data FROM upload_chunk WHERE upload_id = :upload AND "offset" = :at')
    add = sa.text("INSERT INTO blob_chunk (digest, position, data) VALUES (:digest, :position, :data)")
    held, offset, position = bytearray(), 0, 0
    while data := connection.execute(one, {"upload": upload_id, "at": offset}).scalar():
        offset += len(data)
        held += data
        while len(held) >= 2**20:
            connection.execute(add, {"digest": digest, "position": position, "data": bytes(held[: 2**20])})
            del held[: 2**20]
            position += 1
    if held:
        connection.execute(add, {"digest": digest, "position": position, "data": bytes(held)})
