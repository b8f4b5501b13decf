"""Index of the unfinished jobs of each user, used to count these jobs for the quota `user_jobs`."""

import sqlalchemy as sa
from alembic import op

revision = "0011"
down_revision = "0010"
branch_labels = None
depends_on = None

UNFINISHED = sa.text("state IN ('waiting', 'queued', 'running')")


def upgrade() -> None:
    """Create the index `ix_job_unfinished`."""
    op.create_index("ix_job_unfinished", "job", ["author_id"], sqlite_where=UNFINISHED, postgresql_where=UNFINISHED)


def downgrade() -> None:
    """Drop the index `ix_job_unfinished`."""
    op.drop_index("ix_job_unfinished", "job")
