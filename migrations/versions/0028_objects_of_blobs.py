"""Names of the objects that contain the bytes of blobs, if these bytes are in object storage."""

import sqlalchemy as sa
from alembic import op

revision = "0028"
down_revision = "0027"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Add the column `object_id` to `blob`; it is null for existing blobs, which are in no object."""
    op.add_column("blob", sa.Column("object_id", sa.String(40)))


def downgrade() -> None:
    """Drop the column `object_id` of `blob`."""
    op.drop_column("blob", "object_id")
