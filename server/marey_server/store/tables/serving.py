"""Tables of what the server keeps for itself: events, repeated requests, streams, and its own state."""

from sqlalchemy import BigInteger, Column, ForeignKey, Index, Integer, LargeBinary, String, Table

from marey_server.store.tables.columns import DIGEST, ID, Document, Micros, Sequence64, metadata

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
