"""Records of who possesses a blob, by project and by attempt."""

import sqlalchemy as sa
from alembic import op
from sqlalchemy.dialects import postgresql

ID = sa.String(40)
DIGEST = sa.String(71)
DOCUMENT = sa.JSON().with_variant(postgresql.JSONB(), "postgresql")

revision = "0009"
down_revision = "0008"
branch_labels = None
depends_on = None

OF_RUNNING_ATTEMPTS = """
    INSERT INTO attempt_blob (digest, job_id, fence, created_us)
    SELECT blob_holder.digest, job.id, job.fence, blob_holder.created_us
    FROM job
    JOIN attempt ON attempt.job_id = job.id AND attempt.fence = job.fence
    JOIN blob_holder ON blob_holder.user_id = job.author_id AND blob_holder.created_us >= attempt.started_us
    WHERE job.state = 'running'
"""

FOR_EVERY_PROJECT = """
    INSERT INTO blob_holder (digest, user_id, project_id, created_us)
    SELECT digest, user_id, '', MIN(created_us) FROM blob_holder AS held
    WHERE NOT EXISTS (
        SELECT 1 FROM blob_holder AS known
        WHERE known.digest = held.digest AND known.user_id = held.user_id AND known.project_id = ''
    )
    GROUP BY digest, user_id
"""


def upgrade() -> None:
    """Add the project to each record of possession, and create a table of the blobs that attempts possess.

    A blob that a user sent before the upgrade belongs to the user in every project. So tokens that are not bound to
    projects can use the blob as before. Tokens that are bound to projects can use only the blobs to which these
    projects refer; clients must send other blobs again. Running attempts keep the blobs that they have sent.
    """
    op.create_table(
        "attempt_blob",
        sa.Column("digest", DIGEST, nullable=False),
        sa.Column("job_id", ID, nullable=False),
        sa.Column("fence", sa.Integer(), nullable=False),
        sa.Column("created_us", sa.BigInteger(), nullable=False),
        sa.ForeignKeyConstraint(["digest"], ["blob.digest"], name="fk_attempt_blob_digest_blob"),
        sa.PrimaryKeyConstraint("digest", "job_id", "fence", name="pk_attempt_blob"),
    )
    op.create_index("ix_attempt_blob_attempt", "attempt_blob", ["job_id", "fence"])
    op.execute(OF_RUNNING_ATTEMPTS)
    with op.batch_alter_table("blob_holder") as table:
        table.add_column(sa.Column("project_id", ID, nullable=False, server_default=""))
        table.drop_constraint("pk_blob_holder", type_="primary")
        table.create_primary_key("pk_blob_holder", ["digest", "user_id", "project_id"])
    with op.batch_alter_table("blob_holder") as table:
        table.alter_column("project_id", server_default=None)
    op.add_column("upload", sa.Column("job_id", ID))
    op.add_column("upload", sa.Column("fence", sa.Integer()))
    op.add_column("upload", sa.Column("project_ids", DOCUMENT))


def downgrade() -> None:
    """Let each user possess the same blobs in every project again, and drop the records of attempts."""
    for column in ("project_ids", "fence", "job_id"):
        op.drop_column("upload", column)
    op.execute(FOR_EVERY_PROJECT)
    op.execute("DELETE FROM blob_holder WHERE project_id <> ''")
    with op.batch_alter_table("blob_holder") as table:
        table.drop_constraint("pk_blob_holder", type_="primary")
        table.drop_column("project_id")
        table.create_primary_key("pk_blob_holder", ["digest", "user_id"])
    op.drop_index("ix_attempt_blob_attempt", "attempt_blob")
    op.drop_table("attempt_blob")
