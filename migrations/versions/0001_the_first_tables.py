"""First tables of the database: users, projects, items, documents, blobs, jobs and events."""

import sqlalchemy as sa
from alembic import op
from sqlalchemy.dialects import postgresql

ID = sa.String(40)
DIGEST = sa.String(71)
NAME = sa.String(255).with_variant(sa.String(255, collation="C"), "postgresql")
PATH = sa.String(1024).with_variant(sa.String(1024, collation="C"), "postgresql")
DOCUMENT = sa.JSON().with_variant(postgresql.JSONB(), "postgresql")
SEQUENCE = sa.BigInteger().with_variant(sa.Integer(), "sqlite")

revision = "0001"
down_revision = None
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Create the first tables of the database, with their indexes."""
    op.create_table(
        "blob",
        sa.Column("digest", DIGEST, nullable=False),
        sa.Column("size_bytes", sa.BigInteger(), nullable=False),
        sa.Column("created_us", sa.BigInteger(), nullable=False),
        sa.PrimaryKeyConstraint("digest", name="pk_blob"),
    )
    op.create_index("ix_blob_created_us", "blob", ["created_us"])

    op.create_table(
        "document",
        sa.Column("digest", DIGEST, nullable=False),
        sa.Column("schema", sa.String(length=128), nullable=False),
        sa.Column("body", DOCUMENT, nullable=False),
        sa.Column("size_bytes", sa.BigInteger(), nullable=False),
        sa.Column("created_us", sa.BigInteger(), nullable=False),
        sa.PrimaryKeyConstraint("digest", name="pk_document"),
    )
    op.create_table(
        "event",
        sa.Column("seq", SEQUENCE, autoincrement=True, nullable=False),
        sa.Column("xid", sa.BigInteger(), nullable=False),
        sa.Column("at_us", sa.BigInteger(), nullable=False),
        sa.Column("project_id", ID, nullable=True),
        sa.Column("kind", sa.String(length=64), nullable=False),
        sa.Column("subject", sa.String(length=64), nullable=False),
        sa.Column("actor", sa.String(length=255), nullable=True),
        sa.Column("body", DOCUMENT, nullable=False),
        sa.PrimaryKeyConstraint("seq", name="pk_event"),
        sqlite_autoincrement=True,
    )
    op.create_index("ix_event_feed", "event", ["project_id", "xid", "seq"])
    op.create_index("ix_event_subject", "event", ["subject"])

    op.create_table(
        "idempotency_key",
        sa.Column("principal", sa.String(length=64), nullable=False),
        sa.Column("key", sa.String(length=255), nullable=False),
        sa.Column("fingerprint", DIGEST, nullable=False),
        sa.Column("status", sa.Integer(), nullable=True),
        sa.Column("headers", DOCUMENT, nullable=True),
        sa.Column("body", sa.LargeBinary(), nullable=True),
        sa.Column("created_us", sa.BigInteger(), nullable=False),
        sa.PrimaryKeyConstraint("principal", "key", name="pk_idempotency_key"),
    )
    op.create_index("ix_idempotency_key_created_us", "idempotency_key", ["created_us"])

    op.create_table(
        "leader",
        sa.Column("name", sa.String(length=32), nullable=False),
        sa.Column("holder", sa.String(length=64), nullable=False),
        sa.Column("fence", sa.Integer(), nullable=False),
        sa.Column("expires_us", sa.BigInteger(), nullable=False),
        sa.PrimaryKeyConstraint("name", name="pk_leader"),
    )
    op.create_table(
        "project",
        sa.Column("id", ID, nullable=False),
        sa.Column("name", sa.String(length=64), nullable=False),
        sa.Column("title", sa.String(length=255), nullable=True),
        sa.Column("description", sa.Text(), nullable=False),
        sa.Column("visibility", sa.String(length=16), nullable=False),
        sa.Column("created_us", sa.BigInteger(), nullable=False),
        sa.Column("updated_us", sa.BigInteger(), nullable=False),
        sa.Column("deleted_us", sa.BigInteger(), nullable=True),
        sa.Column("rev", sa.Integer(), nullable=False),
        sa.PrimaryKeyConstraint("id", name="pk_project"),
    )
    op.create_index(
        "uq_project_alive",
        "project",
        ["name"],
        unique=True,
        sqlite_where=sa.text("deleted_us IS NULL"),
        postgresql_where=sa.text("deleted_us IS NULL"),
    )

    op.create_table(
        "server_state",
        sa.Column("key", sa.String(length=64), nullable=False),
        sa.Column("value", DOCUMENT, nullable=False),
        sa.PrimaryKeyConstraint("key", name="pk_server_state"),
    )
    op.create_table(
        "user",
        sa.Column("id", ID, nullable=False),
        sa.Column("name", sa.String(length=64), nullable=False),
        sa.Column("display_name", sa.String(length=255), nullable=True),
        sa.Column("password_hash", sa.Text(), nullable=True),
        sa.Column("administrator", sa.Boolean(), nullable=False),
        sa.Column("disabled", sa.Boolean(), nullable=False),
        sa.Column("created_us", sa.BigInteger(), nullable=False),
        sa.Column("rev", sa.Integer(), nullable=False),
        sa.PrimaryKeyConstraint("id", name="pk_user"),
        sa.UniqueConstraint("name", name="uq_user_name"),
    )
    op.create_table(
        "blob_chunk",
        sa.Column("digest", DIGEST, nullable=False),
        sa.Column("position", sa.Integer(), nullable=False),
        sa.Column("data", sa.LargeBinary(), nullable=False),
        sa.ForeignKeyConstraint(["digest"], ["blob.digest"], name="fk_blob_chunk_digest_blob"),
        sa.PrimaryKeyConstraint("digest", "position", name="pk_blob_chunk"),
    )
    op.create_table(
        "blob_holder",
        sa.Column("digest", DIGEST, nullable=False),
        sa.Column("user_id", ID, nullable=False),
        sa.Column("created_us", sa.BigInteger(), nullable=False),
        sa.ForeignKeyConstraint(["digest"], ["blob.digest"], name="fk_blob_holder_digest_blob"),
        sa.ForeignKeyConstraint(["user_id"], ["user.id"], name="fk_blob_holder_user_id_user"),
        sa.PrimaryKeyConstraint("digest", "user_id", name="pk_blob_holder"),
    )
    op.create_table(
        "collection",
        sa.Column("id", ID, nullable=False),
        sa.Column("project_id", ID, nullable=False),
        sa.Column("path", PATH, nullable=False),
        sa.Column("created_us", sa.BigInteger(), nullable=False),
        sa.Column("updated_us", sa.BigInteger(), nullable=False),
        sa.Column("deleted_us", sa.BigInteger(), nullable=True),
        sa.Column("rev", sa.Integer(), nullable=False),
        sa.ForeignKeyConstraint(["project_id"], ["project.id"], name="fk_collection_project_id_project"),
        sa.PrimaryKeyConstraint("id", name="pk_collection"),
    )
    op.create_index(
        "uq_collection_alive",
        "collection",
        ["project_id", "path"],
        unique=True,
        sqlite_where=sa.text("deleted_us IS NULL"),
        postgresql_where=sa.text("deleted_us IS NULL"),
    )

    op.create_table(
        "document_blob",
        sa.Column("document_digest", DIGEST, nullable=False),
        sa.Column("pointer", sa.String(length=512), nullable=False),
        sa.Column("blob_digest", DIGEST, nullable=False),
        sa.ForeignKeyConstraint(["blob_digest"], ["blob.digest"], name="fk_document_blob_blob_digest_blob"),
        sa.ForeignKeyConstraint(
            ["document_digest"], ["document.digest"], name="fk_document_blob_document_digest_document"
        ),
        sa.PrimaryKeyConstraint("document_digest", "pointer", name="pk_document_blob"),
    )
    op.create_index("ix_document_blob_blob_digest", "document_blob", ["blob_digest"])

    op.create_table(
        "job",
        sa.Column("id", ID, nullable=False),
        sa.Column("project_id", ID, nullable=False),
        sa.Column("kind", sa.String(length=64), nullable=False),
        sa.Column("state", sa.String(length=16), nullable=False),
        sa.Column("params", DOCUMENT, nullable=False),
        sa.Column("inputs", DOCUMENT, nullable=False),
        sa.Column("into_path", sa.String(length=1024), nullable=False),
        sa.Column("priority", sa.Integer(), nullable=False),
        sa.Column("seed", sa.BigInteger(), nullable=False),
        sa.Column("labels_key", sa.String(length=512), nullable=False),
        sa.Column("time_limit_s", sa.Integer(), nullable=False),
        sa.Column("memory_limit_mb", sa.Integer(), nullable=False),
        sa.Column("max_attempts", sa.Integer(), nullable=False),
        sa.Column("attempt", sa.Integer(), nullable=False),
        sa.Column("interruptions", sa.Integer(), nullable=False),
        sa.Column("fence", sa.Integer(), nullable=False),
        sa.Column("run_at_us", sa.BigInteger(), nullable=False),
        sa.Column("lease_expires_us", sa.BigInteger(), nullable=True),
        sa.Column("deadline_us", sa.BigInteger(), nullable=True),
        sa.Column("cancel_requested_us", sa.BigInteger(), nullable=True),
        sa.Column("result", DOCUMENT, nullable=True),
        sa.Column("outputs", DOCUMENT, nullable=True),
        sa.Column("failure", DOCUMENT, nullable=True),
        sa.Column("progress", DOCUMENT, nullable=True),
        sa.Column("publish_conflict", DOCUMENT, nullable=True),
        sa.Column("parent_id", ID, nullable=True),
        sa.Column("position", sa.Integer(), nullable=True),
        sa.Column("size", sa.Integer(), nullable=True),
        sa.Column("dependencies_left", sa.Integer(), nullable=False),
        sa.Column("on_failure", sa.String(length=8), nullable=False),
        sa.Column("concurrency_key", sa.String(length=255), nullable=True),
        sa.Column("cache_mode", sa.String(length=8), nullable=False),
        sa.Column("cache_key", DIGEST, nullable=True),
        sa.Column("cached_from", ID, nullable=True),
        sa.Column("retry_of", ID, nullable=True),
        sa.Column("code_version", sa.String(length=255), nullable=True),
        sa.Column("environment", DOCUMENT, nullable=True),
        sa.Column("author_id", ID, nullable=True),
        sa.Column("message", sa.Text(), nullable=False),
        sa.Column("created_us", sa.BigInteger(), nullable=False),
        sa.Column("started_us", sa.BigInteger(), nullable=True),
        sa.Column("finished_us", sa.BigInteger(), nullable=True),
        sa.Column("rev", sa.Integer(), nullable=False),
        sa.ForeignKeyConstraint(["author_id"], ["user.id"], name="fk_job_author_id_user"),
        sa.ForeignKeyConstraint(["parent_id"], ["job.id"], name="fk_job_parent_id_job"),
        sa.ForeignKeyConstraint(["project_id"], ["project.id"], name="fk_job_project_id_project"),
        sa.PrimaryKeyConstraint("id", name="pk_job"),
    )
    op.create_index("ix_job_cache", "job", ["project_id", "cache_key"])
    op.create_index(
        "ix_job_expiry",
        "job",
        ["lease_expires_us"],
        sqlite_where=sa.text("state = 'running'"),
        postgresql_where=sa.text("state = 'running'"),
    )
    op.create_index("ix_job_listing", "job", ["project_id", "id"])
    op.create_index("ix_job_parent_id", "job", ["parent_id"])
    op.create_index(
        "ix_job_sharing",
        "job",
        ["cached_from"],
        sqlite_where=sa.text("state = 'waiting' AND cached_from IS NOT NULL"),
        postgresql_where=sa.text("state = 'waiting' AND cached_from IS NOT NULL"),
    )
    op.create_index(
        "uq_job_concurrency",
        "job",
        ["project_id", "concurrency_key"],
        unique=True,
        sqlite_where=sa.text("state = 'running' AND concurrency_key IS NOT NULL"),
        postgresql_where=sa.text("state = 'running' AND concurrency_key IS NOT NULL"),
    )

    op.create_table(
        "member",
        sa.Column("project_id", ID, nullable=False),
        sa.Column("user_id", ID, nullable=False),
        sa.Column("role", sa.String(length=16), nullable=False),
        sa.Column("since_us", sa.BigInteger(), nullable=False),
        sa.Column("rev", sa.Integer(), nullable=False),
        sa.ForeignKeyConstraint(["project_id"], ["project.id"], name="fk_member_project_id_project"),
        sa.ForeignKeyConstraint(["user_id"], ["user.id"], name="fk_member_user_id_user"),
        sa.PrimaryKeyConstraint("project_id", "user_id", name="pk_member"),
    )
    op.create_index("ix_member_user_id", "member", ["user_id"])

    op.create_table(
        "token",
        sa.Column("id", ID, nullable=False),
        sa.Column("user_id", ID, nullable=False),
        sa.Column("name", sa.String(length=255), nullable=False),
        sa.Column("prefix", sa.String(length=16), nullable=False),
        sa.Column("secret_hash", sa.String(length=64), nullable=False),
        sa.Column("scopes", DOCUMENT, nullable=False),
        sa.Column("created_us", sa.BigInteger(), nullable=False),
        sa.Column("expires_us", sa.BigInteger(), nullable=True),
        sa.Column("last_used_us", sa.BigInteger(), nullable=True),
        sa.ForeignKeyConstraint(["user_id"], ["user.id"], name="fk_token_user_id_user"),
        sa.PrimaryKeyConstraint("id", name="pk_token"),
        sa.UniqueConstraint("prefix", name="uq_token_prefix"),
    )
    op.create_index("ix_token_user_id", "token", ["user_id"])

    op.create_table(
        "upload",
        sa.Column("id", ID, nullable=False),
        sa.Column("user_id", ID, nullable=False),
        sa.Column("length", sa.BigInteger(), nullable=False),
        sa.Column("offset", sa.BigInteger(), nullable=False),
        sa.Column("digest", DIGEST, nullable=True),
        sa.Column("created_us", sa.BigInteger(), nullable=False),
        sa.Column("updated_us", sa.BigInteger(), nullable=False),
        sa.Column("finished_digest", DIGEST, nullable=True),
        sa.ForeignKeyConstraint(["user_id"], ["user.id"], name="fk_upload_user_id_user"),
        sa.PrimaryKeyConstraint("id", name="pk_upload"),
    )
    op.create_index("ix_upload_updated_us", "upload", ["updated_us"])
    op.create_index("ix_upload_user_id", "upload", ["user_id"])

    op.create_table(
        "attempt",
        sa.Column("job_id", ID, nullable=False),
        sa.Column("fence", sa.Integer(), nullable=False),
        sa.Column("worker", sa.String(length=255), nullable=False),
        sa.Column("claimed_by", ID, nullable=True),
        sa.Column("token_hash", sa.String(length=64), nullable=False),
        sa.Column("started_us", sa.BigInteger(), nullable=False),
        sa.Column("ended_us", sa.BigInteger(), nullable=True),
        sa.Column("outcome", sa.String(length=16), nullable=True),
        sa.Column("detail", sa.Text(), nullable=True),
        sa.Column("signature", sa.String(length=255), nullable=True),
        sa.Column("write_id", sa.String(length=64), nullable=True),
        sa.Column("answer", DOCUMENT, nullable=True),
        sa.Column("log_bytes", sa.BigInteger(), nullable=False),
        sa.ForeignKeyConstraint(["job_id"], ["job.id"], name="fk_attempt_job_id_job"),
        sa.PrimaryKeyConstraint("job_id", "fence", name="pk_attempt"),
        sa.UniqueConstraint("token_hash", name="uq_attempt_token_hash"),
    )
    op.create_table(
        "item",
        sa.Column("id", ID, nullable=False),
        sa.Column("project_id", ID, nullable=False),
        sa.Column("collection_id", ID, nullable=False),
        sa.Column("kind", sa.String(length=16), nullable=False),
        sa.Column("name", NAME, nullable=False),
        sa.Column("name_folded", sa.Text(), nullable=False),
        sa.Column("head", sa.Integer(), nullable=False),
        sa.Column("summary", DOCUMENT, nullable=False),
        sa.Column("frames", sa.Integer(), nullable=False),
        sa.Column("skeleton_id", ID, nullable=True),
        sa.Column("created_us", sa.BigInteger(), nullable=False),
        sa.Column("updated_us", sa.BigInteger(), nullable=False),
        sa.Column("deleted_us", sa.BigInteger(), nullable=True),
        sa.Column("rev", sa.Integer(), nullable=False),
        sa.ForeignKeyConstraint(["collection_id"], ["collection.id"], name="fk_item_collection_id_collection"),
        sa.ForeignKeyConstraint(["project_id"], ["project.id"], name="fk_item_project_id_project"),
        sa.PrimaryKeyConstraint("id", name="pk_item"),
    )
    op.create_index("ix_item_by_creation", "item", ["project_id", "kind", "created_us", "id"])
    op.create_index("ix_item_by_frames", "item", ["project_id", "kind", "frames", "id"])
    op.create_index("ix_item_by_name", "item", ["project_id", "kind", "name", "id"])
    op.create_index("ix_item_by_update", "item", ["project_id", "kind", "updated_us", "id"])
    op.create_index("ix_item_collection_id", "item", ["collection_id"])
    op.create_index("ix_item_listing", "item", ["project_id", "kind", "id"])
    op.create_index("ix_item_skeleton_id", "item", ["skeleton_id"])
    op.create_index(
        "uq_item_alive",
        "item",
        ["collection_id", "kind", "name"],
        unique=True,
        sqlite_where=sa.text("deleted_us IS NULL"),
        postgresql_where=sa.text("deleted_us IS NULL"),
    )

    op.create_table(
        "job_blob",
        sa.Column("job_id", ID, nullable=False),
        sa.Column("blob_digest", DIGEST, nullable=False),
        sa.ForeignKeyConstraint(["blob_digest"], ["blob.digest"], name="fk_job_blob_blob_digest_blob"),
        sa.ForeignKeyConstraint(["job_id"], ["job.id"], name="fk_job_blob_job_id_job"),
        sa.PrimaryKeyConstraint("job_id", "blob_digest", name="pk_job_blob"),
    )
    op.create_index("ix_job_blob_blob_digest", "job_blob", ["blob_digest"])

    op.create_table(
        "job_dependency",
        sa.Column("job_id", ID, nullable=False),
        sa.Column("on_job_id", ID, nullable=False),
        sa.Column("satisfied", sa.Boolean(), nullable=False),
        sa.ForeignKeyConstraint(["job_id"], ["job.id"], name="fk_job_dependency_job_id_job"),
        sa.ForeignKeyConstraint(["on_job_id"], ["job.id"], name="fk_job_dependency_on_job_id_job"),
        sa.PrimaryKeyConstraint("job_id", "on_job_id", name="pk_job_dependency"),
    )
    op.create_index("ix_job_dependency_on_job_id", "job_dependency", ["on_job_id"])

    op.create_table(
        "upload_chunk",
        sa.Column("upload_id", ID, nullable=False),
        sa.Column("offset", sa.BigInteger(), nullable=False),
        sa.Column("data", sa.LargeBinary(), nullable=False),
        sa.ForeignKeyConstraint(["upload_id"], ["upload.id"], name="fk_upload_chunk_upload_id_upload"),
        sa.PrimaryKeyConstraint("upload_id", "offset", name="pk_upload_chunk"),
    )
    op.create_table(
        "item_tag",
        sa.Column("item_id", ID, nullable=False),
        sa.Column("tag", sa.String(length=64), nullable=False),
        sa.ForeignKeyConstraint(["item_id"], ["item.id"], name="fk_item_tag_item_id_item"),
        sa.PrimaryKeyConstraint("item_id", "tag", name="pk_item_tag"),
    )
    op.create_index("ix_item_tag_tag", "item_tag", ["tag"])

    op.create_table(
        "job_log",
        sa.Column("job_id", ID, nullable=False),
        sa.Column("fence", sa.Integer(), nullable=False),
        sa.Column("offset", sa.BigInteger(), nullable=False),
        sa.Column("data", sa.LargeBinary(), nullable=False),
        sa.ForeignKeyConstraint(
            ["job_id", "fence"], ["attempt.job_id", "attempt.fence"], name="fk_job_log_job_id_fence_attempt"
        ),
        sa.PrimaryKeyConstraint("job_id", "fence", "offset", name="pk_job_log"),
    )
    op.create_table(
        "revision",
        sa.Column("item_id", ID, nullable=False),
        sa.Column("number", sa.Integer(), nullable=False),
        sa.Column("author_id", ID, nullable=True),
        sa.Column("message", sa.Text(), nullable=False),
        sa.Column("job_id", ID, nullable=True),
        sa.Column("created_us", sa.BigInteger(), nullable=False),
        sa.ForeignKeyConstraint(["author_id"], ["user.id"], name="fk_revision_author_id_user"),
        sa.ForeignKeyConstraint(["item_id"], ["item.id"], name="fk_revision_item_id_item"),
        sa.PrimaryKeyConstraint("item_id", "number", name="pk_revision"),
    )
    op.create_index("ix_revision_job_id", "revision", ["job_id"])

    op.create_table(
        "staged_output",
        sa.Column("job_id", ID, nullable=False),
        sa.Column("fence", sa.Integer(), nullable=False),
        sa.Column("name", sa.String(length=1500), nullable=False),
        sa.Column("position", sa.Integer(), nullable=False),
        sa.Column("draft", DOCUMENT, nullable=False),
        sa.ForeignKeyConstraint(
            ["job_id", "fence"], ["attempt.job_id", "attempt.fence"], name="fk_staged_output_job_id_fence_attempt"
        ),
        sa.PrimaryKeyConstraint("job_id", "fence", "name", name="pk_staged_output"),
    )
    op.create_table(
        "lineage",
        sa.Column("item_id", ID, nullable=False),
        sa.Column("number", sa.Integer(), nullable=False),
        sa.Column("role", sa.String(length=64), nullable=False),
        sa.Column("position", sa.Integer(), nullable=False),
        sa.Column("input_item_id", ID, nullable=False),
        sa.Column("input_number", sa.Integer(), nullable=False),
        sa.Column("job_id", ID, nullable=True),
        sa.ForeignKeyConstraint(
            ["input_item_id", "input_number"], ["revision.item_id", "revision.number"], name="fk_lineage_input"
        ),
        sa.ForeignKeyConstraint(
            ["item_id", "number"], ["revision.item_id", "revision.number"], name="fk_lineage_item_id_number_revision"
        ),
        sa.PrimaryKeyConstraint("item_id", "number", "role", "position", name="pk_lineage"),
    )
    op.create_index("ix_lineage_input", "lineage", ["input_item_id", "input_number"])
    op.create_index("ix_lineage_job_id", "lineage", ["job_id"])

    op.create_table(
        "revision_part",
        sa.Column("item_id", ID, nullable=False),
        sa.Column("number", sa.Integer(), nullable=False),
        sa.Column("part", sa.String(length=32), nullable=False),
        sa.Column("document_digest", DIGEST, nullable=False),
        sa.ForeignKeyConstraint(
            ["document_digest"], ["document.digest"], name="fk_revision_part_document_digest_document"
        ),
        sa.ForeignKeyConstraint(
            ["item_id", "number"],
            ["revision.item_id", "revision.number"],
            name="fk_revision_part_item_id_number_revision",
        ),
        sa.PrimaryKeyConstraint("item_id", "number", "part", name="pk_revision_part"),
    )
    op.create_index("ix_revision_part_document_digest", "revision_part", ["document_digest"])

    op.create_index(
        "ix_job_claim",
        "job",
        [sa.text("priority DESC"), "run_at_us", "id", "kind", "labels_key"],
        sqlite_where=sa.text("state = 'queued'"),
        postgresql_where=sa.text("state = 'queued'"),
    )
    op.create_index(
        "ix_job_concurrency",
        "job",
        ["project_id", "concurrency_key", sa.text("priority DESC"), "run_at_us", "id"],
        sqlite_where=sa.text("state = 'queued' AND concurrency_key IS NOT NULL"),
        postgresql_where=sa.text("state = 'queued' AND concurrency_key IS NOT NULL"),
    )


def downgrade() -> None:
    """Drop all tables that `upgrade` has created, with their data."""
    op.drop_table("revision_part")
    op.drop_table("lineage")
    op.drop_table("staged_output")
    op.drop_table("revision")
    op.drop_table("job_log")
    op.drop_table("item_tag")
    op.drop_table("upload_chunk")
    op.drop_table("job_dependency")
    op.drop_table("job_blob")
    op.drop_table("item")
    op.drop_table("attempt")
    op.drop_table("upload")
    op.drop_table("token")
    op.drop_table("member")
    op.drop_table("job")
    op.drop_table("document_blob")
    op.drop_table("collection")
    op.drop_table("blob_holder")
    op.drop_table("blob_chunk")
    op.drop_table("user")
    op.drop_table("server_state")
    op.drop_table("project")
    op.drop_table("leader")
    op.drop_table("idempotency_key")
    op.drop_table("event")
    op.drop_table("document")
    op.drop_table("blob")
