"""Marks of ended jobs whose ends later transactions propagate; bounds of the numbers of unfinished jobs of users."""

import sqlalchemy as sa
from alembic import op
from sqlalchemy.dialects import postgresql

revision = "0035"
down_revision = "0034"
branch_labels = None
depends_on = None
phase = "before"

DOCUMENT = sa.JSON().with_variant(postgresql.JSONB(), "postgresql")
UNPROPAGATED = sa.text("propagation_rank IS NOT NULL")


def upgrade() -> None:
    """Add the columns to the tables `job` and `user`, and indexes of the marked jobs and of dependants that wait."""
    op.add_column("job", sa.Column("propagation", DOCUMENT))
    op.add_column("job", sa.Column("propagation_rank", sa.BigInteger))
    columns = ["propagation_rank", "id"]
    op.create_index("ix_job_unpropagated", "job", columns, sqlite_where=UNPROPAGATED, postgresql_where=UNPROPAGATED)
    op.create_index(
        "ix_job_dependency_unsatisfied",
        "job_dependency",
        ["on_job_id", "job_id"],
        sqlite_where=sa.text("satisfied = 0"),
        postgresql_where=sa.text("satisfied = false"),
    )
    op.add_column("user", sa.Column("jobs_bound", sa.BigInteger))


def downgrade() -> None:
    """Drop the columns and the indexes."""
    op.drop_column("user", "jobs_bound")
    op.drop_index("ix_job_dependency_unsatisfied", "job_dependency")
    op.drop_index("ix_job_unpropagated", "job")
    op.drop_column("job", "propagation_rank")
    op.drop_column("job", "propagation")
