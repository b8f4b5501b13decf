"""Tables of the database, for SQLite and Postgres. Times are integer microseconds since the epoch, UTC, named `_us`."""

from sqlalchemy import (
    JSON,
    BigInteger,
    Boolean,
    Column,
    ForeignKey,
    ForeignKeyConstraint,
    Index,
    Integer,
    LargeBinary,
    MetaData,
    String,
    Table,
    Text,
    false,
    text,
)
from sqlalchemy.dialects.postgresql import JSONB

NAMING = {
    "ix": "ix_%(table_name)s_%(column_0_N_name)s",
    "uq": "uq_%(table_name)s_%(column_0_N_name)s",
    "ck": "ck_%(table_name)s_%(constraint_name)s",
    "fk": "fk_%(table_name)s_%(column_0_N_name)s_%(referred_table_name)s",
    "pk": "pk_%(table_name)s",
}
metadata = MetaData(naming_convention=NAMING)

Document = JSON().with_variant(JSONB(), "postgresql")
Micros = BigInteger
Sequence64 = BigInteger().with_variant(Integer(), "sqlite")  # SQLite numbers rows by itself only for INTEGER keys
ID = String(40)
Name = String(255).with_variant(String(255, collation="C"), "postgresql")  # by code point, as SQLite sorts
Path = String(1024).with_variant(String(1024, collation="C"), "postgresql")
DIGEST = String(71)


def _alive(table: str, *columns: str) -> Index:
    """Return a unique index over rows that are not deleted, so that a deleted name can be used again."""
    condition = text("deleted_us IS NULL")
    return Index(f"uq_{table}_alive", *columns, unique=True, sqlite_where=condition, postgresql_where=condition)


user = Table(
    "user",
    metadata,
    Column("id", ID, primary_key=True),
    Column("name", String(64), nullable=False, unique=True),
    Column("display_name", String(255)),
    Column("password_hash", Text),
    Column("administrator", Boolean, nullable=False, default=False),
    Column("disabled", Boolean, nullable=False, default=False),
    Column("created_us", Micros, nullable=False),
    Column("rev", Integer, nullable=False, default=1),
)

token = Table(
    "token",
    metadata,
    Column("id", ID, primary_key=True),
    Column("user_id", ID, ForeignKey("user.id"), nullable=False, index=True),
    Column("name", String(255), nullable=False),
    Column("prefix", String(16), nullable=False, unique=True),
    Column("secret_hash", String(64), nullable=False),
    Column("scopes", Document, nullable=False),
    Column("created_us", Micros, nullable=False),
    Column("expires_us", Micros),
    Column("last_used_us", Micros),
    Column("session", Boolean, nullable=False, default=False, server_default=false()),  # made by a sign-in
    Column("created_by", ID),  # the token whose bearer created it
    Column("labels", Document),  # that its workers may announce; null: any
    Column("rotation_hash", String(64)),  # hash of the id of the rotation that replaced it
    Column("successor_of", ID),  # the token that it replaced
    Index("uq_token_successor_of", "successor_of", unique=True),
)

sign_in_limit = Table(  # sign-ins, and other things that are limited in the same way
    "sign_in_limit",
    metadata,
    Column("key", String(64), primary_key=True),  # hash of a limit's name, and of what it is for
    Column("until_us", Micros, nullable=False, index=True),  # from then on the row says nothing
)

project = Table(
    "project",
    metadata,
    Column("id", ID, primary_key=True),
    Column("name", String(64), nullable=False),
    Column("title", String(255)),
    Column("description", Text, nullable=False, default=""),
    Column("visibility", String(16), nullable=False),
    Column("created_us", Micros, nullable=False),
    Column("updated_us", Micros, nullable=False),
    Column("deleted_us", Micros),
    Column("rev", Integer, nullable=False, default=1),
    _alive("project", "name"),
)

holding = Table(  # what a project or a user holds, and limits other than those of the settings
    "holding",
    metadata,
    Column("owner_id", ID, primary_key=True),  # of a project, or of a user
    Column("items", BigInteger, nullable=False, default=0, server_default=text("0")),
    Column("stored_bytes", BigInteger, nullable=False, default=0, server_default=text("0")),
    Column("limits", Document, nullable=False),  # by the name of the quota
)

