"""Tables of jobs, their attempts, logs and results."""

from sqlalchemy import (
    BigInteger,
    Boolean,
    Column,
    ForeignKey,
    ForeignKeyConstraint,
    Index,
    Integer,
    LargeBinary,
    String,
    Table,
    Text,
    false,
    text,
)

from marey_schemas.queue.schedules import MAX_CRON_LENGTH, MAX_TIMEZONE_LENGTH
from marey_server.store.tables.columns import DIGEST, ID, Document, Micros, Name, metadata

UNFINISHED = text("state IN ('waiting', 'queued', 'running')")
"""Condition of the index `ix_job_unfinished`; SQLite uses the index only for conditions in this form."""

LEASED = text("state = 'running' AND lease_expires_us IS NOT NULL")
"""Condition of the index `ix_job_leased`: a worker runs the job. A parent job whose tasks run has no lease."""

HAS_LONG_LOG = text("log_bytes > 43")
"""Condition of the index `ix_attempt_log`: the log is longer than the text that replaces a deleted log."""

NOT_SUCCEEDED = text("job.state <> 'succeeded'")
"""Condition of the index `ix_job_list_state`; SQLite uses the index only for queries that contain this condition."""


_UNPROPAGATED = text("propagation_rank IS NOT NULL")


def _listing_index(name: str, *columns: str, of: str = "parent_id IS NULL") -> Index:
    """Return an index for lists of jobs without tasks; its last columns are those by which the lists are sorted."""
    condition = text(of)
    return Index(
        f"ix_job_list_{name}", "project_id", *columns, "id", sqlite_where=condition, postgresql_where=condition
    )


ONE_RUNS_PER_KEY = "uq_job_concurrency"
"""Name of the index that prevents a second running job with the same concurrency key in a project.

A claim that violates it is repeated.
"""

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
    Column("environment", Document),  # versions of libraries at its end; before, {"traceparent": ...} or null
    Column("author_id", ID, ForeignKey("user.id")),
    Column("message", Text, nullable=False, default=""),
    Column("created_us", Micros, nullable=False),
    Column("started_us", Micros),
    Column("finished_us", Micros),
    Column("rev", Integer, nullable=False, default=1),
    Column("propagation", Document),  # {actor, shareable, announced}, while `propagation_rank` is set
    Column("propagation_rank", BigInteger),  # place among the jobs whose ends later transactions propagate, or null
    Index("ix_job_listing", "project_id", "id"),
    _listing_index("created", "created_us"),
    _listing_index("state", "state", "created_us", of="parent_id IS NULL AND state <> 'succeeded'"),
    _listing_index("kind", "kind", "created_us"),
    _listing_index("author", "author_id", "created_us"),
    _listing_index("priority", "priority"),
    Index(
        "ix_job_claim",  # in the order of claims; the columns after the id show whether this worker can run the job
        "project_id",
        text("priority DESC"),
        "run_at_us",
        "id",
        "kind",
        "labels_key",
        "state",  # else SQLite reads the row of each job to see its state, although the index contains queued jobs only
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
    Index(  # counted by claims, without reading rows
        "ix_job_leased", "project_id", "state", "lease_expires_us", sqlite_where=LEASED, postgresql_where=LEASED
    ),
    Index(
        ONE_RUNS_PER_KEY,
        "project_id",
        "concurrency_key",
        unique=True,
        sqlite_where=text("state = 'running' AND concurrency_key IS NOT NULL"),
        postgresql_where=text("state = 'running' AND concurrency_key IS NOT NULL"),
    ),
    Index(  # jobs whose ends are propagated by later transactions
        "ix_job_unpropagated", "propagation_rank", "id", sqlite_where=_UNPROPAGATED, postgresql_where=_UNPROPAGATED
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

queue_share = Table(  # only of projects with a limit or an earlier claim
    "queue_share",
    metadata,
    Column("project_id", ID, ForeignKey("project.id"), primary_key=True),
    Column("most_running", Integer),  # greatest number of jobs with a lease; null: no limit
    Column("served_us", Micros, nullable=False, default=0, server_default=text("0")),  # last claim of one of its jobs
)

job_dependency = Table(
    "job_dependency",
    metadata,
    Column("job_id", ID, ForeignKey("job.id"), primary_key=True),
    Column("on_job_id", ID, ForeignKey("job.id"), primary_key=True, index=True),
    Column("satisfied", Boolean, nullable=False, default=False),
    Index(  # the next dependants of an ended job, without reading those that were updated before
        "ix_job_dependency_unsatisfied",
        "on_job_id",
        "job_id",
        sqlite_where=text("satisfied = 0"),
        postgresql_where=text("satisfied = false"),
    ),
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
    Index("ix_attempt_log", "job_id", "fence", sqlite_where=HAS_LONG_LOG, postgresql_where=HAS_LONG_LOG),
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

job_item = Table(  # items that a job names as inputs, as outputs, or in its parameters
    "job_item",
    metadata,
    Column("job_id", ID, ForeignKey("job.id"), primary_key=True),
    Column("item_id", ID, primary_key=True, index=True),
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

script = Table(
    "script",
    metadata,
    Column("id", ID, primary_key=True),
    Column("project_id", ID, ForeignKey("project.id"), nullable=False),
    Column("name", Name, nullable=False),
    Column("description", Text, nullable=False),
    Column("declaration", Document, nullable=False),  # repository, commit, command, parameters, inputs, outputs, limits
    Column("author_id", ID, ForeignKey("user.id"), nullable=False),
    Column("created_us", Micros, nullable=False),
    Index("uq_script_project_id_name", "project_id", "name", unique=True),
)

script_run = Table(  # jobs that run scripts, by the name of the script
    "script_run",
    metadata,
    Column("job_id", ID, ForeignKey("job.id"), primary_key=True),
    Column("project_id", ID, ForeignKey("project.id"), nullable=False),
    Column("script", Name, nullable=False),
    Index("ix_script_run_script", "project_id", "script", "job_id"),
)

schedule = Table(
    "schedule",
    metadata,
    Column("id", ID, primary_key=True),
    Column("project_id", ID, ForeignKey("project.id"), nullable=False),
    Column("name", Name, nullable=False),
    Column("cron", String(MAX_CRON_LENGTH), nullable=False),
    Column("timezone", String(MAX_TIMEZONE_LENGTH), nullable=False),
    Column("job", Document, nullable=False),  # request to submit a job
    Column("overlapping", Boolean, nullable=False),
    Column("description", Text, nullable=False),
    Column("author_id", ID, ForeignKey("user.id"), nullable=False),  # as whom jobs are submitted
    Column("scopes", Document, nullable=False),  # of the token with which the author set the job
    Column("due_us", Micros, index=True),  # null: paused; 0: the next time must be computed
    Column("fired_us", Micros),
    Column("last_job_id", ID),  # the job may be deleted
    Column("problem", Text),  # why the last job was not submitted
    Column("created_us", Micros, nullable=False),
    Column("updated_us", Micros, nullable=False),
    Column("rev", Integer, nullable=False),
    Index("uq_schedule_project_id_name", "project_id", "name", unique=True),
)
