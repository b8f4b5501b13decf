"""Datasets: branches, tags, commits and trees of entries; content digests, which are equal on all servers."""

import sqlalchemy as sa
from alembic import op

revision = "0014"
down_revision = "0013"
branch_labels = None
depends_on = None

ID = sa.String(40)
DIGEST = sa.String(71)
NAME = sa.String(255).with_variant(sa.String(255, collation="C"), "postgresql")
ALIVE = sa.text("deleted_us IS NULL")


def upgrade() -> None:
    """Create the tables of datasets, and the columns for content digests, which later commits fill."""
    op.add_column("revision", sa.Column("content", DIGEST, nullable=True))
    op.create_index("ix_revision_content", "revision", ["content"])
    op.add_column("revision_part", sa.Column("content", DIGEST, nullable=True))
    op.create_table(
        "tree_chunk",
        sa.Column("digest", DIGEST, nullable=False),
        sa.Column("data", sa.LargeBinary(), nullable=False),
        sa.Column("created_us", sa.BigInteger(), nullable=False),
        sa.PrimaryKeyConstraint("digest", name="pk_tree_chunk"),
    )
    op.create_table(
        "dataset",
        sa.Column("id", ID, nullable=False),
        sa.Column("project_id", ID, nullable=False),
        sa.Column("name", sa.String(64), nullable=False),
        sa.Column("description", sa.Text(), nullable=False),
        sa.Column("collection_id", ID, nullable=True),
        sa.Column("folder_commit", DIGEST, nullable=True),
        sa.Column("created_us", sa.BigInteger(), nullable=False),
        sa.Column("updated_us", sa.BigInteger(), nullable=False),
        sa.Column("deleted_us", sa.BigInteger(), nullable=True),
        sa.Column("rev", sa.Integer(), nullable=False),
        sa.PrimaryKeyConstraint("id", name="pk_dataset"),
        sa.ForeignKeyConstraint(["project_id"], ["project.id"], name="fk_dataset_project_id_project"),
        sa.ForeignKeyConstraint(["collection_id"], ["collection.id"], name="fk_dataset_collection_id_collection"),
    )
    op.create_index(
        "uq_dataset_alive", "dataset", ["project_id", "name"], unique=True, sqlite_where=ALIVE, postgresql_where=ALIVE
    )
    _create_commits()


def _create_commits() -> None:
    op.create_table(
        "dataset_commit",
        sa.Column("dataset_id", ID, nullable=False),
        sa.Column("digest", DIGEST, nullable=False),
        sa.Column("tree", DIGEST, nullable=False),
        sa.Column("author", sa.String(255), nullable=False),
        sa.Column("message", sa.Text(), nullable=False),
        sa.Column("at", sa.String(32), nullable=False),
        sa.Column("entries", sa.BigInteger(), nullable=False),
        sa.Column("generation", sa.Integer(), nullable=False),
        sa.Column("write_id", sa.String(64), nullable=True),
        sa.PrimaryKeyConstraint("dataset_id", "digest", name="pk_dataset_commit"),
        sa.ForeignKeyConstraint(["dataset_id"], ["dataset.id"], name="fk_dataset_commit_dataset_id_dataset"),
        sa.ForeignKeyConstraint(["tree"], ["tree_chunk.digest"], name="fk_dataset_commit_tree_tree_chunk"),
    )
    op.create_index("uq_dataset_commit_write", "dataset_commit", ["dataset_id", "write_id"], unique=True)
    commit = ["dataset_commit.dataset_id", "dataset_commit.digest"]
    op.create_table(
        "commit_parent",
        sa.Column("dataset_id", ID, nullable=False),
        sa.Column("digest", DIGEST, nullable=False),
        sa.Column("position", sa.Integer(), nullable=False),
        sa.Column("parent", DIGEST, nullable=False),
        sa.PrimaryKeyConstraint("dataset_id", "digest", "position", name="pk_commit_parent"),
        sa.ForeignKeyConstraint(
            ["dataset_id", "digest"], commit, name="fk_commit_parent_dataset_id_digest_dataset_commit"
        ),
        sa.ForeignKeyConstraint(["dataset_id", "parent"], commit, name="fk_commit_parent_parent"),
    )
    op.create_table(
        "dataset_ref",
        sa.Column("dataset_id", ID, nullable=False),
        sa.Column("name", NAME, nullable=False),
        sa.Column("kind", sa.String(8), nullable=False),
        sa.Column("digest", DIGEST, nullable=True),
        sa.Column("created_us", sa.BigInteger(), nullable=False),
        sa.Column("updated_us", sa.BigInteger(), nullable=False),
        sa.Column("rev", sa.Integer(), nullable=False),
        sa.PrimaryKeyConstraint("dataset_id", "name", name="pk_dataset_ref"),
        sa.ForeignKeyConstraint(["dataset_id"], ["dataset.id"], name="fk_dataset_ref_dataset_id_dataset"),
        sa.ForeignKeyConstraint(
            ["dataset_id", "digest"], commit, name="fk_dataset_ref_dataset_id_digest_dataset_commit"
        ),
    )


def downgrade() -> None:
    """Drop the tables of datasets, with all commits, and the columns for content digests."""
    for table in ("dataset_ref", "commit_parent", "dataset_commit", "dataset", "tree_chunk"):
        op.drop_table(table)
    op.drop_column("revision_part", "content")
    op.drop_index("ix_revision_content", "revision")
    op.drop_column("revision", "content")