member = Table(
    "member",
    metadata,
    Column("project_id", ID, ForeignKey("project.id"), primary_key=True),
    Column("user_id", ID, ForeignKey("user.id"), primary_key=True, index=True),
    Column("role", String(16), nullable=False),
    Column("since_us", Micros, nullable=False),
    Column("rev", Integer, nullable=False, default=1),
)

collection = Table(
    "collection",
    metadata,
    Column("id", ID, primary_key=True),
    Column("project_id", ID, ForeignKey("project.id"), nullable=False),
    Column("path", Path, nullable=False),
    Column("created_us", Micros, nullable=False),
    Column("updated_us", Micros, nullable=False),
    Column("deleted_us", Micros),
    Column("rev", Integer, nullable=False, default=1),
    _alive("collection", "project_id", "path"),
)

item = Table(
    "item",
    metadata,
    Column("id", ID, primary_key=True),
    Column("project_id", ID, ForeignKey("project.id"), nullable=False),
    Column("collection_id", ID, ForeignKey("collection.id"), nullable=False, index=True),
    Column("kind", String(16), nullable=False),
    Column("name", Name, nullable=False),
    Column("name_folded", Text, nullable=False),  # for searches that do not see case, in any script
    Column("head", Integer, nullable=False),
    Column("summary", Document, nullable=False),
    Column("frames", Integer, nullable=False, default=0),
    Column("skeleton_id", ID, index=True),
    Column("creator_id", ID),  # the user for whom the item counts; null for the server
    Column("stored_bytes", BigInteger, nullable=False, default=0, server_default=text("0")),  # of all its revisions
    Column("created_us", Micros, nullable=False),
    Column("updated_us", Micros, nullable=False),
    Column("deleted_us", Micros),
    Column("rev", Integer, nullable=False, default=1),
    _alive("item", "collection_id", "kind", "name"),
    Index("ix_item_listing", "project_id", "kind", "id"),
    Index("ix_item_by_name", "project_id", "kind", "name", "id"),
    Index("ix_item_by_creation", "project_id", "kind", "created_us", "id"),
    Index("ix_item_by_update", "project_id", "kind", "updated_us", "id"),
    Index("ix_item_by_frames", "project_id", "kind", "frames", "id"),
)

item_tag = Table(
    "item_tag",
    metadata,
    Column("item_id", ID, ForeignKey("item.id"), primary_key=True),
    Column("tag", String(64), primary_key=True, index=True),
)

revision = Table(
    "revision",
    metadata,
    Column("item_id", ID, ForeignKey("item.id"), primary_key=True),
    Column("number", Integer, primary_key=True),
    Column("author_id", ID, ForeignKey("user.id")),
    Column("message", Text, nullable=False, default=""),
    Column("job_id", ID, index=True),
    Column("created_us", Micros, nullable=False),
    Column("content", DIGEST, index=True),  # digest that every server gives to the same content; null: not needed yet
)

revision_part = Table(
    "revision_part",
    metadata,
    Column("item_id", ID, primary_key=True),
    Column("number", Integer, primary_key=True),
    Column("part", String(32), primary_key=True),
    Column("document_digest", DIGEST, ForeignKey("document.digest"), nullable=False, index=True),
    Column("content", DIGEST),  # as that of the revision; null if the document's own digest is the same everywhere
    ForeignKeyConstraint(["item_id", "number"], ["revision.item_id", "revision.number"]),
)

document = Table(
    "document",
    metadata,
    Column("digest", DIGEST, primary_key=True),
    Column("schema", String(128), nullable=False),
    Column("body", Document, nullable=False),  # array leaves stand as {"dtype", "shape", "content"}
    Column("size_bytes", BigInteger, nullable=False),
    Column("file_bytes", BigInteger, nullable=False, default=0, server_default=text("0")),  # of the files it names
    Column("created_us", Micros, nullable=False),
)

document_blob = Table(
    "document_blob",
    metadata,
    Column("document_digest", DIGEST, ForeignKey("document.digest"), primary_key=True),
    Column("pointer", String(512), primary_key=True),  # JSON Pointer of the array leaf or of the digest in `body`
    Column("blob_digest", DIGEST, ForeignKey("blob.digest"), nullable=False, index=True),
)

