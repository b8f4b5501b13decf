"""Tables of events, webhooks, answers to repeated requests, streams, and the state of the server."""

from sqlalchemy import BigInteger, Boolean, Column, ForeignKey, Index, Integer, LargeBinary, String, Table, Text, text

from marey_schemas.webhooks import MAX_URL_LENGTH
from marey_server.store.tables.columns import DIGEST, ID, Document, Micros, Sequence64, metadata

_AUDITED = text("about IS NOT NULL")


def _audit_index(name: str, *columns: str) -> Index:
    """Return an index that contains only those events that are entries of the audit log."""
    return Index(f"ix_event_audit_{name}", *columns, sqlite_where=_AUDITED, postgresql_where=_AUDITED)


event = Table(  # the newest event is never deleted, so that no number is used again
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
    Column("about", String(1024)),  # name of what an entry of the audit log is about; null for all other events
    Column("token_id", ID),  # of the token with which an entry of the audit log was made
    Index("uq_event_number", "number", unique=True, sqlite_where=text("number IS NOT NULL")),  # empty on SQLite
    Index("ix_event_feed", "project_id", "number", "seq"),
    _audit_index("at", "at_us", "seq"),
    _audit_index("kind", "kind", "at_us", "seq", "actor"),
    _audit_index("actor", "actor", "at_us", "seq", "kind"),
    _audit_index("about", "about", "at_us", "seq"),
    _audit_index("subject", "subject", "at_us", "seq"),
    _audit_index("project", "project_id", "at_us", "seq"),
    _audit_index("project_kind", "project_id", "kind", "at_us", "seq", "actor"),
    _audit_index("project_actor", "project_id", "actor", "at_us", "seq", "kind"),
    _audit_index("project_about", "project_id", "about", "at_us", "seq"),
)

webhook = Table(
    "webhook",
    metadata,
    Column("id", ID, primary_key=True),
    Column("project_id", ID, ForeignKey("project.id"), nullable=False, index=True),
    Column("creator_id", ID, ForeignKey("user.id")),
    Column("url", String(MAX_URL_LENGTH), nullable=False),
    Column("kinds", Document, nullable=False),
    Column("description", Text, nullable=False),
    Column("secret", String(128), nullable=False),
    Column("old_secret", String(128)),
    Column("old_secret_until_us", Micros),
    Column("position", BigInteger, nullable=False),  # number of the last event that was delivered or given up
    Column("missed", BigInteger, nullable=False, default=0),  # events deleted before delivery, not yet reported
    Column("attempts", Integer, nullable=False, default=0),  # number of failed attempts to send the next delivery
    Column("failures", Integer, nullable=False, default=0),  # since the last success
    Column("next_us", Micros, nullable=False, default=0, index=True),  # time of the next attempt after a failure
    Column("failing_since_us", Micros),
    Column("delivered_us", Micros),
    Column("last_status", Integer),
    Column("last_error", String(255)),
    Column("paused", Boolean, nullable=False, default=False),
    Column("paused_reason", String(512)),
    Column("created_us", Micros, nullable=False),
    Column("updated_us", Micros, nullable=False),
)

webhook_delivery = Table(  # those that failed or were requested; others leave no row
    "webhook_delivery",
    metadata,
    Column("id", String(80), primary_key=True),
    Column("webhook_id", ID, ForeignKey("webhook.id"), nullable=False),
    Column("kind", String(64), nullable=False),
    Column("number", BigInteger),  # of the event; null for a test
    Column("body", Text, nullable=False),
    Column("state", String(16), nullable=False),
    Column("attempts", Integer, nullable=False),
    Column("last_status", Integer),
    Column("last_error", String(255)),
    Column("created_us", Micros, nullable=False),
    Column("updated_us", Micros, nullable=False, index=True),
    Index("ix_webhook_delivery_state", "webhook_id", "state", "created_us"),
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
