"""Audit log in the store: functions that change events, the time for which entries are kept, indexes, and upgrades."""

from __future__ import annotations

import ast
import re
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest
import sqlalchemy
import sqlalchemy.event
from alembic import command
from sqlalchemy import func, insert, select
from tests.support.database_fixtures import AdjustableClock
from tests.support.store_fixtures import Lab, declared

import marey_server
from marey_schemas.access import MemberChange, Role
from marey_schemas.audit import AuditEntry
from marey_schemas.items import CollectionCreate
from marey_schemas.webhooks import WebhookChange, WebhookCreate
from marey_server.access.principal import SYSTEM, Principal
from marey_server.errors import GoneProblem
from marey_server.store import audit, collections, events, members
from marey_server.store.audit import AuditFilter
from marey_server.store.database import schema
from marey_server.store.ids import new_id
from marey_server.store.retention import Retention, Retired, retire
from marey_server.store.tables import event
from marey_server.store.transaction import Transaction
from marey_server.store.webhooks import managing, outbox

DAY_S = 86400.0
ADMINISTRATOR = Principal("user", "user_1", "root", True, ("read", "admin"))
OWNERS = declared("GET", "/projects/{project}/audit")
TEN_DAYS = Retention(events_days=10, logs_days=0, jobs_days=0)
OF_AUDIT = Retention(events_days=10, logs_days=0, jobs_days=0, audit_days=100)


def log_of(lab: Lab, **wanted: Any) -> list[AuditEntry]:
    """Return the entries of the audit log of the project, newest first."""
    lab.database.write(SYSTEM, events.number_events)
    page = lab.read(audit.list_project_audit, "lab", AuditFilter(**wanted), cursor=None, limit=1000, required=OWNERS)
    return list(page.items)


def add_folder(lab: Lab, path: str) -> None:
    lab.write(collections.create_collection, "lab", CollectionCreate(path=path))
    lab.database.write(SYSTEM, events.number_events)


def set_role(lab: Lab, role: Role) -> None:
    lab.write(members.put_member, "lab", "reader-lab", MemberChange(role=role), required=declared(
        "PUT", "/projects/{project}/members/{user}"
    ))  # fmt: skip
    lab.database.write(SYSTEM, events.number_events)


# -- append-only -------------------------------------------------------------------------------------------------------

CHANGING = ("delete", "update")


def changes_of_events() -> Iterator[tuple[str, str, str]]:
    """Yield module, function and call of each statement of the server that deletes or updates events."""
    root = Path(marey_server.__file__).parent
    for file in sorted(root.rglob("*.py")):
        for function in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(function, ast.FunctionDef | ast.AsyncFunctionDef):
                for call in ast.walk(function):
                    if isinstance(call, ast.Call) and (changed := _changes_event(call)):
                        yield str(file.relative_to(root)), function.name, changed


def _changes_event(call: ast.Call) -> str | None:
    """Return `delete` or `update` if a call builds a statement of this kind for the table of events, otherwise None."""
    named = call.func
    if isinstance(named, ast.Name) and named.id in CHANGING:
        target = ast.unparse(call.args[0])
        return named.id if target.split(".")[-1] == "event" else None
    if isinstance(named, ast.Attribute) and named.attr in CHANGING:
        return named.attr if ast.unparse(named.value).split(".")[-1] == "event" else None
    return None


def test_only_the_retention_deletes_events_and_later_they_only_get_numbers_and_lose_names_in_purges() -> None:
    assert sorted(changes_of_events()) == [
        ("store/events.py", "delete_old_audit_entries", "delete"),
        ("store/events.py", "delete_until", "delete"),
        ("store/events.py", "forget_clips", "update"),
        ("store/events.py", "forget_names", "update"),
        ("store/events.py", "forget_names", "update"),
        ("store/events.py", "number_events", "update"),
    ]


def test_no_statement_in_plain_sql_changes_events() -> None:
    root = Path(marey_server.__file__).parent
    texts = {file: file.read_text(encoding="utf-8").lower() for file in root.rglob("*.py")}
    found = [file for file, text in texts.items() if "delete from" in text or "update event" in text]
    assert found == []


@pytest.mark.parametrize(
    "text",
    ["delete(event)", "delete(tables.event).where(x)", "event.delete()", "tables.event.update()", "update(event)"],
)
def test_a_new_statement_would_be_found(text: str) -> None:
    (call,) = (one for one in ast.walk(ast.parse(text)) if isinstance(one, ast.Call) and _changes_event(one))
    assert _changes_event(call) in CHANGING


# -- retention ---------------------------------------------------------------------------------------------------------


def test_old_events_are_deleted_and_audit_entries_stay(lab: Lab, clock: AdjustableClock) -> None:
    set_role(lab, Role.CONTRIBUTOR)
    add_folder(lab, "old")
    before = log_of(lab)
    clock.advance(11 * DAY_S)
    add_folder(lab, "new")
    assert retire(lab.database, TEN_DAYS) == Retired(events=2)
    assert log_of(lab) == before
    assert {one.kind for one in before} == {"project.created", "member.added", "member.changed"}
    assert retire(lab.database, TEN_DAYS) == Retired()