_OF_UPLOAD = text("upload_id IS NOT NULL")

blob = Table(
    "blob",
    metadata,
    Column("digest", DIGEST, primary_key=True),
    Column("size_bytes", BigInteger, nullable=False),
    Column("created_us", Micros, nullable=False, index=True),
    Column("upload_id", ID),  # of the upload whose pieces are the bytes; null: they are in the backing
    Index("ix_blob_upload", "upload_id", sqlite_where=_OF_UPLOAD, postgresql_where=_OF_UPLOAD),
)

blob_chunk = Table(
    "blob_chunk",
    metadata,
    Column("digest", DIGEST, ForeignKey("blob.digest"), primary_key=True),
    Column("position", Integer, primary_key=True),
    Column("data", LargeBinary, nullable=False),
)

blob_holder = Table(  # users who have shown to possess the bytes, and so may refer to them by name
    "blob_holder",
    metadata,
    Column("digest", DIGEST, ForeignKey("blob.digest"), primary_key=True),
    Column("user_id", ID, ForeignKey("user.id"), primary_key=True),
    Column("project_id", ID, primary_key=True, default=""),  # empty: for every project of the user
    Column("created_us", Micros, nullable=False),
)

attempt_blob = Table(  # the same for attempts, which possess nothing of their authors
    "attempt_blob",
    metadata,
    Column("digest", DIGEST, ForeignKey("blob.digest"), primary_key=True),
    Column("job_id", ID, primary_key=True),
    Column("fence", Integer, primary_key=True),
    Column("created_us", Micros, nullable=False),
    Index("ix_attempt_blob_attempt", "job_id", "fence"),
)

lineage = Table(
    "lineage",
    metadata,
    Column("item_id", ID, primary_key=True),
    Column("number", Integer, primary_key=True),
    Column("role", String(64), primary_key=True),
    Column("position", Integer, primary_key=True),
    Column("input_item_id", ID, nullable=False),
    Column("input_number", Integer, nullable=False),
    Column("job_id", ID, index=True),
    ForeignKeyConstraint(["item_id", "number"], ["revision.item_id", "revision.number"]),
    ForeignKeyConstraint(
        ["input_item_id", "input_number"], ["revision.item_id", "revision.number"], name="fk_lineage_input"
    ),
    Index("ix_lineage_input", "input_item_id", "input_number"),
)

UNFINISHED = text("state IN ('waiting', 'queued', 'running')")
"""Condition of `ix_job_unfinished`, written in the form in which SQLite uses this index."""

ONE_RUNS_PER_KEY = "uq_job_concurrency"
"""Index that refuses a second running job of a concurrency key; a concurrent claim that violates it picks again."""

