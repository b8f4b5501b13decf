"""Index of proposals that wait to be merged, so that the server need not read all proposals to find them."""

import sqlalchemy as sa
from alembic import op

revision = "0026"
down_revision = "0025"
branch_labels = None
depends_on = None

WAITING = sa.text("when_green_id IS NOT NULL")


def upgrade() -> None:
    """Create the index `ix_proposal_waiting`."""
    columns = ["dataset_id", "number"]
    op.create_index("ix_proposal_waiting", "proposal", columns, sqlite_where=WAITING, postgresql_where=WAITING)


def downgrade() -> None:
    """Drop the index `ix_proposal_waiting`."""
    op.drop_index("ix_proposal_waiting", "proposal")