def test_the_feed_shows_no_audit_entries_from_before_the_events_that_remain(lab: Lab, clock: AdjustableClock) -> None:
    """A follower who begins at 0 gets only events from periods that are still complete.

    So it can continue after each event that it gets.
    """
    set_role(lab, Role.CONTRIBUTOR)
    last = lab.events()[-1].seq
    clock.advance(11 * DAY_S)
    add_folder(lab, "new")
    new = lab.events(after=last)
    retire(lab.database, TEN_DAYS)
    assert lab.events() == lab.events(after=last) == new
    assert lab.events(after=new[0].seq) == new[1:]
    with pytest.raises(GoneProblem) as refused:
        lab.events(after=last - 1)
    assert refused.value.context == {"after": last}


def test_batches_with_nothing_but_audit_entries_do_not_end_the_deletion(
    lab: Lab, clock: AdjustableClock, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(events, "DELETED_AT_ONCE", 2)
    for role in (Role.CONTRIBUTOR, Role.MAINTAINER, Role.OWNER) * 2:
        set_role(lab, role)
    add_folder(lab, "old")
    clock.advance(11 * DAY_S)
    add_folder(lab, "new")
    assert retire(lab.database, TEN_DAYS).events == 2
    assert [one.body["path"] for one in lab.events()] == ["new"]


def test_old_audit_entries_are_deleted_by_their_own_setting_once_they_left_the_feed(
    lab: Lab, clock: AdjustableClock, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(events, "DELETED_AT_ONCE", 2)
    clock.advance(50 * DAY_S)
    set_role(lab, Role.CONTRIBUTOR)
    clock.advance(60 * DAY_S)
    add_folder(lab, "new")
    whole = stored(lab)
    never_in_feed = Retention(events_days=0, logs_days=0, jobs_days=0, audit_days=100)
    assert retire(lab.database, never_in_feed) == Retired()
    assert stored(lab) == whole
    done = retire(lab.database, OF_AUDIT)
    assert done.audit_entries > 2
    assert [one.kind for one in log_of(lab)] == ["member.changed"]
    assert stored(lab) == whole - done.audit_entries - done.events
    assert retire(lab.database, OF_AUDIT) == Retired()


def stored(lab: Lab) -> int:
    """Return the number of stored events."""
    return lab.database.read(SYSTEM, lambda tx: int(tx.execute(select(func.count()).select_from(event)).scalar_one()))


def test_the_newest_event_stays_even_if_it_is_an_old_audit_entry(lab: Lab, clock: AdjustableClock) -> None:
    set_role(lab, Role.CONTRIBUTOR)
    newest = lab.events()[-1].seq
    clock.advance(1000 * DAY_S)
    retire(lab.database, OF_AUDIT)
    assert lab.database.read(SYSTEM, events.newest_number) == newest
    assert [one.seq for one in lab.events()] == [newest]


def test_a_webhook_counts_missed_audit_entries_once_and_is_not_sent_them(lab: Lab, clock: AdjustableClock) -> None:
    add_folder(lab, "first")  # also makes the root
    hook = make_webhook(lab, "member.changed", "collection.created")
    set_role(lab, Role.CONTRIBUTOR)
    add_folder(lab, "old")
    clock.advance(11 * DAY_S)
    add_folder(lab, "new")
    retire(lab.database, TEN_DAYS)
    assert sent(lab, hook) == ["webhook.events_missed", "collection.created"]
    clock.advance(11 * DAY_S)
    add_folder(lab, "newer")
    retire(lab.database, TEN_DAYS)
    found = lab.read(managing.read_webhook, "lab", hook, required=declared("GET", "/projects/{project}/webhooks"))
    assert found.missed == 3


def test_a_webhook_with_new_kinds_is_not_sent_audit_entries_that_left_the_feed(
    lab: Lab, clock: AdjustableClock
) -> None:
    hook = make_webhook(lab, "proposal.opened")
    set_role(lab, Role.CONTRIBUTOR)
    clock.advance(11 * DAY_S)
    add_folder(lab, "new")
    retire(lab.database, TEN_DAYS)
    change = WebhookChange(kinds=("member.changed",))
    path = "/projects/{project}/webhooks/{webhook}"
    lab.write(managing.change_webhook, "lab", hook, change, (), required=declared("PATCH", path))
    assert sent(lab, hook) == []
    clock.advance(11 * DAY_S)
    add_folder(lab, "newer")
    retire(lab.database, TEN_DAYS)
    assert sent(lab, hook) == []


def make_webhook(lab: Lab, *kinds: Any) -> str:
    request = WebhookCreate(url="https://example.org/", kinds=kinds)
    required = declared("POST", "/projects/{project}/webhooks")
    return str(lab.write(managing.create_webhook, "lab", request, (), required=required).id)


def sent(lab: Lab, hook: str) -> list[str]:
    """Return the kinds of the next deliveries of a webhook."""
    batch = lab.database.read(SYSTEM, outbox.next_batch, hook, 0)
    assert batch is not None
    return [one.kind for one in batch.deliveries]


# -- reading -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("wanted", "index"),
    [
        ({}, "project"),
        ({"actor": "ada"}, "project_actor"),
        ({"kind": "member.added"}, "project_kind"),
        ({"subject": "ben"}, "project_about"),
        ({"subject": new_id("project")}, "subject"),
    ],
)
def test_each_filter_of_a_project_has_an_index_in_the_order_of_the_log(
    lab: Lab, wanted: dict[str, Any], index: str
) -> None:
    if lab.database.is_sqlite:
        assert index_of(lab, audit.list_project_audit, "lab", **wanted) == index


@pytest.mark.parametrize(
    ("wanted", "index"),
    [
        ({}, "at"),
        ({"since": datetime(2026, 11, 1, tzinfo=UTC)}, "at"),
        ({"actor": "ada"}, "actor"),
        ({"kind": "member.added"}, "kind"),
        ({"subject": "ben"}, "about"),
        ({"subject": new_id("project")}, "subject"),
    ],
)
def test_each_filter_of_the_server_has_an_index_in_the_order_of_the_log(
    lab: Lab, wanted: dict[str, Any], index: str
) -> None:
    if lab.database.is_sqlite:
        assert index_of(lab, audit.list_audit, **wanted) == index


def index_of(lab: Lab, read: Callable[..., Any], *of: str, **wanted: Any) -> str:
    """Return the index that SQLite uses for the first page of a log; fail if SQLite sorts entries."""
    statements: list[tuple[str, Any]] = []

    def note(_connection: Any, _cursor: Any, statement: str, parameters: Any, *_others: Any) -> None:
        statements.append((statement, parameters))

    sqlalchemy.event.listen(lab.database.engine, "before_cursor_execute", note)
    try:
        lab.write(read, *of, AuditFilter(**wanted), cursor=None, limit=50, who=ADMINISTRATOR, required=OWNERS)
    finally:
        sqlalchemy.event.remove(lab.database.engine, "before_cursor_execute", note)
    text, parameters = next(one for one in statements if "about IS NOT NULL" in one[0])
    with lab.database.engine.connect() as connection:
        rows = connection.exec_driver_sql(f"EXPLAIN QUERY PLAN {text}", parameters)
        steps = "\n".join(row[3] for row in rows)
    assert "USE TEMP B-TREE" not in steps
    (found,) = re.findall(r"(?:SEARCH|SCAN) event USING INDEX ix_event_audit_(\w+)", steps)
    return str(found)


def test_entries_of_one_moment_are_listed_page_by_page(lab: Lab) -> None:
    for role in (Role.CONTRIBUTOR, Role.MAINTAINER) * 3:
        set_role(lab, role)
    whole, cursor, found = log_of(lab), None, []
    while True:
        page = lab.read(audit.list_project_audit, "lab", AuditFilter(), cursor=cursor, limit=2, required=OWNERS)
        found += page.items
        if (cursor := page.next_cursor) is None:
            break
    assert found == whole
    assert len(whole) > 6


# -- databases of earlier versions -------------------------------------------------------------------------------------


def test_an_upgrade_makes_entries_of_earlier_events(lab: Lab) -> None:
    lab_id = log_of(lab)[-1].subject
    owner = lab.owner.user_id
    rows = [
        ("project.changed", lab_id, "ada", {"fields": ["title"]}, "lab"),
        ("member.added", lab_id, "ada", {"user": "ben", "role": "reader"}, "ben"),
        ("item.deleted", "clip_1", "ada", {"name": "walk"}, "walk"),
        ("collection.deleted", "collection_1", "ada", {"path": "raw/walks"}, "raw/walks"),
        ("webhook.deleted", "webhook_1", "ada", {}, "webhook_1"),
        ("user.changed", owner, "ada", {"name": "x", "fields": []}, "owner-lab"),
        ("token.created", "token_1", "ben", {"name": "ci"}, "ben"),
        ("token.revoked", "token_1", "ada", {}, "ben"),
        ("token.revoked", "token_2", "ada", {}, "token_2"),
        ("item.revised", "clip_1", "ada", {"name": "walk"}, None),
    ]
    config = schema._config()
    with lab.database.engine.begin() as connection:
        config.attributes["connection"] = connection
        command.downgrade(config, "0019")
        older = sqlalchemy.Table("event", sqlalchemy.MetaData(), autoload_with=connection)
        connection.execute(older.delete())
        common = {"at_us": 1, "project_id": None, "number": None}
        names = ("kind", "subject", "actor", "body")
        connection.execute(insert(older), [{**common, **dict(zip(names, row, strict=False))} for row in rows])
        command.upgrade(config, "head")
        found = connection.execute(select(event.c.about).order_by(event.c.seq)).scalars().all()
    assert found == [row[-1] for row in rows]


def test_the_events_of_a_rolled_back_change_are_not_in_the_log(lab: Lab) -> None:
    before = log_of(lab)

    def fail(tx: Transaction) -> None:
        tx.audit("member.removed", "project_1", about="ben", project_id=before[0].subject)
        raise RuntimeError("rolled back")

    with pytest.raises(RuntimeError, match="rolled back"):
        lab.database.write(SYSTEM, fail)
    assert log_of(lab) == before