job = Table(
    "job",
    metadata,
    Column("id", ID, primary_key=True),
    Column("project_id", ID, ForeignKey("project.id"), nullable=False),
    Column("kind", String(64), nullable=False),
    Column("state", String(16), nullable=False),
    Column("params", Document, nullable=False),
    Column("inputs", Document, nullable=False),  # {name: [{item, revision, kind, name, collection}]}, pinned
    Column("unbound", Boolean, nullable=False, default=False, server_default=false()),  # some inputs are still {job}
    Column("into_path", String(1024), nullable=False, default=""),
    Column("priority", Integer, nullable=False, default=0),
    Column("seed", BigInteger, nullable=False, default=0),
    Column("labels_key", String(512), nullable=False, default=""),  # "a=1,b=2", sorted; a worker enumerates its subsets
    Column("time_limit_s", Integer, nullable=False),
    Column("memory_limit_mb", Integer, nullable=False),
    Column("max_attempts", Integer, nullable=False, default=3),
    Column("attempt", Integer, nullable=False, default=0),
    Column("interruptions", Integer, nullable=False, default=0),
    Column("unstarted", Integer, nullable=False, default=0, server_default=text("0")),  # claims lost before any write
    Column("fence", Integer, nullable=False, default=0),
    Column("counted_fence", Integer, nullable=False, default=0, server_default=text("0")),  # last one in `attempt`
    Column("run_at_us", Micros, nullable=False),
    Column("lease_expires_us", Micros),
    Column("deadline_us", Micros),
    Column("cancel_requested_us", Micros),
    Column("result", Document),
    Column("outputs", Document),  # [{name, item, kind, revision, created}], what the job published
    Column("failure", Document),
    Column("progress", Document),
    Column("publish_conflict", Document),  # why the outputs are not on the branch that `commit_to` names
    Column("commit_to", Document),  # where the job commits its outputs, as `store.jobs.commits` describes it
    Column("committed", DIGEST),  # commit that has the outputs
    Column("parent_id", ID, ForeignKey("job.id"), index=True),
    Column("position", Integer),
    Column("size", Integer),  # set for the parent job of a fan-out, which depends on its tasks
    Column("gathers", Boolean, nullable=False, default=False, server_default=false()),  # it is worked on after them
    Column("dependencies_left", Integer, nullable=False, default=0),
    Column("on_failure", String(8), nullable=False, default="fail"),
    Column("concurrency_key", String(255)),
    Column("cache_mode", String(8), nullable=False, default="use"),
    Column("cache_key", DIGEST),
    Column("cached_from", ID),  # the job whose result this one shares, or waits to share
    Column("retry_of", ID),
    Column("code_version", String(255)),
    Column("environment", Document),
    Column("author_id", ID, ForeignKey("user.id")),
    Column("message", Text, nullable=False, default=""),
    Column("created_us", Micros, nullable=False),
    Column("started_us", Micros),
    Column("finished_us", Micros),
    Column("rev", Integer, nullable=False, default=1),
    Index("ix_job_listing", "project_id", "id"),
    Index(
        "ix_job_claim",  # in pick order; what follows the id lets the scan pass over jobs for other workers
        text("priority DESC"),
        "run_at_us",
        "id",
        "kind",
        "labels_key",
        sqlite_where=text("state = 'queued'"),
        postgresql_where=text("state = 'queued'"),
    ),
    Index(
        "ix_job_concurrency",
        "project_id",
        "concurrency_key",
        text("priority DESC"),
        "run_at_us",
        "id",
        sqlite_where=text("state = 'queued' AND concurrency_key IS NOT NULL"),
        postgresql_where=text("state = 'queued' AND concurrency_key IS NOT NULL"),
    ),
    Index(
        "ix_job_sharing",
        "cached_from",
        sqlite_where=text("state = 'waiting' AND cached_from IS NOT NULL"),
        postgresql_where=text("state = 'waiting' AND cached_from IS NOT NULL"),
    ),
    Index(
        "ix_job_expiry",
        "lease_expires_us",
        sqlite_where=text("state = 'running'"),
        postgresql_where=text("state = 'running'"),
    ),
    Index(
        ONE_RUNS_PER_KEY,
        "project_id",
        "concurrency_key",
        unique=True,
        sqlite_where=text("state = 'running' AND concurrency_key IS NOT NULL"),
        postgresql_where=text("state = 'running' AND concurrency_key IS NOT NULL"),
    ),
    Index("ix_job_unfinished", "author_id", sqlite_where=UNFINISHED, postgresql_where=UNFINISHED),
    Index("ix_job_cache", "project_id", "cache_key"),
    Index(
        "ix_job_retry",
        "retry_of",
        sqlite_where=text("retry_of IS NOT NULL"),
        postgresql_where=text("retry_of IS NOT NULL"),
    ),
)

job_dependency = Table(
    "job_dependency",
    metadata,
    Column("job_id", ID, ForeignKey("job.id"), primary_key=True),
    Column("on_job_id", ID, ForeignKey("job.id"), primary_key=True, index=True),
    Column("satisfied", Boolean, nullable=False, default=False),
)

