"""Fewer pages for each commit of a dataset: fewer rows, and no index entries without a value.

SQLite writes whole pages, so each table and each index that gets a row costs a page.
"""

import sqlalchemy as sa
from alembic import op

revision = "0029"
down_revision = "0028"
branch_labels = None
depends_on = None

ID = sa.String(40)
DIGEST = sa.String(71)
COMMIT = ["dataset_commit.dataset_id", "dataset_commit.digest"]
OF_JOB = "fk_dataset_commit_job_id_job"
UNIQUE_VALUES = {"write": ["dataset_id", "write_id"], "job": ["job_id"]}
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
KEEP_COMMITS = "CREATE TEMPORARY TABLE kept_dataset_commit AS SELECT * FROM dataset_commit"
KEEP_PARENTS = "CREATE TEMPORARY TABLE kept_commit_parent AS SELECT * FROM commit_parent"
KEPT_BY_COMMIT = "CREATE INDEX temp.kept_by_commit ON kept_commit_parent (dataset_id, digest, position)"
RESTORE_COMMITS = """
INSERT INTO dataset_commit
    (dataset_id, digest, tree, author, message, at, entries, generation, write_id, job_id)
SELECT dataset_id, digest, tree, author, message, at, entries, generation, write_id, job_id
FROM temp.kept_dataset_commit
"""
RESTORE_COMMITS_WITH_FIRST_PARENTS = """
INSERT INTO dataset_commit
    (dataset_id, digest, first_parent, tree, author, message, at, entries, generation, write_id, job_id)
SELECT one.dataset_id, one.digest, above.parent, tree, author, message, at, entries, generation, write_id, job_id
FROM temp.kept_dataset_commit AS one LEFT JOIN temp.kept_commit_parent AS above
    ON above.dataset_id = one.dataset_id AND above.digest = one.digest AND above.position = 0
"""
RESTORE_PARENTS = """
INSERT INTO commit_parent (dataset_id, digest, position, parent)
SELECT dataset_id, digest, position, parent FROM temp.kept_commit_parent
"""
RESTORE_EVENTS = """
INSERT INTO event (seq, number, at_us, project_id, kind, subject, actor, body, about, token_id)
SELECT seq, number, at_us, project_id, kind, subject, actor, body, about, token_id FROM kept_event ORDER BY seq
"""
SET_FIRST_PARENTS = """
UPDATE dataset_commit SET first_parent = above.parent FROM commit_parent AS above
WHERE above.dataset_id = dataset_commit.dataset_id AND above.digest = dataset_commit.digest AND above.position = 0
"""
RESTORE_FIRST_PARENTS = """
INSERT INTO commit_parent (dataset_id, digest, position, parent)
SELECT dataset_id, digest, 0, first_parent FROM dataset_commit WHERE first_parent IS NOT NULL
"""
# `sqlite_sequence` has the greatest number that was ever given. The newest event is never deleted, so it has this
# number. If somebody has deleted it by hand, the newest event left gets the number, so that it is not given again.
KEEP_GREATEST = """
UPDATE event SET seq = (SELECT seq FROM sqlite_sequence WHERE name = 'event')
WHERE seq = (SELECT max(seq) FROM event) AND seq < (SELECT seq FROM sqlite_sequence WHERE name = 'event')
"""


def upgrade() -> None:
    """Move the first parent of each commit from `commit_parent` to `dataset_commit`.

    On SQLite, the tables of commits and events are also created again, in a form that needs fewer pages.
    """
    if op.get_bind().dialect.name == "sqlite":
        _make_commits_again(with_rowid=False, first_parent=True)
        op.execute(KEEP_GREATEST)
        _make_events_again(autoincrement=False)
    else:
        op.add_column("dataset_commit", sa.Column("first_parent", DIGEST, nullable=True))
        op.execute(SET_FIRST_PARENTS)
        for name in UNIQUE_VALUES:
            op.drop_index(f"uq_dataset_commit_{name}", "dataset_commit")
    op.execute("DELETE FROM commit_parent WHERE position = 0")
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


