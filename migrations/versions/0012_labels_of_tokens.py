"""Worker labels to which a token is bound; null: the token allows any labels, as before."""

import sqlalchemy as sa
from alembic import op
from sqlalchemy.dialects.postgresql import JSONB

revision = "0012"
down_revision = "0011"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Add the column."""
    op.add_column("token", sa.Column("labels", sa.JSON().with_variant(JSONB(), "postgresql")))


def downgrade() -> None:
    """Remove the column."""
    op.drop_column("token", "labels")