attempt = Table(
    "attempt",
    metadata,
    Column("job_id", ID, ForeignKey("job.id"), primary_key=True),
    Column("fence", Integer, primary_key=True),
    Column("worker", String(255), nullable=False),
    Column("claimed_by", ID),  # the token that claimed
    Column("claim_id", String(64)),  # the name that the worker gave to its claim
    Column("token_hash", String(64), nullable=False, unique=True),
    Column("started_us", Micros, nullable=False),
    Column("ended_us", Micros),
    Column("outcome", String(16)),
    Column("detail", Text),
    Column("signature", String(255)),
    Column("write_id", String(64)),  # of the final answer
    Column("answer", Document),  # what it was answered, for the same write_id again
    Column("log_bytes", BigInteger, nullable=False, default=0),
    Index(
        "ix_attempt_claim",
        "claimed_by",
        "claim_id",
        sqlite_where=text("claim_id IS NOT NULL"),
        postgresql_where=text("claim_id IS NOT NULL"),
    ),
)

job_log = Table(
    "job_log",
    metadata,
    Column("job_id", ID, primary_key=True),
    Column("fence", Integer, primary_key=True),
    Column("offset", BigInteger, primary_key=True),
    Column("data", LargeBinary, nullable=False),
    ForeignKeyConstraint(["job_id", "fence"], ["attempt.job_id", "attempt.fence"]),
)

job_blob = Table(  # blobs that a job's parameters or result name
    "job_blob",
    metadata,
    Column("job_id", ID, ForeignKey("job.id"), primary_key=True),
    Column("blob_digest", DIGEST, ForeignKey("blob.digest"), primary_key=True, index=True),
)

staged_output = Table(
    "staged_output",
    metadata,
    Column("job_id", ID, primary_key=True),
    Column("fence", Integer, primary_key=True),
    Column("name", String(1500), primary_key=True),
    Column("position", Integer, nullable=False),
    Column(
        "draft", Document, nullable=False
    ),  # a store draft: documents by digest, or bodies that refer to other outputs
    ForeignKeyConstraint(["job_id", "fence"], ["attempt.job_id", "attempt.fence"]),
)

event = Table(
    "event",
    metadata,
    Column("seq", Sequence64, primary_key=True, autoincrement=True),
    Column("number", BigInteger),  # place in the feed, given after the commit; on SQLite that is `seq`
    Column("at_us", Micros, nullable=False),
    Column("project_id", ID),
    Column("kind", String(64), nullable=False),
    Column("subject", String(64), nullable=False, index=True),
    Column("actor", String(255)),
    Column("body", Document, nullable=False),
    Index("uq_event_number", "number", unique=True),
    Index("ix_event_feed", "project_id", "number", "seq"),
    sqlite_autoincrement=True,
)

idempotency_key = Table(
    "idempotency_key",
    metadata,
    Column("principal", String(64), primary_key=True),
    Column("key", String(255), primary_key=True),
    Column("fingerprint", String(71), nullable=False),
    Column("status", Integer),  # null only within the transaction of the first request
    Column("headers", Document),
    Column("body", LargeBinary),
    Column("created_us", Micros, nullable=False, index=True),
)

upload = Table(
    "upload",
    metadata,
    Column("id", ID, primary_key=True),
    Column("user_id", ID, ForeignKey("user.id"), nullable=False, index=True),  # of an attempt: the author of its job
    Column("job_id", ID),  # the attempt that sends
    Column("fence", Integer),
    Column("project_ids", Document),  # the projects for which a bound token sends
    Column("length", BigInteger, nullable=False),
    Column("offset", BigInteger, nullable=False, default=0),
    Column("digest", DIGEST),  # expected, checked at the end
    Column("created_us", Micros, nullable=False),
    Column("updated_us", Micros, nullable=False, index=True),
    Column("finished_digest", DIGEST),
    Column("actual_digest", DIGEST),  # of all bytes, if it is not the expected one
    Column("dropped", Boolean, nullable=False, default=False, server_default=false()),  # its pieces can be deleted
)

upload_chunk = Table(
    "upload_chunk",
    metadata,
    Column("upload_id", ID, ForeignKey("upload.id"), primary_key=True),
    Column("offset", BigInteger, primary_key=True),
    Column("data", LargeBinary, nullable=False),
)

