"""Scripts, which are commands of pinned Git commits, and the jobs that run them."""

import sqlalchemy as sa
from alembic import op
from sqlalchemy.dialects import postgresql

revision = "0030"
down_revision = "0029"
branch_labels = None
depends_on = None

ID = sa.String(40)
NAME = sa.String(255).with_variant(sa.String(255, collation="C"), "postgresql")
DOCUMENT = sa.JSON().with_variant(postgresql.JSONB(), "postgresql")


def upgrade() -> None:
    """Create the tables `script` and `script_run`."""
    op.create_table(
        "script",
        sa.Column("id", ID, nullable=False),
        sa.Column("project_id", ID, nullable=False),
        sa.Column("name", NAME, nullable=False),
        sa.Column("description", sa.Text, nullable=False),
        sa.Column("declaration", DOCUMENT, nullable=False),
        sa.Column("author_id", ID, nullable=False),
        sa.Column("created_us", sa.BigInteger, nullable=False),
        sa.PrimaryKeyConstraint("id", name="pk_script"),
        sa.ForeignKeyConstraint(["project_id"], ["project.id"], name="fk_script_project_id_project"),
        sa.ForeignKeyConstraint(["author_id"], ["user.id"], name="fk_script_author_id_user"),
    )
    op.create_index("uq_script_project_id_name", "script", ["project_id", "name"], unique=True)
    op.create_table(
        "script_run",
        sa.Column("job_id", ID, nullable=False),
        sa.Column("project_id", ID, nullable=False),
        sa.Column("script", NAME, nullable=False),
        sa.PrimaryKeyConstraint("job_id", name="pk_script_run"),
        sa.ForeignKeyConstraint(["job_id"], ["job.id"], name="fk_script_run_job_id_job"),
        sa.ForeignKeyConstraint(["project_id"], ["project.id"], name="fk_script_run_project_id_project"),
    )
    op.create_index("ix_script_run_script", "script_run", ["project_id", "script", "job_id"])


def downgrade() -> None:
    """Drop the tables `script` and `script_run`."""
    op.drop_table("script_run")
    op.drop_table("script")
