"""Audit log: events about access and deletion, each with the name of its subject and the token that was used."""

import sqlalchemy as sa
from alembic import op

revision = "0020"
down_revision = "0019"
branch_labels = None
depends_on = None

AUDITED = sa.text("about IS NOT NULL")
INDEXES = {
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
# Kinds of earlier versions, and where the name is; if nowhere, the id of the subject takes its place.
PROJECTS = ("project.created", "project.changed", "project.deleted", "project.restored", "project.limited")
MEMBERS = ("member.added", "member.changed", "member.removed")
COLLECTIONS = ("collection.deleted", "collection.restored")
CONSENTS = ("consent.overridden",)
ITEMS = ("item.deleted", "item.restored")
DATASETS = ("dataset.deleted", "branch.deleted", "branch.protected", "branch.unprotected", "tag.deleted")
WEBHOOKS = ("webhook.created", "webhook.changed", "webhook.rotated", "webhook.deleted")
USERS = ("user.created", "user.changed", "user.limited")
OWN_TOKENS = ("token.created", "token.rotated")  # only users themselves did this
REVOKED_TOKENS = ("token.revoked",)

event = sa.table("event", *map(sa.column, ("kind", "subject", "actor", "about", "body")))


def upgrade() -> None:
    """Add `about` and `token_id` to `event`, with indexes, and make earlier events part of the audit log.

    These are the events about access and deletion: their column `about` gets the name of the subject.
    """
    op.add_column("event", sa.Column("about", sa.String(1024), nullable=True))
    op.add_column("event", sa.Column("token_id", sa.String(40), nullable=True))
    for kinds, name in (
        (PROJECTS, _name_in("project")),
        (MEMBERS, _in_body("user")),
        (COLLECTIONS, _in_body("path")),
        (ITEMS, _in_body("name")),
        (CONSENTS, sa.null()),
        (DATASETS, _name_in("dataset")),
        (WEBHOOKS, sa.null()),
        (USERS, _name_in("user")),
        (OWN_TOKENS, event.c.actor),
        (REVOKED_TOKENS, _creator()),
    ):
        found = sa.func.coalesce(name, event.c.subject)
        op.execute(sa.update(event).where(event.c.kind.in_(kinds)).values(about=found))
    for name, columns in INDEXES.items():
        op.create_index(f"ix_event_audit_{name}", "event", columns, sqlite_where=AUDITED, postgresql_where=AUDITED)


def _name_in(table: str) -> sa.ScalarSelect[str]:
    """Return the SQL expression for the name of an event's subject, which is a row of `table`."""
    named = sa.table(table, sa.column("id"), sa.column("name"))
    return sa.select(named.c.name).where(named.c.id == event.c.subject).scalar_subquery()


def _creator() -> sa.ScalarSelect[str]:
    """Return the SQL expression for the user who created the token of an event; null if the creation is not stored."""
    creation = event.alias("creation")
    same = creation.c.subject == event.c.subject, creation.c.kind == "token.created"
    return sa.select(creation.c.actor).where(*same).limit(1).scalar_subquery()


def _in_body(key: str) -> sa.ColumnElement[str]:
    """Return the SQL expression for a member of the body of an event, as text."""
    if op.get_bind().dialect.name == "postgresql":
        return event.c.body.op("->>")(key)
    return sa.func.json_extract(event.c.body, f"$.{key}")


def downgrade() -> None:
    """Drop `about` and `token_id` of `event`, with the indexes; the events themselves stay."""
    for name in INDEXES:
        op.drop_index(f"ix_event_audit_{name}", "event")
    op.drop_column("event", "token_id")
    op.drop_column("event", "about")
