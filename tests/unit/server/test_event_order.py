"""Order of the feed: a follower gets every event once, even if transactions overlap."""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

import pytest
import sqlalchemy
from alembic import command
from hypothesis import given, settings
from hypothesis import strategies as st
from sqlalchemy import insert, select
from tests.support.store_fixtures import Lab
from tests.support.tiers import examples

from marey_server.access.principal import SYSTEM
from marey_server.store import events, projects
from marey_server.store.blob_backings import DatabaseBlobs
from marey_server.store.database import schema
from marey_server.store.database.connections import Database
from marey_server.store.tables import event, metadata
from marey_server.store.transaction import Transaction

pytestmark = pytest.mark.every_database


@contextmanager
def open_transaction(database: Database) -> Iterator[Transaction]:
    """Yield a transaction on a separate connection; it is committed after the `with` block."""
    with database.engine.connect() as connection, connection.begin():
        yield Transaction(connection, SYSTEM, database.clock, DatabaseBlobs())


class Overlap:
    """Writers with overlapping transactions, a transaction that numbers events, and a follower that reads in between.

    On SQLite, where transactions do not overlap, each transaction is committed at once.
    """

    def __init__(self, lab: Lab) -> None:
        self.lab = lab
        self.project_id = lab.read(projects.read_project, "lab").id
        lab.events()
        self.last = lab.database.read(SYSTEM, events.newest_number)
        self.received: list[str] = []
        self.written: set[str] = set()
        self.open: dict[str, ExitStack] = {}

    def turn(self, name: str) -> None:
        """Begin the transaction of this name, or commit it if it is open."""
        if name in self.open:
            self.open.pop(name).close()
            return
        with ExitStack() as stack:
            tx = stack.enter_context(open_transaction(self.lab.database))
            if name == "numbers":
                events.number_events(tx)
            else:
                for _ in range(2):
                    subject = f"{name}-{len(self.written)}"
                    self.written.add(subject)
                    tx.emit("item.changed", subject, project_id=self.project_id)
            if not self.lab.database.is_sqlite:
                self.open[name] = stack.pop_all()

    def follow(self) -> None:
        """Read the events of the feed that follow the last received event."""
        for one in self.lab.read(events.list_events, "lab", after=self.last).items:
            assert one.seq > self.last
            self.last = one.seq
            self.received.append(one.subject)

    def end(self) -> None:
        """Commit all open transactions, and read the remaining events."""
        for name in list(self.open):
            self.turn(name)
        self.lab.database.write(SYSTEM, events.number_events)
        self.follow()


TURNS = st.lists(st.sampled_from(["ann", "ben", "cleo", "numbers", "numbers", "follow"]), max_size=24)


def test_a_follower_gets_every_event_once_however_transactions_overlap(lab: Lab) -> None:
    @given(TURNS)
    @settings(max_examples=examples(30, soak=100))
    def check(turns: list[str]) -> None:
        overlap = Overlap(lab)
        for name in turns:
            overlap.follow() if name == "follow" else overlap.turn(name)
        overlap.end()
        assert len(overlap.received) == len(overlap.written)
        assert set(overlap.received) == overlap.written

    check()


LATE = ("ann", "ben", "ben", "numbers", "numbers", "follow", "ann")
"""Ann writes first, and commits after Ben's event was received."""


@pytest.mark.parametrize("by_insertion", [False, True])
def test_an_order_by_insertion_would_lose_events(lab: Lab, monkeypatch: pytest.MonkeyPatch, by_insertion: bool) -> None:
    if by_insertion and not lab.database.is_sqlite:
        monkeypatch.setattr(events, "number_of", lambda _tx: event.c.seq)
        monkeypatch.setattr(events, "follows", lambda _tx, after: event.c.seq > after)
    overlap = Overlap(lab)
    for name in LATE:
        overlap.follow() if name == "follow" else overlap.turn(name)
    overlap.end()
    loses = by_insertion and not lab.database.is_sqlite
    assert (len(overlap.received) < len(overlap.written)) is loses


