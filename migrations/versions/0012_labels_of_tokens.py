"""Worker labels to which a token is bound; if they are null, the token allows any labels, as before."""

import sqlalchemy as sa
from alembic import op
from sqlalchemy.dialects.postgresql import JSONB

revision = "0012"
down_revision = "0011"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Add the column `labels` to `token`."""
    op.add_column("token", sa.Column("labels", sa.JSON().with_variant(JSONB(), "postgresql")))


def downgrade() -> None:
    """Drop the column `labels` of `token`; the tokens then allow any labels."""
    op.drop_column("token", "labels")
