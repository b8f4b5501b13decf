"""Indexes of the facts about takes in item summaries, and a table of the numbers that jobs publish about items."""

import sqlalchemy as sa
from alembic import op

revision = "0025"
down_revision = "0024"
branch_labels = None
depends_on = None

FACTS = ("subject", "action", "take", "shoot_day", "licence")


def upgrade() -> None:
    """Create the indexes of `item`, and the table `item_facet`."""
    on_sqlite = op.get_bind().dialect.name == "sqlite"
    for name in FACTS:
        fact = f"json_extract(summary, '$.{name}')" if on_sqlite else f"summary ->> '{name}'"
        start = f"substr({fact}, 1, 100)"
        op.execute(
            f"CREATE INDEX ix_item_by_{name} ON item (project_id, kind, {start}, created_us, id) "
            f"WHERE {start} IS NOT NULL AND deleted_us IS NULL"
        )
    op.create_table(
        "item_facet",
        sa.Column("item_id", sa.String(40), nullable=False),
        sa.Column("number", sa.Integer(), nullable=False),
        sa.Column("name", sa.String(64), nullable=False),
        sa.Column("value", sa.Double(), nullable=False),
        sa.ForeignKeyConstraint(
            ["item_id", "number"], ["revision.item_id", "revision.number"], name="fk_item_facet_item_id_number_revision"
        ),
        sa.PrimaryKeyConstraint("item_id", "number", "name", name="pk_item_facet"),
    )
    op.create_index("ix_item_facet_name_value", "item_facet", ["name", "value", "item_id"])


def downgrade() -> None:
    """Drop the table `item_facet`, with the facets of all clips, and the indexes of `item`."""
    op.drop_table("item_facet")
    for name in FACTS:
        op.drop_index(f"ix_item_by_{name}", "item")