def test_events_do_not_wait_for_transactions_that_are_open(lab: Lab) -> None:
    """Open transactions, even in another database of the same cluster, do not delay events of other transactions."""
    if lab.database.is_sqlite:
        return
    elsewhere = sqlalchemy.create_engine(lab.database.url.set(database="postgres"))
    with elsewhere.connect() as other, other.begin(), open_transaction(lab.database) as slow:
        other.exec_driver_sql("SELECT pg_current_xact_id()")
        slow.emit("tag.created", "s", project_id=lab.read(projects.read_project, "lab").id)
        last = lab.events()[-1].seq
        lab.add_skeleton()
        assert [one.kind for one in lab.events(last)] == ["collection.created", "item.created"]
    elsewhere.dispose()
    assert [one.kind for one in lab.events(last)] == ["collection.created", "item.created", "tag.created"]


def test_numbers_continue_although_all_old_events_were_deleted(lab: Lab) -> None:
    newest = lab.events()[-1].seq
    old = lab.read(events.find_last_old, age_us=-1)
    assert old == newest - 1  # because SQLite continues after the newest event, whose number must not be given again
    lab.write(events.delete_until, old)
    lab.write(events.delete_old_audit_entries, age_us=-1)
    assert lab.read(lambda tx: tx.execute(select(events.number_of(tx))).scalars().all()) == [newest]
    lab.add_skeleton()
    assert [one.seq for one in lab.events(newest)] == [newest + 1, newest + 2]


def test_many_events_are_numbered_in_parts(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(events, "NUMBERED_AT_ONCE", 2)
    project_id = lab.read(projects.read_project, "lab").id
    last = [lab.events() for _ in range(9)][-1][-1].seq
    lab.write(lambda tx: tx.emit_each([("many", project_id, f"{n}", {}) for n in range(5)]))
    parts = [[one.subject for one in lab.events(last)] for _ in range(3)]
    whole = ["0", "1", "2", "3", "4"]
    assert parts == ([whole] * 3 if lab.database.is_sqlite else [whole[:2], whole[:4], whole])


# -- databases of earlier versions -------------------------------------------------------------------------------------


def older_rows(database: Database) -> list[dict[str, Any]]:
    """Return rows of events; on Postgres, their order by transaction differs from the order of insertion."""
    transactions = [0] * 6 if database.is_sqlite else [9, 5, 9, 7, 5, 8]
    common: dict[str, Any] = {"at_us": 1, "project_id": None, "kind": "old", "subject": "s", "body": {}}
    return [{**common, "seq": 10 * (n + 1), "xid": xid} for n, xid in enumerate(transactions)]


def test_followers_of_an_earlier_version_miss_nothing_after_the_upgrade(database: Database) -> None:
    older = sqlalchemy.table("event", *(sqlalchemy.column(name) for name in older_rows(database)[0]))
    config = schema._config()
    rows = older_rows(database)
    with database.engine.begin() as connection:
        config.attributes["connection"] = connection
        connection.execute(event.delete())
        command.downgrade(config, "0004")
        typed = sqlalchemy.Table("event", sqlalchemy.MetaData(), autoload_with=connection)
        connection.execute(insert(typed), rows)
        command.upgrade(config, "head")
        assert set(older.c.keys()) - {"xid"} <= set(metadata.tables["event"].c.keys())
        number = event.c.seq if database.is_sqlite else event.c.number
        order = connection.execute(select(event.c.seq, number.label("number")).order_by(number)).all()
    received = [row["seq"] for row in sorted(rows, key=lambda row: (row["xid"], row["seq"]))]
    assert [one.seq for one in order] == received
    for place, cursor in enumerate(received):  # whoever got these in the old order continues after the last of them
        following = {one.seq for one in order if one.number > cursor}
        assert following >= set(received[place + 1 :])
