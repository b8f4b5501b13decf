"""Mark of jobs for which a worker gathers the results of the tasks."""

import sqlalchemy as sa
from alembic import op

revision = "0002"
down_revision = "0001"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Add the column `gathers` to `job`."""
    op.add_column("job", sa.Column("gathers", sa.Boolean(), nullable=False, server_default=sa.false()))


def downgrade() -> None:
    """Drop the column `gathers` of `job`."""
    op.drop_column("job", "gathers")
