"""Proposals with comments, reviews and checks, and the protection of branches."""

import sqlalchemy as sa
from alembic import op
from sqlalchemy.dialects.postgresql import JSONB

revision = "0015"
down_revision = "0014"
branch_labels = None
depends_on = None

ID = sa.String(40)
DIGEST = sa.String(71)
NAME = sa.String(255).with_variant(sa.String(255, collation="C"), "postgresql")
DOCUMENT = sa.JSON().with_variant(JSONB(), "postgresql")
COMMIT = ["dataset_commit.dataset_id", "dataset_commit.digest"]


def upgrade() -> None:
    """Create the tables of proposals, and the column `protection` of `dataset_ref` for the rules of branches."""
    op.add_column("dataset_ref", sa.Column("protection", DOCUMENT, nullable=True))
    op.create_table(
        "proposal",
        sa.Column("dataset_id", ID, nullable=False),
        sa.Column("number", sa.Integer(), nullable=False),
        sa.Column("title", sa.String(255), nullable=False),
        sa.Column("description", sa.Text(), nullable=False),
        sa.Column("author_id", ID, nullable=False),
        sa.Column("source", sa.String(255), nullable=False),
        sa.Column("target", NAME, nullable=False),
        sa.Column("state", sa.String(8), nullable=False),
        sa.Column("head", DIGEST, nullable=True),
        sa.Column("target_commit", DIGEST, nullable=True),
        sa.Column("merged", DIGEST, nullable=True),
        sa.Column("when_green_id", ID, nullable=True),
        sa.Column("when_green_head", DIGEST, nullable=True),
        sa.Column("ended_id", ID, nullable=True),
        sa.Column("created_us", sa.BigInteger(), nullable=False),
        sa.Column("updated_us", sa.BigInteger(), nullable=False),
        sa.Column("ended_us", sa.BigInteger(), nullable=True),
        sa.Column("rev", sa.Integer(), nullable=False),
        sa.PrimaryKeyConstraint("dataset_id", "number", name="pk_proposal"),
        sa.ForeignKeyConstraint(["dataset_id"], ["dataset.id"], name="fk_proposal_dataset_id_dataset"),
        *(
            sa.ForeignKeyConstraint([column], ["user.id"], name=f"fk_proposal_{column}_user")
            for column in ("author_id", "when_green_id", "ended_id")
        ),
        *(
            sa.ForeignKeyConstraint(
                ["dataset_id", column], COMMIT, name=f"fk_proposal_dataset_id_{column}_dataset_commit"
            )
            for column in ("head", "target_commit", "merged", "when_green_head")
        ),
    )
    op.create_index("ix_proposal_state", "proposal", ["dataset_id", "state", "number"])
    _create_comments()
    _create_reviews()
    _create_checks()


def _create_comments() -> None:
    op.create_table(
        "proposal_comment",
        sa.Column("dataset_id", ID, nullable=False),
        sa.Column("proposal", sa.Integer(), nullable=False),
        sa.Column("number", sa.Integer(), nullable=False),
        sa.Column("author_id", ID, nullable=False),
        sa.Column("text", sa.Text(), nullable=False),
        sa.Column("path", sa.Text(), nullable=True),
        sa.Column("kind", sa.String(32), nullable=True),
        sa.Column("first_frame", sa.Integer(), nullable=True),
        sa.Column("end_frame", sa.Integer(), nullable=True),
        sa.Column("digest", DIGEST, nullable=False),
        sa.Column("created_us", sa.BigInteger(), nullable=False),
        sa.PrimaryKeyConstraint("dataset_id", "proposal", "number", name="pk_proposal_comment"),
        *_references("proposal_comment", "author_id"),
    )


def _create_reviews() -> None:
    op.create_table(
        "proposal_review",
        sa.Column("dataset_id", ID, nullable=False),
        sa.Column("proposal", sa.Integer(), nullable=False),
        sa.Column("number", sa.Integer(), nullable=False),
        sa.Column("author_id", ID, nullable=False),
        sa.Column("verdict", sa.String(16), nullable=False),
        sa.Column("text", sa.Text(), nullable=False),
        sa.Column("digest", DIGEST, nullable=False),
        sa.Column("created_us", sa.BigInteger(), nullable=False),
        sa.PrimaryKeyConstraint("dataset_id", "proposal", "number", name="pk_proposal_review"),
        *_references("proposal_review", "author_id"),
    )


def _create_checks() -> None:
    op.create_table(
        "proposal_check",
        sa.Column("dataset_id", ID, nullable=False),
        sa.Column("proposal", sa.Integer(), nullable=False),
        sa.Column("digest", DIGEST, nullable=False),
        sa.Column("name", NAME, nullable=False),
        sa.Column("state", sa.String(16), nullable=False),
        sa.Column("job_id", ID, nullable=True),
        sa.Column("link", sa.Text(), nullable=True),
        sa.Column("text", sa.Text(), nullable=False),
        sa.Column("reporter_id", ID, nullable=False),
        sa.Column("updated_us", sa.BigInteger(), nullable=False),
        sa.PrimaryKeyConstraint("dataset_id", "proposal", "digest", "name", name="pk_proposal_check"),
        *_references("proposal_check", "reporter_id"),
    )


def _references(table: str, of_user: str) -> list[sa.ForeignKeyConstraint]:
    return [
        sa.ForeignKeyConstraint([of_user], ["user.id"], name=f"fk_{table}_{of_user}_user"),
        sa.ForeignKeyConstraint(
            ["dataset_id", "proposal"],
            ["proposal.dataset_id", "proposal.number"],
            name=f"fk_{table}_dataset_id_proposal_proposal",
        ),
        sa.ForeignKeyConstraint(["dataset_id", "digest"], COMMIT, name=f"fk_{table}_dataset_id_digest_dataset_commit"),
    ]


def downgrade() -> None:
    """Drop the tables of proposals, and the protection rules of branches."""
    for table in ("proposal_check", "proposal_review", "proposal_comment", "proposal"):
        op.drop_table(table)
    op.drop_column("dataset_ref", "protection")
