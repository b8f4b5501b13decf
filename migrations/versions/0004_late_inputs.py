"""Job inputs that other jobs will produce."""

import sqlalchemy as sa
from alembic import op

revision = "0004"
down_revision = "0003"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Add the column `unbound` and the index of retries to `job`."""
    op.add_column("job", sa.Column("unbound", sa.Boolean(), nullable=False, server_default=sa.false()))
    tried_again = sa.text("retry_of IS NOT NULL")
    op.create_index("ix_job_retry", "job", ["retry_of"], sqlite_where=tried_again, postgresql_where=tried_again)


def downgrade() -> None:
    """Drop the index of retries and the column `unbound` of `job`."""
    op.drop_index("ix_job_retry", "job")
    op.drop_column("job", "unbound")
