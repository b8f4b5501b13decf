"""Participants of perceptual studies, and the trials that they were shown."""

import sqlalchemy as sa
from alembic import op
from sqlalchemy.dialects import postgresql

revision = "0034"
down_revision = "0033"
branch_labels = None
depends_on = None
phase = "before"

ID = sa.String(40)
MICROS = sa.BigInteger
DOCUMENT = sa.JSON().with_variant(postgresql.JSONB(), "postgresql")


def upgrade() -> None:
    """Create the tables `study_participant` and `study_trial`."""
    op.create_table(
        "study_participant",
        sa.Column("id", ID, nullable=False),
        sa.Column("item_id", ID, nullable=False),
        sa.Column("revision", sa.Integer, nullable=False),
        sa.Column("number", sa.Integer, nullable=False),
        sa.Column("link_prefix", sa.String(16), nullable=False),
        sa.Column("link_hash", sa.String(64), nullable=False),
        sa.Column("token_prefix", sa.String(16)),
        sa.Column("token_hash", sa.String(64)),
        sa.Column("started_us", MICROS),
        sa.Column("withdrawn_us", MICROS),
        sa.Column("plan", DOCUMENT, nullable=False),
        sa.Column("answered", sa.Integer, nullable=False),
        sa.Column("timeouts", sa.Integer, nullable=False),
        sa.Column("created_us", MICROS, nullable=False),
        sa.Column("expires_us", MICROS, nullable=False),
        sa.PrimaryKeyConstraint("id", name="pk_study_participant"),
        sa.UniqueConstraint("link_prefix", name="uq_study_participant_link_prefix"),
        sa.UniqueConstraint("token_prefix", name="uq_study_participant_token_prefix"),
        sa.UniqueConstraint("item_id", "revision", "number", name="uq_study_participant_item_id_revision_number"),
        sa.ForeignKeyConstraint(["item_id"], ["item.id"], name="fk_study_participant_item_id_item"),
    )
    op.create_table(
        "study_trial",
        sa.Column("participant_id", ID, nullable=False),
        sa.Column("number", sa.Integer, nullable=False),
        sa.Column("shown", DOCUMENT, nullable=False),
        sa.Column("answered_before", sa.Integer, nullable=False),
        sa.Column("timeouts_before", sa.Integer, nullable=False),
        sa.Column("started_us", MICROS, nullable=False),
        sa.Column("deadline_us", MICROS, nullable=False),
        sa.Column("ended_us", MICROS),
        sa.Column("chosen", DOCUMENT),
        sa.Column("client_fps", sa.Float),
        sa.PrimaryKeyConstraint("participant_id", "number", name="pk_study_trial"),
        sa.ForeignKeyConstraint(
            ["participant_id"], ["study_participant.id"], name="fk_study_trial_participant_id_study_participant"
        ),
    )


def downgrade() -> None:
    """Drop the tables `study_participant` and `study_trial`."""
    op.drop_table("study_trial")
    op.drop_table("study_participant")
