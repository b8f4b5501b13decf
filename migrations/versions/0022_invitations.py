"""Invitations to join a project or to create an account, and the users who have used them."""

import sqlalchemy as sa
from alembic import op

revision = "0022"
down_revision = "0021"
branch_labels = None
depends_on = None

ID = sa.String(40)
MICROS = sa.BigInteger


def upgrade() -> None:
    """Create the tables `invitation` and `invitation_use`."""
    op.create_table(
        "invitation",
        sa.Column("id", ID, nullable=False),
        sa.Column("inviter_id", ID, nullable=False),
        sa.Column("project_id", ID),
        sa.Column("role", sa.String(16)),
        sa.Column("creates_account", sa.Boolean, nullable=False),
        sa.Column("prefix", sa.String(16), nullable=False),
        sa.Column("secret_hash", sa.String(64), nullable=False),
        sa.Column("note", sa.String(255), nullable=False),
        sa.Column("uses", sa.Integer, nullable=False),
        sa.Column("used", sa.Integer, nullable=False),
        sa.Column("created_us", MICROS, nullable=False),
        sa.Column("expires_us", MICROS, nullable=False),
        sa.PrimaryKeyConstraint("id", name="pk_invitation"),
        sa.UniqueConstraint("prefix", name="uq_invitation_prefix"),
        sa.ForeignKeyConstraint(["inviter_id"], ["user.id"], name="fk_invitation_inviter_id_user"),
        sa.ForeignKeyConstraint(["project_id"], ["project.id"], name="fk_invitation_project_id_project"),
    )
    for column in ("inviter_id", "project_id", "expires_us"):
        op.create_index(f"ix_invitation_{column}", "invitation", [column])
    op.create_table(
        "invitation_use",
        sa.Column("invitation_id", ID, nullable=False),
        sa.Column("user_id", ID, nullable=False),
        sa.PrimaryKeyConstraint("invitation_id", "user_id", name="pk_invitation_use"),
        sa.ForeignKeyConstraint(
            ["invitation_id"], ["invitation.id"], name="fk_invitation_use_invitation_id_invitation"
        ),
        sa.ForeignKeyConstraint(["user_id"], ["user.id"], name="fk_invitation_use_user_id_user"),
    )


def downgrade() -> None:
    """Drop the tables `invitation` and `invitation_use`."""
    op.drop_table("invitation_use")
    op.drop_table("invitation")
