"""Property of retention: a follower of the feed gets every event, or an error with the last deleted event."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.support.database_fixtures import AdjustableClock
from tests.support.interleaving import Step, interleave
from tests.support.store_fixtures import Lab, declared
from tests.support.tiers import examples

from marey_schemas.webhooks import WebhookCreate
from marey_server.access.principal import SYSTEM
from marey_server.errors import GoneProblem
from marey_server.store import audit, events, projects, retention
from marey_server.store.audit import AuditFilter
from marey_server.store.database.connections import Database
from marey_server.store.retention import Retention, retire
from marey_server.store.transaction import Transaction
from marey_server.store.webhooks import managing, outbox

DAY_S = 86400.0
KEPT = Retention(events_days=10, logs_days=0, jobs_days=0)
WEBHOOKS = declared("POST", "/projects/{project}/webhooks")
LOG = declared("GET", "/projects/{project}/audit")


class Follower:
    """Client that reads the feed page by page; after a refusal, it continues after the event that the refusal names."""

    def __init__(self, lab: Lab, last: int) -> None:
        self.lab = lab
        self.last = last
        self.received: list[str] = []
        self.gaps: list[tuple[int, int]] = []

    def read(self) -> None:
        try:
            page = self.lab.read(events.list_events, "lab", after=self.last, limit=2).items
        except GoneProblem as refusal:
            after = refusal.context["after"]
            assert after > self.last
            self.gaps.append((self.last, after))
            self.last = after
            return
        for one in page:
            assert one.seq > self.last
            self.last = one.seq
            self.received.append(one.subject)


class World:
    """Writer, retention, followers and a webhook of the project `lab`, with the events that were recorded."""

    def __init__(self, lab: Lab, clock: AdjustableClock) -> None:
        self.lab = lab
        self.clock = clock
        self.project_id = lab.read(projects.read_project, "lab").id
        request = WebhookCreate(url="https://example.org/", kinds=("item.changed", "item.deleted"))
        self.hook = lab.write(managing.create_webhook, "lab", request, (), required=WEBHOOKS).id
        self.numbers: dict[str, int] = {}
        self.audited: list[str] = []
        self._number()
        self.follower = Follower(lab, lab.database.read(SYSTEM, events.newest_number))

    def do(self, turn: str) -> None:
        """Do one step:

        write an event (`ordinary`, `audited`), read a page (`read`), or let six days pass. With `retire`, the server
        then also deletes old events.
        """
        if turn in ("ordinary", "audited"):
            self._write(turn)
        elif turn == "read":
            self.follower.read()
        else:
            self.clock.advance(6 * DAY_S)
        if turn == "retire":
            retire(self.lab.database, KEPT)

    def _write(self, kind: str) -> None:
        subject = f"s{len(self.numbers)}-{self.hook}"

        def record(tx: Transaction) -> None:
            if kind == "audited":
                tx.audit("item.deleted", subject, about=subject, project_id=self.project_id)
            else:
                tx.emit("item.changed", subject, project_id=self.project_id)

        self.lab.write(record)
        self._number()
        self.numbers[subject] = self.lab.database.read(SYSTEM, events.newest_number)
        if kind == "audited":
            self.audited.append(subject)

    def _number(self) -> None:
        self.lab.database.write(SYSTEM, events.number_events)

    def check(self) -> None:
        """Read the feed to its end, and compare everything with the recorded events."""
        while self.follower.last < max(self.numbers.values(), default=0):
            self.follower.read()
        missed = {
            subject
            for subject, number in self.numbers.items()
            if any(after < number <= told for after, told in self.follower.gaps)
        }
        assert self.follower.received == [subject for subject in self.numbers if subject not in missed]
        self._check_beginner()
        self._check_webhook()
        page = self.lab.read(
            audit.list_project_audit, "lab", AuditFilter(kind="item.deleted"), cursor=None, limit=1000, required=LOG
        )
        assert [one.subject for one in reversed(page.items) if one.subject in self.numbers] == self.audited

    def _check_beginner(self) -> None:
        """Check that a client that begins at 0 is never refused, and gets all events after its first event."""
        beginner = Follower(self.lab, 0)
        while beginner.last < max(self.numbers.values(), default=0):
            beginner.read()
        assert beginner.gaps == []
        own = [subject for subject in beginner.received if subject in self.numbers]
        assert own == list(self.numbers)[len(self.numbers) - len(own) :]

    def _check_webhook(self) -> None:
        """Check that the webhook gets every event, either to deliver or in the number of missed events."""
        batch = self.lab.database.read(SYSTEM, outbox.next_batch, self.hook, 0)
        assert batch is not None
        waiting = [one for one in batch.deliveries if one.kind != outbox.MISSED_KIND]
        missed = sum(one.missed for one in batch.deliveries)
        assert len(waiting) + missed == len(self.numbers)
        assert [one.number for one in waiting] == sorted(self.numbers.values())[missed:]
        path = declared("DELETE", "/projects/{project}/webhooks/{webhook}")
        self.lab.write(managing.delete_webhook, "lab", self.hook, required=path)


def test_a_slower_deletion_does_not_set_the_begin_of_the_feed_back(
    lab: Lab, clock: AdjustableClock, open_database: Callable[[], Database], monkeypatch: pytest.MonkeyPatch
) -> None:
    world = World(lab, clock)
    for turn in ("ordinary",) * 8 + ("wait", "wait", "ordinary"):
        world.do(turn)
    monkeypatch.setattr(events, "DELETED_AT_ONCE", 2)

    def delete_some(tx: Transaction) -> int:
        retention._delete_oldest(tx, round(10 * DAY_S * 1e6))
        return events.start_of_feed(tx, 0)

    def delete_more(tx: Transaction) -> int:
        return [delete_some(tx) for _ in range(3)][-1]

    first, second = interleave(Step(lab.database, SYSTEM, delete_more), Step(open_database(), SYSTEM, delete_some))
    assert second > first > 0


TURNS = st.lists(st.sampled_from(["ordinary", "audited", "audited", "read", "wait", "retire"]), max_size=20)


def test_followers_and_webhooks_know_of_every_event_or_how_far_they_were_deleted(
    lab: Lab, clock: AdjustableClock, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(events, "DELETED_AT_ONCE", 3)

    @given(TURNS)
    @settings(max_examples=examples(30, soak=100))
    def check(turns: list[str]) -> None:
        world = World(lab, clock)
        for turn in turns:
            world.do(turn)
        world.check()

    check()


def test_a_feed_that_showed_old_audit_entries_would_be_found(
    lab: Lab, clock: AdjustableClock, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Check that the test above would fail if the feed showed a client at 0 the audit entries that are kept longer."""
    monkeypatch.setattr(events, "start_of_feed", lambda _tx, after: after)
    world = World(lab, clock)
    for turn in ("audited", "ordinary", "wait", "wait", "ordinary", "retire"):
        world.do(turn)
    with pytest.raises(AssertionError):
        world.check()
