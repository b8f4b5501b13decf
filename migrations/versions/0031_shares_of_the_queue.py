"""Limits on the running jobs of projects, and the order in which projects are served by claims."""

import sqlalchemy as sa
from alembic import op

revision = "0031"
down_revision = "0030"
branch_labels = None
depends_on = None

QUEUED = sa.text("state = 'queued'")
LEASED = sa.text("state = 'running' AND lease_expires_us IS NOT NULL")
BEFORE = (sa.text("priority DESC"), "run_at_us", "id", "kind", "labels_key")
AFTER = ("project_id", *BEFORE, "state")
COUNTED = ("project_id", "state", "lease_expires_us")


def upgrade() -> None:
    """Create the table `queue_share`, and indexes with which a claim reads the jobs of one project."""
    op.create_table(
        "queue_share",
        sa.Column("project_id", sa.String(40), nullable=False),
        sa.Column("most_running", sa.Integer),
        sa.Column("served_us", sa.BigInteger, nullable=False, server_default=sa.text("0")),
        sa.PrimaryKeyConstraint("project_id", name="pk_queue_share"),
        sa.ForeignKeyConstraint(["project_id"], ["project.id"], name="fk_queue_share_project_id_project"),
    )
    op.drop_index("ix_job_claim", "job")
    op.create_index("ix_job_claim", "job", list(AFTER), sqlite_where=QUEUED, postgresql_where=QUEUED)
    op.create_index("ix_job_leased", "job", list(COUNTED), sqlite_where=LEASED, postgresql_where=LEASED)


def downgrade() -> None:
    """Drop the table `queue_share`, with the limits of projects, and restore the former index of queued jobs."""
    op.drop_index("ix_job_leased", "job")
    op.drop_index("ix_job_claim", "job")
    op.create_index("ix_job_claim", "job", list(BEFORE), sqlite_where=QUEUED, postgresql_where=QUEUED)
    op.drop_table("queue_share")
