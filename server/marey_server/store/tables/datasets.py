"""Tables of datasets, their commits, branches and proposals."""

from sqlalchemy import (
    BigInteger,
    Column,
    ForeignKey,
    ForeignKeyConstraint,
    Index,
    Integer,
    LargeBinary,
    String,
    Table,
    Text,
    text,
)

from marey_server.store.tables.columns import DIGEST, ID, Document, Micros, Name, metadata, unique_alive

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
    unique_alive("dataset", "project_id", "name"),
)


def _unique_value(name: str, column: str, *within: str) -> Index:
    """Return a unique index that contains only those commits that have a value in `column`, which are few."""
    has_value = text(f"{column} IS NOT NULL")
    columns = (*within, column)
    return Index(f"uq_dataset_commit_{name}", *columns, unique=True, sqlite_where=has_value, postgresql_where=has_value)


dataset_commit = Table(  # on SQLite, rows are in the index of their key, so that a commit writes one page
    "dataset_commit",
    metadata,
    Column("dataset_id", ID, ForeignKey("dataset.id"), primary_key=True),
    Column("digest", DIGEST, primary_key=True),
    Column("first_parent", DIGEST),  # not a foreign key, for which each purged commit would be searched for children
    Column("tree", DIGEST, ForeignKey("tree_chunk.digest"), nullable=False),
    Column("author", String(255), nullable=False),
    Column("message", Text, nullable=False),
    Column("at", String(32), nullable=False),  # in the form that the digest covers
    Column("entries", BigInteger, nullable=False),
    Column("generation", Integer, nullable=False),  # 0, or 1 more than the greatest generation of a parent
    Column("write_id", String(64)),  # the name that the client gave to the commit
    Column("job_id", ID, ForeignKey("job.id")),  # the job that committed its outputs; it commits once
    _unique_value("write", "write_id", "dataset_id"),
    _unique_value("job", "job_id"),
    sqlite_with_rowid=False,
)

fast_forward = Table(  # merges that moved a branch to an existing commit; other merges are commits with a `write_id`
    "fast_forward",
    metadata,
    Column("dataset_id", ID, primary_key=True),
    Column("write_id", String(64), primary_key=True),
    Column("digest", DIGEST, nullable=False),
    ForeignKeyConstraint(["dataset_id", "digest"], ["dataset_commit.dataset_id", "dataset_commit.digest"]),
)

commit_parent = Table(  # parents of merges after the first one, so that a plain commit has no row here
    "commit_parent",
    metadata,
    Column("dataset_id", ID, primary_key=True),
    Column("digest", DIGEST, primary_key=True),
    Column("position", Integer, primary_key=True),  # 1 for the second parent
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

_WAITING = text("when_green_id IS NOT NULL")

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
    Index("ix_proposal_waiting", "dataset_id", "number", sqlite_where=_WAITING, postgresql_where=_WAITING),
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