coverage_stream = Table(
    "coverage_stream",
    metadata,
    Column("id", ID, primary_key=True),
    Column("project_id", ID, ForeignKey("project.id"), nullable=False, index=True),
    Column("author_id", ID, ForeignKey("user.id")),
    Column("settings", Document, nullable=False),
    Column("rig", LargeBinary),  # skeleton and mapping of its poses
    Column("state", LargeBinary, nullable=False),
    Column("offset", BigInteger, nullable=False, default=0),  # frames
    Column("said", DIGEST),  # of the last request
    Column("answer", Document),  # what it was answered, for the same request again
    Column("created_us", Micros, nullable=False),
    Column("updated_us", Micros, nullable=False, index=True),
    Column("rev", Integer, nullable=False, default=1),
)

dataset = Table(
    "dataset",
    metadata,
    Column("id", ID, primary_key=True),
    Column("project_id", ID, ForeignKey("project.id"), nullable=False),
    Column("name", String(64), nullable=False),
    Column("description", Text, nullable=False, default=""),
    Column("collection_id", ID, ForeignKey("collection.id")),  # folder whose content commits record
    Column("folder_commit", DIGEST),  # commit whose entries the folder has, apart from later changes of its items
    Column("created_us", Micros, nullable=False),
    Column("updated_us", Micros, nullable=False),
    Column("deleted_us", Micros),
    Column("rev", Integer, nullable=False, default=1),
    _alive("dataset", "project_id", "name"),
)

dataset_commit = Table(
    "dataset_commit",
    metadata,
    Column("dataset_id", ID, ForeignKey("dataset.id"), primary_key=True),
    Column("digest", DIGEST, primary_key=True),
    Column("tree", DIGEST, ForeignKey("tree_chunk.digest"), nullable=False),
    Column("author", String(255), nullable=False),
    Column("message", Text, nullable=False),
    Column("at", String(32), nullable=False),  # in the form that the digest covers
    Column("entries", BigInteger, nullable=False),
    Column("generation", Integer, nullable=False),  # 0, or 1 more than the greatest generation of a parent
    Column("write_id", String(64)),  # the name that the client gave to the commit
    Column("job_id", ID, ForeignKey("job.id")),  # the job that committed its outputs; it commits once
    Index("uq_dataset_commit_write", "dataset_id", "write_id", unique=True),
    Index("uq_dataset_commit_job", "job_id", unique=True),
)

fast_forward = Table(  # merges that moved a branch to an existing commit; other merges are commits with a `write_id`
    "fast_forward",
    metadata,
    Column("dataset_id", ID, primary_key=True),
    Column("write_id", String(64), primary_key=True),
    Column("digest", DIGEST, nullable=False),
    ForeignKeyConstraint(["dataset_id", "digest"], ["dataset_commit.dataset_id", "dataset_commit.digest"]),
)

commit_parent = Table(
    "commit_parent",
    metadata,
    Column("dataset_id", ID, primary_key=True),
    Column("digest", DIGEST, primary_key=True),
    Column("position", Integer, primary_key=True),
    Column("parent", DIGEST, nullable=False),
    ForeignKeyConstraint(["dataset_id", "digest"], ["dataset_commit.dataset_id", "dataset_commit.digest"]),
    ForeignKeyConstraint(
        ["dataset_id", "parent"],
        ["dataset_commit.dataset_id", "dataset_commit.digest"],
        name="fk_commit_parent_parent",
    ),
)

dataset_ref = Table(  # a branch or a tag
    "dataset_ref",
    metadata,
    Column("dataset_id", ID, ForeignKey("dataset.id"), primary_key=True),
    Column("name", Name, primary_key=True),
    Column("kind", String(8), nullable=False),
    Column("digest", DIGEST),  # null: a branch without commits
    Column("protection", Document),  # rule of a protected branch
    Column("created_us", Micros, nullable=False),
    Column("updated_us", Micros, nullable=False),
    Column("rev", Integer, nullable=False, default=1),
    ForeignKeyConstraint(["dataset_id", "digest"], ["dataset_commit.dataset_id", "dataset_commit.digest"]),
)

