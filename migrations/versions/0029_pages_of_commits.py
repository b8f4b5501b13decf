"""Fewer pages for each commit of a dataset: tables in the index of their key, and indexes without empty values.

SQLite writes whole pages, so each table and index that gets a row costs a page.
"""

import sqlalchemy as sa
from alembic import op

revision = "0029"
down_revision = "0028"
branch_labels = None
depends_on = None

ID = sa.String(40)
DIGEST = sa.String(71)
UNIQUE_VALUES = {"write": ["dataset_id", "write_id"], "job": ["job_id"]}
COMMIT = ["dataset_commit.dataset_id", "dataset_commit.digest"]
AUDITED = sa.text("about IS NOT NULL")
AUDIT_INDEXES = {
    "at": ["at_us", "seq"],
    "kind": ["kind", "at_us", "seq", "actor"],
    "actor": ["actor", "at_us", "seq", "kind"],
    "about": ["about", "at_us", "seq"],
    "subject": ["subject", "at_us", "seq"],
    "project": ["project_id", "at_us", "seq"],
    "project_kind": ["project_id", "kind", "at_us", "seq", "actor"],
    "project_actor": ["project_id", "actor", "at_us", "seq", "kind"],
    "project_about": ["project_id", "about", "at_us", "seq"],
}
# `sqlite_sequence` has the greatest number that was ever given. The newest event is never deleted, so it has this
# number. If somebody has deleted it by hand, the newest event left gets it, so that no number is given twice.
KEEP_GREATEST = """
UPDATE event SET seq = (SELECT seq FROM sqlite_sequence WHERE name = 'event')
WHERE seq = (SELECT max(seq) FROM event) AND seq < (SELECT seq FROM sqlite_sequence WHERE name = 'event')
"""


def upgrade() -> None:
    """Restrict the indexes; on SQLite, also make the tables again."""
    if op.get_bind().dialect.name == "sqlite":
        _make_commits_again(with_rowid=False)
        op.execute(KEEP_GREATEST)
        _make_events_again(autoincrement=False)
    else:
        for name in UNIQUE_VALUES:
            op.drop_index(f"uq_dataset_commit_{name}", "dataset_commit")
    for name, columns in UNIQUE_VALUES.items():
        has_value = sa.text(f"{columns[-1]} IS NOT NULL")
        op.create_index(
            f"uq_dataset_commit_{name}",
            "dataset_commit",
            columns,
            unique=True,
            sqlite_where=has_value,
            postgresql_where=has_value,
        )


def _make_commits_again(*, with_rowid: bool) -> None:
    """Make `commit_parent` and `dataset_commit` again, with the same rows, with or without `rowid`.

    SQLite checks references to the rows at the end of the transaction, when all rows are back.
    """
    op.execute("PRAGMA defer_foreign_keys = ON")
    for table in ("commit_parent", "dataset_commit"):
        op.execute(f"CREATE TEMPORARY TABLE kept_{table} AS SELECT * FROM {table}")
        op.drop_table(table)
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
        sa.Column("job_id", ID, nullable=True),
        sa.PrimaryKeyConstraint("dataset_id", "digest", name="pk_dataset_commit"),
        sa.ForeignKeyConstraint(["dataset_id"], ["dataset.id"], name="fk_dataset_commit_dataset_id_dataset"),
        sa.ForeignKeyConstraint(["tree"], ["tree_chunk.digest"], name="fk_dataset_commit_tree_tree_chunk"),
        sa.ForeignKeyConstraint(["job_id"], ["job.id"], name="fk_dataset_commit_job_id_job"),
        sqlite_with_rowid=with_rowid,
    )
    op.create_table(
        "commit_parent",
        sa.Column("dataset_id", ID, nullable=False),
        sa.Column("digest", DIGEST, nullable=False),
        sa.Column("position", sa.Integer(), nullable=False),
        sa.Column("parent", DIGEST, nullable=False),
        sa.PrimaryKeyConstraint("dataset_id", "digest", "position", name="pk_commit_parent"),
        sa.ForeignKeyConstraint(
            ["dataset_id", "digest"], COMMIT, name="fk_commit_parent_dataset_id_digest_dataset_commit"
        ),
        sa.ForeignKeyConstraint(["dataset_id", "parent"], COMMIT, name="fk_commit_parent_parent"),
        sqlite_with_rowid=with_rowid,
    )
    for table, columns in (
        ("dataset_commit", "dataset_id, digest, tree, author, message, at, entries, generation, write_id, job_id"),
        ("commit_parent", "dataset_id, digest, position, parent"),
    ):
        op.execute(f"INSERT INTO {table} ({columns}) SELECT {columns} FROM kept_{table}")
        op.execute(f"DROP TABLE temp.kept_{table}")


def _make_events_again(*, autoincrement: bool) -> None:
    """Make the table of events again, with the same rows, with or without a row in `sqlite_sequence`."""
    op.rename_table("event", "kept_event")
    op.create_table(
        "event",
        sa.Column("seq", sa.Integer(), nullable=False),
        sa.Column("number", sa.BigInteger(), nullable=True),
        sa.Column("at_us", sa.BigInteger(), nullable=False),
        sa.Column("project_id", ID, nullable=True),
        sa.Column("kind", sa.String(64), nullable=False),
        sa.Column("subject", sa.String(64), nullable=False),
        sa.Column("actor", sa.String(255), nullable=True),
        sa.Column("body", sa.JSON(), nullable=False),
        sa.Column("about", sa.String(1024), nullable=True),
        sa.Column("token_id", ID, nullable=True),
        sa.PrimaryKeyConstraint("seq", name="pk_event"),
        sqlite_autoincrement=autoincrement,
    )
    columns = "seq, number, at_us, project_id, kind, subject, actor, body, about, token_id"
    op.execute(f"INSERT INTO event ({columns}) SELECT {columns} FROM kept_event ORDER BY seq")
    op.drop_table("kept_event")  # with its indexes, whose names are free again
    op.create_index("ix_event_subject", "event", ["subject"])
    op.create_index("ix_event_feed", "event", ["project_id", "number", "seq"])
    where = None if autoincrement else sa.text("number IS NOT NULL")
    op.create_index("uq_event_number", "event", ["number"], unique=True, sqlite_where=where)
    for name, columns_of_index in AUDIT_INDEXES.items():
        op.create_index(f"ix_event_audit_{name}", "event", columns_of_index, sqlite_where=AUDITED)


def downgrade() -> None:
    """Make the former tables and indexes again."""
    if op.get_bind().dialect.name == "sqlite":
        _make_commits_again(with_rowid=True)
        _make_events_again(autoincrement=True)
    else:
        for name in UNIQUE_VALUES:
            op.drop_index(f"uq_dataset_commit_{name}", "dataset_commit")
    for name, columns in UNIQUE_VALUES.items():
        op.create_index(f"uq_dataset_commit_{name}", "dataset_commit", columns, unique=True)
