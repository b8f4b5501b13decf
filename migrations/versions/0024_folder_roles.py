"""Roles of members in folders."""

import sqlalchemy as sa
from alembic import op

revision = "0024"
down_revision = "0023"
branch_labels = None
depends_on = None

ID = sa.String(40)


def upgrade() -> None:
    """Create the table `folder_role`."""
    op.create_table(
        "folder_role",
        sa.Column("project_id", ID, nullable=False),
        sa.Column("user_id", ID, nullable=False),
        sa.Column("collection_id", ID, nullable=False),
        sa.Column("role", sa.String(16), nullable=False),
        sa.Column("since_us", sa.BigInteger, nullable=False),
        sa.Column("rev", sa.Integer, nullable=False),
        sa.PrimaryKeyConstraint("project_id", "user_id", "collection_id", name="pk_folder_role"),
        sa.ForeignKeyConstraint(["project_id"], ["project.id"], name="fk_folder_role_project_id_project"),
        sa.ForeignKeyConstraint(["collection_id"], ["collection.id"], name="fk_folder_role_collection_id_collection"),
    )
    op.create_index("ix_folder_role_collection_id", "folder_role", ["collection_id"])


def downgrade() -> None:
    """Drop the table `folder_role`."""
    op.drop_table("folder_role")
