"""Items to which jobs refer, and an index of deleted items, so that a purge need not read all jobs and items."""

import json
import re
from typing import Any

import sqlalchemy as sa
from alembic import op
from sqlalchemy.dialects.postgresql import JSONB

revision = "0023"
down_revision = "0022"
branch_labels = None
depends_on = None

ID = sa.String(40)
DOCUMENT = sa.JSON().with_variant(JSONB(), "postgresql")
DELETED = sa.text("deleted_us IS NOT NULL AND purged_us IS NULL")
PAGE = 10  # few, because one job can name 100,000 items
ROWS_AT_ONCE = 1000
ITEM_ID = re.compile(
    r"\b(?:skeleton|clip|processed|annotation|model|graph|metric|evaluation|character|edit|study)"
    r"_[0123456789abcdefghjkmnpqrstvwxyz]{26}\b"
)

job = sa.table(
    "job",
    sa.column("id", ID),
    sa.column("parent_id", ID),
    sa.column("inputs", DOCUMENT),
    sa.column("params", DOCUMENT),
    sa.column("outputs", DOCUMENT),
)


def upgrade() -> None:
    """Create the table `job_item` and an index of deleted items, and record which items all jobs name.

    This reads each job once.
    """
    links = op.create_table(
        "job_item",
        sa.Column("job_id", ID, nullable=False),
        sa.Column("item_id", ID, nullable=False),
        sa.ForeignKeyConstraint(["job_id"], ["job.id"], name="fk_job_item_job_id_job"),
        sa.PrimaryKeyConstraint("job_id", "item_id", name="pk_job_item"),
    )
    connection, behind = op.get_bind(), ""
    page = sa.select(job).order_by(job.c.id).limit(PAGE)
    while rows := connection.execute(page.where(job.c.id > behind)).all():
        behind = rows[-1].id
        for row in rows:
            found = sorted(items_of(row))
            for start in range(0, len(found), ROWS_AT_ONCE):
                some = found[start : start + ROWS_AT_ONCE]
                connection.execute(sa.insert(links), [{"job_id": row.id, "item_id": item} for item in some])
    op.create_index("ix_job_item_item_id", "job_item", ["item_id"])
    columns = ["project_id", "kind", "id"]
    op.create_index("ix_item_deleted", "item", columns, sqlite_where=DELETED, postgresql_where=DELETED)


def items_of(row: Any) -> set[str]:
    """Return the ids of the items in the inputs and outputs of a job, and in its parameters unless it is a task."""
    found = {one["item"] for one in row.outputs or ()}
    for pins in row.inputs.values():
        if isinstance(pins, list):
            found.update(pin["item"] for pin in pins if "item" in pin)
    return found if row.parent_id is not None else found.union(ITEM_ID.findall(json.dumps(row.params)))


def downgrade() -> None:
    """Drop the table `job_item` and the index of deleted items."""
    op.drop_index("ix_item_deleted", "item")
    op.drop_table("job_item")
