"""Claims that can be repeated, and attempts that count as tries of the job only after their first write."""

import sqlalchemy as sa
from alembic import op

revision = "0007"
down_revision = "0006"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Add `unstarted` and `counted_fence` to `job`, and `claim_id` to `attempt`.

    Earlier attempts are marked as counted, because each was counted when it was claimed.
    """
    op.add_column("job", sa.Column("unstarted", sa.Integer(), nullable=False, server_default=sa.text("0")))
    op.add_column("job", sa.Column("counted_fence", sa.Integer(), nullable=False, server_default=sa.text("0")))
    op.execute("UPDATE job SET counted_fence = fence WHERE fence > 0")
    op.add_column("attempt", sa.Column("claim_id", sa.String(length=64), nullable=True))
    named = sa.text("claim_id IS NOT NULL")
    op.create_index(
        "ix_attempt_claim", "attempt", ["claimed_by", "claim_id"], sqlite_where=named, postgresql_where=named
    )


def downgrade() -> None:
    """Drop the index of claims and the three columns that `upgrade` has added."""
    op.drop_index("ix_attempt_claim", "attempt")
    op.drop_column("attempt", "claim_id")
    op.drop_column("job", "counted_fence")
    op.drop_column("job", "unstarted")