proposal = Table(  # to merge a version into a branch
    "proposal",
    metadata,
    Column("dataset_id", ID, ForeignKey("dataset.id"), primary_key=True),
    Column("number", Integer, primary_key=True, autoincrement=False),
    Column("title", String(255), nullable=False),
    Column("description", Text, nullable=False),
    Column("author_id", ID, ForeignKey("user.id"), nullable=False),
    Column("source", String(255), nullable=False),
    Column("target", Name, nullable=False),
    Column("state", String(8), nullable=False),
    Column("head", DIGEST),  # null: that of the branch `source`, while the proposal is open
    Column("target_commit", DIGEST),  # null: that of the branch `target`, while the proposal is open
    Column("merged", DIGEST),
    Column("when_green_id", ID, ForeignKey("user.id")),  # user for whom it is merged when nothing is missing
    Column("when_green_head", DIGEST),  # commit that this user has asked to merge
    Column("ended_id", ID, ForeignKey("user.id")),
    Column("created_us", Micros, nullable=False),
    Column("updated_us", Micros, nullable=False),
    Column("ended_us", Micros),
    Column("rev", Integer, nullable=False, default=1),
    *(
        ForeignKeyConstraint(["dataset_id", column], ["dataset_commit.dataset_id", "dataset_commit.digest"])
        for column in ("head", "target_commit", "merged", "when_green_head")
    ),
    Index("ix_proposal_state", "dataset_id", "state", "number"),
)

proposal_comment = Table(
    "proposal_comment",
    metadata,
    Column("dataset_id", ID, primary_key=True),
    Column("proposal", Integer, primary_key=True, autoincrement=False),
    Column("number", Integer, primary_key=True, autoincrement=False),
    Column("author_id", ID, ForeignKey("user.id"), nullable=False),
    Column("text", Text, nullable=False),
    Column("path", Text),
    Column("kind", String(32)),
    Column("first_frame", Integer),
    Column("end_frame", Integer),  # the frame after the last one
    Column("digest", DIGEST, nullable=False),
    Column("created_us", Micros, nullable=False),
    ForeignKeyConstraint(["dataset_id", "proposal"], ["proposal.dataset_id", "proposal.number"]),
    ForeignKeyConstraint(["dataset_id", "digest"], ["dataset_commit.dataset_id", "dataset_commit.digest"]),
)

proposal_review = Table(
    "proposal_review",
    metadata,
    Column("dataset_id", ID, primary_key=True),
    Column("proposal", Integer, primary_key=True, autoincrement=False),
    Column("number", Integer, primary_key=True, autoincrement=False),
    Column("author_id", ID, ForeignKey("user.id"), nullable=False),
    Column("verdict", String(16), nullable=False),
    Column("text", Text, nullable=False),
    Column("digest", DIGEST, nullable=False),
    Column("created_us", Micros, nullable=False),
    ForeignKeyConstraint(["dataset_id", "proposal"], ["proposal.dataset_id", "proposal.number"]),
    ForeignKeyConstraint(["dataset_id", "digest"], ["dataset_commit.dataset_id", "dataset_commit.digest"]),
)

proposal_check = Table(
    "proposal_check",
    metadata,
    Column("dataset_id", ID, primary_key=True),
    Column("proposal", Integer, primary_key=True, autoincrement=False),
    Column("digest", DIGEST, primary_key=True),
    Column("name", Name, primary_key=True),
    Column("state", String(16), nullable=False),
    Column("job_id", ID),
    Column("link", Text),
    Column("text", Text, nullable=False),
    Column("reporter_id", ID, ForeignKey("user.id"), nullable=False),
    Column("updated_us", Micros, nullable=False),
    ForeignKeyConstraint(["dataset_id", "proposal"], ["proposal.dataset_id", "proposal.number"]),
    ForeignKeyConstraint(["dataset_id", "digest"], ["dataset_commit.dataset_id", "dataset_commit.digest"]),
)

tree_chunk = Table(  # pieces of the trees of entries, which versions share
    "tree_chunk",
    metadata,
    Column("digest", DIGEST, primary_key=True),
    Column("data", LargeBinary, nullable=False),
    Column("created_us", Micros, nullable=False),
)

leader = Table(
    "leader",
    metadata,
    Column("name", String(32), primary_key=True),
    Column("holder", String(64), nullable=False),
    Column("fence", Integer, nullable=False),
    Column("expires_us", Micros, nullable=False),
)

server_state = Table(
    "server_state",
    metadata,
    Column("key", String(64), primary_key=True),
    Column("value", Document, nullable=False),
)
