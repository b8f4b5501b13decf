"""Indexes for lists of jobs and for old logs, so that their cost does not grow with the number of ended jobs.

On Postgres, the tables of jobs, attempts and events are vacuumed after changes of 2 % of their rows instead of 20 %.
"""

import sqlalchemy as sa
from alembic import op

revision = "0033"
down_revision = "0032"
branch_labels = None
depends_on = None
phase = "before"

LISTED = sa.text("parent_id IS NULL")
NOT_SUCCEEDED = sa.text("parent_id IS NULL AND state <> 'succeeded'")
HAS_LONG_LOG = sa.text("log_bytes > 43")
LISTS = {
    "created": ["project_id", "created_us", "id"],
    "kind": ["project_id", "kind", "created_us", "id"],
    "author": ["project_id", "author_id", "created_us", "id"],
    "priority": ["project_id", "priority", "id"],
}
VACUUMED = ("job", "attempt", "event")
SETTINGS = {"autovacuum_vacuum_scale_factor": 0.02, "autovacuum_analyze_scale_factor": 0.02}


def upgrade() -> None:
    """Create the indexes; on Postgres, vacuum the tables of the queue and of events more often."""
    for name, columns in LISTS.items():
        op.create_index(f"ix_job_list_{name}", "job", columns, sqlite_where=LISTED, postgresql_where=LISTED)
    columns = ["project_id", "state", "created_us", "id"]
    op.create_index("ix_job_list_state", "job", columns, sqlite_where=NOT_SUCCEEDED, postgresql_where=NOT_SUCCEEDED)
    columns = ["job_id", "fence"]
    op.create_index("ix_attempt_log", "attempt", columns, sqlite_where=HAS_LONG_LOG, postgresql_where=HAS_LONG_LOG)
    if op.get_context().dialect.name == "postgresql":
        settings = ", ".join(f"{name} = {value}" for name, value in SETTINGS.items())
        for table in VACUUMED:
            op.execute(f"ALTER TABLE {table} SET ({settings})")


def downgrade() -> None:
    """Drop the indexes; on Postgres, restore the default frequency of vacuums."""
    if op.get_context().dialect.name == "postgresql":
        for table in VACUUMED:
            op.execute(f"ALTER TABLE {table} RESET ({', '.join(SETTINGS)})")
    op.drop_index("ix_attempt_log", "attempt")
    for name in (*LISTS, "state"):
        op.drop_index(f"ix_job_list_{name}", "job")
