"""Indexes over facts about takes in summaries."""

from alembic import op

revision = "0025"
down_revision = "0023"
branch_labels = None
depends_on = None

FACTS = ("subject", "action", "take", "shoot_day", "licence")


def upgrade() -> None:
    """Create the indexes."""
    on_sqlite = op.get_bind().dialect.name == "sqlite"
    for name in FACTS:
        fact = f"json_extract(summary, '$.{name}')" if on_sqlite else f"summary ->> '{name}'"
        start = f"substr({fact}, 1, 100)"
        op.execute(
            f"CREATE INDEX ix_item_by_{name} ON item (project_id, kind, {start}, created_us, id) "
            f"WHERE {start} IS NOT NULL AND deleted_us IS NULL"
        )


def downgrade() -> None:
    """Drop the indexes."""
    for name in FACTS:
        op.drop_index(f"ix_item_by_{name}", "item")
