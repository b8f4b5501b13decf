"""Event numbers that do not depend on transaction ids of Postgres."""

import sqlalchemy as sa
from alembic import op

revision = "0005"
down_revision = "0004"
branch_labels = None
depends_on = None

# In the order of the old feed, each number is at least `seq` and above the number before it. So whoever received the
# event `seq` last, and continues after that number, misses none of the events that followed.
NUMBER_EVENTS = """
UPDATE event SET number = numbered.number
FROM (
    SELECT seq, place + max(seq - place) OVER (ORDER BY place) AS number
    FROM (SELECT seq, row_number() OVER (ORDER BY xid, seq) AS place FROM event) AS ordered
) AS numbered
WHERE event.seq = numbered.seq
"""
START_COUNTER = """
INSERT INTO server_state (key, value)
SELECT 'last_event_number', to_jsonb(greatest(coalesce(max(number), 0), coalesce(pg_sequence_last_value(
    pg_get_serial_sequence('event', 'seq')::regclass), 0))) FROM event
"""


def upgrade() -> None:
    """Replace the column `xid` of `event` by `number`.

    On Postgres, all events are numbered. On SQLite, `number` stays null, because `seq` serves as the number.
    """
    op.add_column("event", sa.Column("number", sa.BigInteger(), nullable=True))
    if op.get_bind().dialect.name == "postgresql":
        op.execute(NUMBER_EVENTS)
        op.execute(START_COUNTER)
    op.drop_index("ix_event_feed", "event")
    op.drop_column("event", "xid")
    op.create_index("ix_event_feed", "event", ["project_id", "number", "seq"])
    op.create_index("uq_event_number", "event", ["number"], unique=True)


def downgrade() -> None:
    """Restore the column `xid` of `event`; it is 0 for all events, so that `seq` alone orders them."""
    op.drop_index("uq_event_number", "event")
    op.drop_index("ix_event_feed", "event")
    op.drop_column("event", "number")
    op.add_column("event", sa.Column("xid", sa.BigInteger(), nullable=False, server_default="0"))
    op.create_index("ix_event_feed", "event", ["project_id", "xid", "seq"])
    op.execute("DELETE FROM server_state WHERE key = 'last_event_number'")
