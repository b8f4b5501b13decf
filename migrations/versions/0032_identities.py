"""People at identity providers, linked with users, and their sign-ins that are not complete."""

import sqlalchemy as sa
from alembic import op

revision = "0032"
down_revision = "0031"
branch_labels = None
depends_on = None
phase = "before"

ID = sa.String(40)


def upgrade() -> None:
    """Create the tables `identity` and `browser_sign_in`."""
    op.create_table(
        "identity",
        sa.Column("id", ID, nullable=False),
        sa.Column("user_id", ID, nullable=False),
        sa.Column("issuer", sa.String(512), nullable=False),
        sa.Column("subject", sa.String(255), nullable=False),
        sa.Column("created_us", sa.BigInteger, nullable=False),
        sa.Column("last_used_us", sa.BigInteger),
        sa.PrimaryKeyConstraint("id", name="pk_identity"),
        sa.ForeignKeyConstraint(["user_id"], ["user.id"], name="fk_identity_user_id_user"),
    )
    op.create_index("ix_identity_user_id", "identity", ["user_id"])
    op.create_index("uq_identity_issuer_subject", "identity", ["issuer", "subject"], unique=True)
    op.create_table(
        "browser_sign_in",
        sa.Column("id", ID, nullable=False),
        sa.Column("challenge", sa.String(64), nullable=False),
        sa.Column("port", sa.Integer),
        sa.Column("lifetime_s", sa.Integer, nullable=False),
        sa.Column("browser_hash", sa.String(64)),
        sa.Column("state_hash", sa.String(64)),
        sa.Column("code_hash", sa.String(64)),
        sa.Column("identity_id", ID),
        sa.Column("created_us", sa.BigInteger, nullable=False),
        sa.Column("expires_us", sa.BigInteger, nullable=False),
        sa.PrimaryKeyConstraint("id", name="pk_browser_sign_in"),
        sa.ForeignKeyConstraint(["identity_id"], ["identity.id"], name="fk_browser_sign_in_identity_id_identity"),
        sa.UniqueConstraint("state_hash", name="uq_browser_sign_in_state_hash"),
    )
    op.create_index("ix_browser_sign_in_identity_id", "browser_sign_in", ["identity_id"])
    op.create_index("ix_browser_sign_in_expires_us", "browser_sign_in", ["expires_us"])


def downgrade() -> None:
    """Drop the tables `identity` and `browser_sign_in`."""
    op.drop_table("browser_sign_in")
    op.drop_table("identity")