def downgrade() -> None:
    """Move the first parents back to `commit_parent`, and restore the former tables and indexes."""
    op.execute(RESTORE_FIRST_PARENTS)
    if op.get_bind().dialect.name == "sqlite":
        _make_commits_again(with_rowid=True, first_parent=False)
        _make_events_again(autoincrement=True)
    else:
        for name in UNIQUE_VALUES:
            op.drop_index(f"uq_dataset_commit_{name}", "dataset_commit")
        op.drop_column("dataset_commit", "first_parent")
    for name, columns in UNIQUE_VALUES.items():
        op.create_index(f"uq_dataset_commit_{name}", "dataset_commit", columns, unique=True)


def _make_commits_again(*, with_rowid: bool, first_parent: bool) -> None:
    """Create `dataset_commit` again with the same rows, and `commit_parent`, whose rows refer to it.

    SQLite checks references to the rows at the end of the transaction, when all rows are back. `commit_parent` has no
    rows meanwhile: SQLite would search it for each row of `dataset_commit`.
    """
    op.execute("PRAGMA defer_foreign_keys = ON")
    for keep in (KEEP_PARENTS, KEPT_BY_COMMIT, KEEP_COMMITS):
        op.execute(keep)
    op.drop_table("commit_parent")
    op.drop_table("dataset_commit")
    _create_commits(with_rowid=with_rowid, first_parent=first_parent)
    op.execute(RESTORE_COMMITS_WITH_FIRST_PARENTS if first_parent else RESTORE_COMMITS)
    op.execute(RESTORE_PARENTS)
    op.execute("DROP TABLE temp.kept_commit_parent")
    op.execute("DROP TABLE temp.kept_dataset_commit")


def _create_commits(*, with_rowid: bool, first_parent: bool) -> None:
    op.create_table(
        "dataset_commit",
        sa.Column("dataset_id", ID, nullable=False),
        sa.Column("digest", DIGEST, nullable=False),
        *([sa.Column("first_parent", DIGEST, nullable=True)] if first_parent else []),
        sa.Column("tree", DIGEST, nullable=False),
        sa.Column("author", sa.String(255), nullable=False),
        sa.Column("message", sa.Text(), nullable=False),
        sa.Column("at", sa.String(32), nullable=False),
        sa.Column("entries", sa.BigInteger(), nullable=False),
        sa.Column("generation", sa.Integer(), nullable=False),
        sa.Column("write_id", sa.String(64), nullable=True),
        *([] if with_rowid else [sa.Column("job_id", ID, nullable=True)]),
        sa.PrimaryKeyConstraint("dataset_id", "digest", name="pk_dataset_commit"),
        sa.ForeignKeyConstraint(["dataset_id"], ["dataset.id"], name="fk_dataset_commit_dataset_id_dataset"),
        sa.ForeignKeyConstraint(["tree"], ["tree_chunk.digest"], name="fk_dataset_commit_tree_tree_chunk"),
        *([] if with_rowid else [sa.ForeignKeyConstraint(["job_id"], ["job.id"], name=OF_JOB)]),
        sqlite_with_rowid=with_rowid,
    )
    if with_rowid:  # with the foreign key in the column, so that the downgrade of 0018 can drop it
        op.execute(f"ALTER TABLE dataset_commit ADD COLUMN job_id VARCHAR(40) CONSTRAINT {OF_JOB} REFERENCES job (id)")
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
    )


def _make_events_again(*, autoincrement: bool) -> None:
    """Create the table `event` again with the same rows; `autoincrement` adds a row to `sqlite_sequence`."""
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
    op.execute(RESTORE_EVENTS)
    op.drop_table("kept_event")  # with its indexes, whose names are free again
    op.create_index("ix_event_subject", "event", ["subject"])
    op.create_index("ix_event_feed", "event", ["project_id", "number", "seq"])
    where = None if autoincrement else sa.text("number IS NOT NULL")
    op.create_index("uq_event_number", "event", ["number"], unique=True, sqlite_where=where)
    for name, columns in AUDIT_INDEXES.items():
        op.create_index(f"ix_event_audit_{name}", "event", columns, sqlite_where=AUDITED)
