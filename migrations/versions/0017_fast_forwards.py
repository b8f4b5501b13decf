"""Records of fast-forward merges, so that a repeated request gets the same answer as the first request."""

import sqlalchemy as sa
from alembic import op

revision = "0017"
down_revision = "0016"
branch_labels = None
depends_on = None

ID = sa.String(40)
DIGEST = sa.String(71)


def upgrade() -> None:
    """Create the table `fast_forward`; merges before this migration are not in it."""
    op.create_table(
        "fast_forward",
        sa.Column("dataset_id", ID, nullable=False),
        sa.Column("write_id", sa.String(64), nullable=False),
        sa.Column("digest", DIGEST, nullable=False),
        sa.ForeignKeyConstraint(
            ["dataset_id", "digest"],
            ["dataset_commit.dataset_id", "dataset_commit.digest"],
            name="fk_fast_forward_dataset_id_digest_dataset_commit",
        ),
        sa.PrimaryKeyConstraint("dataset_id", "write_id", name="pk_fast_forward"),
    )


def downgrade() -> None:
    """Drop the table `fast_forward`."""
    op.drop_table("fast_forward")
