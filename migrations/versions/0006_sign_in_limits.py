"""Limits on sign-ins, shared by all servers; a mark of tokens that sign-ins created; the creator of each token."""

import sqlalchemy as sa
from alembic import op

revision = "0006"
down_revision = "0005"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Create the table `sign_in_limit`, and the columns `session` and `created_by` of `token`.

    Tokens with the name `sign-in` are marked as created by sign-ins.
    """
    op.create_table(
        "sign_in_limit",
        sa.Column("key", sa.String(64), nullable=False),
        sa.Column("until_us", sa.BigInteger(), nullable=False),
        sa.PrimaryKeyConstraint("key", name="pk_sign_in_limit"),
    )
    op.create_index("ix_sign_in_limit_until_us", "sign_in_limit", ["until_us"])
    op.add_column("token", sa.Column("session", sa.Boolean(), nullable=False, server_default=sa.false()))
    op.add_column("token", sa.Column("created_by", sa.String(40), nullable=True))
    token = sa.table("token", sa.column("name"), sa.column("session", sa.Boolean()))
    op.execute(token.update().where(token.c.name == "sign-in").values(session=True))


def downgrade() -> None:
    """Drop the columns `session` and `created_by` of `token`, and the table `sign_in_limit`."""
    op.drop_column("token", "created_by")
    op.drop_column("token", "session")
    op.drop_index("ix_sign_in_limit_until_us", "sign_in_limit")
    op.drop_table("sign_in_limit")
