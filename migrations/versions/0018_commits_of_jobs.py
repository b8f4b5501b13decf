"""Commits that jobs make of their outputs."""

import sqlalchemy as sa
from alembic import op
from sqlalchemy.dialects.postgresql import JSONB

revision = "0018"
down_revision = "0017"
branch_labels = None
depends_on = None

ID = sa.String(40)
DIGEST = sa.String(71)
DOCUMENT = sa.JSON().with_variant(JSONB(), "postgresql")
FOREIGN_KEY = "fk_dataset_commit_job_id_job"


def upgrade() -> None:
    """Add `commit_to` and `committed` to `job`, and `job_id` to `dataset_commit`; they are null in existing rows."""
    op.add_column("job", sa.Column("commit_to", DOCUMENT, nullable=True))
    op.add_column("job", sa.Column("committed", DIGEST, nullable=True))
    if op.get_bind().dialect.name == "sqlite":  # which adds a foreign key only together with its column
        op.execute(
            f"ALTER TABLE dataset_commit ADD COLUMN job_id VARCHAR(40) CONSTRAINT {FOREIGN_KEY} REFERENCES job (id)"
        )
    else:
        op.add_column("dataset_commit", sa.Column("job_id", ID, nullable=True))
        op.create_foreign_key(FOREIGN_KEY, "dataset_commit", "job", ["job_id"], ["id"])
    op.create_index("uq_dataset_commit_job", "dataset_commit", ["job_id"], unique=True)


def downgrade() -> None:
    """Drop the columns `commit_to` and `committed` of `job`, and `job_id` of `dataset_commit`."""
    op.drop_index("uq_dataset_commit_job", "dataset_commit")
    op.drop_column("dataset_commit", "job_id")
    op.drop_column("job", "committed")
    op.drop_column("job", "commit_to")
