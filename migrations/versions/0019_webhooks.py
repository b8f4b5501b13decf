"""Webhooks, and their deliveries that failed or that users requested."""

import sqlalchemy as sa
from alembic import op
from sqlalchemy.dialects.postgresql import JSONB

revision = "0019"
down_revision = "0018"
branch_labels = None
depends_on = None

ID = sa.String(40)
MICROS = sa.BigInteger
DOCUMENT = sa.JSON().with_variant(JSONB(), "postgresql")


def upgrade() -> None:
    """Create the tables `webhook` and `webhook_delivery`."""
    op.create_table(
        "webhook",
        sa.Column("id", ID, nullable=False),
        sa.Column("project_id", ID, nullable=False),
        sa.Column("creator_id", ID),
        sa.Column("url", sa.String(2048), nullable=False),
        sa.Column("kinds", DOCUMENT, nullable=False),
        sa.Column("description", sa.Text, nullable=False),
        sa.Column("secret", sa.String(128), nullable=False),
        sa.Column("old_secret", sa.String(128)),
        sa.Column("old_secret_until_us", MICROS),
        sa.Column("position", sa.BigInteger, nullable=False),
        sa.Column("missed", sa.BigInteger, nullable=False),
        sa.Column("attempts", sa.Integer, nullable=False),
        sa.Column("failures", sa.Integer, nullable=False),
        sa.Column("next_us", MICROS, nullable=False),
        sa.Column("failing_since_us", MICROS),
        sa.Column("delivered_us", MICROS),
        sa.Column("last_status", sa.Integer),
        sa.Column("last_error", sa.String(255)),
        sa.Column("paused", sa.Boolean, nullable=False),
        sa.Column("paused_reason", sa.String(512)),
        sa.Column("created_us", MICROS, nullable=False),
        sa.Column("updated_us", MICROS, nullable=False),
        sa.PrimaryKeyConstraint("id", name="pk_webhook"),
        sa.ForeignKeyConstraint(["project_id"], ["project.id"], name="fk_webhook_project_id_project"),
        sa.ForeignKeyConstraint(["creator_id"], ["user.id"], name="fk_webhook_creator_id_user"),
    )
    op.create_index("ix_webhook_project_id", "webhook", ["project_id"])
    op.create_index("ix_webhook_next_us", "webhook", ["next_us"])
    op.create_table(
        "webhook_delivery",
        sa.Column("id", sa.String(80), nullable=False),
        sa.Column("webhook_id", ID, nullable=False),
        sa.Column("kind", sa.String(64), nullable=False),
        sa.Column("number", sa.BigInteger),
        sa.Column("body", sa.Text, nullable=False),
        sa.Column("state", sa.String(16), nullable=False),
        sa.Column("attempts", sa.Integer, nullable=False),
        sa.Column("last_status", sa.Integer),
        sa.Column("last_error", sa.String(255)),
        sa.Column("created_us", MICROS, nullable=False),
        sa.Column("updated_us", MICROS, nullable=False),
        sa.PrimaryKeyConstraint("id", name="pk_webhook_delivery"),
        sa.ForeignKeyConstraint(["webhook_id"], ["webhook.id"], name="fk_webhook_delivery_webhook_id_webhook"),
    )
    op.create_index("ix_webhook_delivery_updated_us", "webhook_delivery", ["updated_us"])
    op.create_index("ix_webhook_delivery_state", "webhook_delivery", ["webhook_id", "state", "created_us"])


def downgrade() -> None:
    """Drop the tables `webhook` and `webhook_delivery`."""
    op.drop_table("webhook_delivery")
    op.drop_table("webhook")
