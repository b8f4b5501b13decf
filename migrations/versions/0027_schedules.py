"""Schedules, which submit jobs at the times of a cron expression."""

import sqlalchemy as sa
from alembic import op
from sqlalchemy.dialects import postgresql

revision = "0027"
down_revision = "0026"
branch_labels = None
depends_on = None

ID = sa.String(40)
NAME = sa.String(255).with_variant(sa.String(255, collation="C"), "postgresql")
MICROS = sa.BigInteger
DOCUMENT = sa.JSON().with_variant(postgresql.JSONB(), "postgresql")


def upgrade() -> None:
    """Create the table `schedule`."""
    op.create_table(
        "schedule",
        sa.Column("id", ID, nullable=False),
        sa.Column("project_id", ID, nullable=False),
        sa.Column("name", NAME, nullable=False),
        sa.Column("cron", sa.String(100), nullable=False),
        sa.Column("timezone", sa.String(64), nullable=False),
        sa.Column("job", DOCUMENT, nullable=False),
        sa.Column("overlapping", sa.Boolean, nullable=False),
        sa.Column("description", sa.Text, nullable=False),
        sa.Column("author_id", ID, nullable=False),
        sa.Column("scopes", DOCUMENT, nullable=False),
        sa.Column("due_us", MICROS),
        sa.Column("fired_us", MICROS),
        sa.Column("last_job_id", ID),
        sa.Column("problem", sa.Text),
        sa.Column("created_us", MICROS, nullable=False),
        sa.Column("updated_us", MICROS, nullable=False),
        sa.Column("rev", sa.Integer, nullable=False),
        sa.PrimaryKeyConstraint("id", name="pk_schedule"),
        sa.ForeignKeyConstraint(["project_id"], ["project.id"], name="fk_schedule_project_id_project"),
        sa.ForeignKeyConstraint(["author_id"], ["user.id"], name="fk_schedule_author_id_user"),
    )
    op.create_index("uq_schedule_project_id_name", "schedule", ["project_id", "name"], unique=True)
    op.create_index("ix_schedule_due_us", "schedule", ["due_us"])


def downgrade() -> None:
    """Drop the table `schedule`."""
    op.drop_table("schedule")
