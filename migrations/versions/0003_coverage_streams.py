"""Table of coverage streams."""

import sqlalchemy as sa
from alembic import op
from sqlalchemy.dialects import postgresql

ID = sa.String(40)
DOCUMENT = sa.JSON().with_variant(postgresql.JSONB(), "postgresql")

revision = "0003"
down_revision = "0002"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Create the table `coverage_stream`."""
    op.create_table(
        "coverage_stream",
        sa.Column("id", ID, nullable=False),
        sa.Column("project_id", ID, nullable=False),
        sa.Column("author_id", ID, nullable=True),
        sa.Column("settings", DOCUMENT, nullable=False),
        sa.Column("rig", sa.LargeBinary(), nullable=True),
        sa.Column("state", sa.LargeBinary(), nullable=False),
        sa.Column("offset", sa.BigInteger(), nullable=False),
        sa.Column("said", sa.String(71), nullable=True),
        sa.Column("answer", DOCUMENT, nullable=True),
        sa.Column("created_us", sa.BigInteger(), nullable=False),
        sa.Column("updated_us", sa.BigInteger(), nullable=False),
        sa.Column("rev", sa.Integer(), nullable=False),
        sa.ForeignKeyConstraint(["project_id"], ["project.id"], name="fk_coverage_stream_project_id_project"),
        sa.ForeignKeyConstraint(["author_id"], ["user.id"], name="fk_coverage_stream_author_id_user"),
        sa.PrimaryKeyConstraint("id", name="pk_coverage_stream"),
    )
    op.create_index("ix_coverage_stream_project_id", "coverage_stream", ["project_id"])
    op.create_index("ix_coverage_stream_updated_us", "coverage_stream", ["updated_us"])


def downgrade() -> None:
    """Drop the table `coverage_stream`."""
    op.drop_table("coverage_stream")
