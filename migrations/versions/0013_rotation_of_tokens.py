"""Rotation of tokens: the predecessor of each token, and a hash of the id of the rotation that replaced the token."""

import sqlalchemy as sa
from alembic import op

revision = "0013"
down_revision = "0012"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Add the columns `rotation_hash` and `successor_of` to `token`."""
    op.add_column("token", sa.Column("rotation_hash", sa.String(64)))
    op.add_column("token", sa.Column("successor_of", sa.String(40)))
    op.create_index("uq_token_successor_of", "token", ["successor_of"], unique=True)


def downgrade() -> None:
    """Drop the columns `rotation_hash` and `successor_of` of `token`."""
    op.drop_index("uq_token_successor_of", "token")
    op.drop_column("token", "successor_of")
    op.drop_column("token", "rotation_hash")
