"""Deliveries of webhooks in the store: positions in the feed, outcomes, loss of the lead, and deleted events."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import pytest
from sqlalchemy import delete, update
from tests.support.database_fixtures import AdjustableClock
from tests.support.store_fixtures import Lab, declared

from marey_schemas.items import CollectionCreate, Page
from marey_schemas.webhooks import NewWebhook, WebhookChange, WebhookCreate, WebhookRotation
from marey_server.access.principal import SYSTEM
from marey_server.store import collections, events, leader, projects, retention
from marey_server.store.fsck import check_store
from marey_server.store.leader import Lead
from marey_server.store.retention import Retention
from marey_server.store.tables import webhook, webhook_delivery
from marey_server.store.transaction import Transaction
from marey_server.store.webhooks import deliveries, managing, outbox
from marey_server.store.webhooks.outbox import Batch, DeliveryResult, Destination, Outcome, Recorded
from marey_server.webhooks import delivering
from marey_server.webhooks.sending import MOST_OF_ONE_USER

OWNER = declared("POST", "/projects/{project}/webhooks")
ADDED = DeliveryResult(204)
FAILED = DeliveryResult(500, "the answer has the status 500")
DAY_S = 86400.0
TEN_DAYS = Retention(events_days=10, logs_days=0, jobs_days=0)


class Desk:
    """A webhook for new folders, and the leading sender of webhooks."""

    def __init__(self, lab: Lab, *kinds: Any) -> None:
        self.lab = lab
        request = WebhookCreate(url="https://example.org/", kinds=kinds or ("collection.created",))
        self.hook: NewWebhook = lab.write(managing.create_webhook, "lab", request, (), required=OWNER)
        self.lead = self.take_lead("a")

    def take_lead(self, holder: str) -> Lead:
        fence = self.lab.database.write(SYSTEM, leader.take_lead, "webhooks", holder, 30_000_000)
        assert fence is not None
        return Lead("webhooks", holder, fence)

    def add_folders(self, *names: str) -> None:
        for name in names:
            self.lab.write(collections.create_collection, "lab", CollectionCreate(path=name))
        self.lab.database.write(SYSTEM, events.number_events)

    def batch(self, scanned: int = 0) -> Batch | None:
        return self.lab.database.read(SYSTEM, outbox.next_batch, self.hook.id, scanned)

    def ids(self) -> list[str]:
        batch = self.batch()
        return [] if batch is None else [one.id for one in batch.deliveries]

    def record(self, result: DeliveryResult, *, place: int = 0, lead: Lead | None = None) -> Outcome | None:
        """Record the result of an attempt to send one delivery of the batch, given by its index."""
        batch = self.batch()
        assert batch is not None
        before = (batch.position, batch.attempts)
        chosen = batch.deliveries[place]
        recorded = self.lab.database.write(SYSTEM, outbox.record, lead or self.lead, chosen, result, before, 5)
        return None if recorded is None else recorded.outcome

    def read(self) -> Any:
        return self.lab.read(managing.read_webhook, "lab", self.hook.id, required=OWNER)

    def listed(self) -> list[Any]:
        page: Page = self.lab.read(
            deliveries.list_deliveries, "lab", self.hook.id, state=None, cursor=None, limit=50, required=OWNER
        )
        return list(page.items)


@pytest.fixture
def desk(lab: Lab) -> Desk:
    lab.write(collections.create_collection, "lab", CollectionCreate(path="first"))
    return Desk(lab)


def test_only_later_events_of_the_chosen_kinds_are_sent(desk: Desk) -> None:
    assert desk.ids() == []
    desk.lab.add_skeleton()
    desk.add_folders("one", "two")
    batch = desk.batch()
    assert batch is not None
    assert [one.kind for one in batch.deliveries] == ["collection.created"] * 2
    message = json.loads(batch.deliveries[0].body)
    assert set(message) == {"id", "kind", "seq", "project", "at", "subject", "links"}
    assert (message["project"], message["id"]) == ("lab", batch.deliveries[0].id)


def test_the_links_lead_to_jobs_and_items(lab: Lab) -> None:
    desk = Desk(lab, "item.created", "job.failed")
    made = lab.add_skeleton()
    lab.database.write(SYSTEM, events.number_events)
    batch = desk.batch()
    assert batch is not None
    links = json.loads(batch.deliveries[0].body)["links"]
    assert links["subject"] == f"/api/v1/projects/lab/skeletons/{made.id}"


def test_a_recorded_success_moves_the_position_and_an_unrecorded_one_is_repeated(desk: Desk) -> None:
    desk.add_folders("one", "two")
    one, two = desk.ids()
    assert desk.ids() == [one, two]
    assert desk.record(ADDED) == "delivered"
    assert desk.ids() == [two]
    assert desk.listed() == []


def test_a_process_that_lost_its_lead_records_nothing(desk: Desk, clock: AdjustableClock) -> None:
    desk.add_folders("one")
    clock.advance(31)
    newer = desk.take_lead("b")
    assert desk.record(ADDED) is None
    assert len(desk.ids()) == 1
    assert desk.record(ADDED, lead=newer) == "delivered"
    assert desk.ids() == []


def test_an_outcome_that_was_recorded_already_does_not_count_twice(desk: Desk) -> None:
    desk.add_folders("one")
    batch = desk.batch()
    assert batch is not None
    before = (batch.position, batch.attempts)

    def record(tx: Transaction) -> Recorded | None:
        return outbox.record(tx, desk.lead, batch.deliveries[0], FAILED, before, 5)

    first = desk.lab.database.write(SYSTEM, record)
    assert first is not None
    assert first.outcome == "retry"
    assert desk.lab.database.write(SYSTEM, record) is None
    assert desk.read().failures == 1


def test_waits_grow_with_the_failures_of_the_webhook_and_end_with_a_success(desk: Desk, clock: AdjustableClock) -> None:
    desk.add_folders("one", "two")
    one, two = desk.ids()
    waits = []
    for attempt in range(1, outbox.MOST_ATTEMPTS + 1):
        outcome = desk.record(FAILED)
        assert outcome == ("dead" if attempt == outbox.MOST_ATTEMPTS else "retry")
        assert desk.ids() == []
        found = desk.read()
        waits.append((found.next_attempt_at - desk.listed()[0].updated_at).total_seconds())
        clock.advance(waits[-1] + 1)
    assert all(2.5 * 2**place <= wait <= 5 * 2**place for place, wait in enumerate(waits))
    assert desk.ids() == [two]
    [dead] = desk.listed()
    assert (dead.id, dead.state, dead.attempts) == (one, "dead", outbox.MOST_ATTEMPTS)
    assert desk.record(FAILED) == "retry"
    found = desk.read()
    assert found.failures == outbox.MOST_ATTEMPTS + 1
    assert (found.next_attempt_at - desk.listed()[0].updated_at).total_seconds() > 600
    clock.advance(1801)
    assert desk.record(ADDED) == "delivered"
    found = desk.read()
    assert (found.failures, found.failing_since, found.dead) == (0, None, 1)
    assert {one.state for one in desk.listed()} == {"dead", "delivered"}


def test_other_kinds_give_up_the_delivery_that_is_repeated(desk: Desk) -> None:
    desk.add_folders("one")
    desk.record(FAILED)
    change = WebhookChange(kinds=("job.failed",), paused=False)
    desk.lab.write(managing.change_webhook, "lab", desk.hook.id, change, (), required=OWNER)
    assert desk.ids() == []
    assert [one.state for one in desk.listed()] == ["dead"]


def test_events_that_are_deleted_before_delivery_are_reported(desk: Desk, clock: AdjustableClock) -> None:
    desk.add_folders("one", "two", "three")
    desk.record(FAILED)
    desk.lab.add_skeleton()
    clock.advance(11 * DAY_S)
    desk.add_folders("four")
    assert retention.retire(desk.lab.database, TEN_DAYS).events > 3
    assert desk.read().missed == 3
    batch = desk.batch()
    assert batch is not None
    assert [one.kind for one in batch.deliveries] == ["webhook.events_missed", "collection.created"]
    assert json.loads(batch.deliveries[0].body)["missed"] == 3
    assert [one.state for one in desk.listed()] == ["dead"]
    assert desk.record(ADDED) == "delivered"
    assert desk.read().missed == 0
    assert desk.record(ADDED) == "delivered"
    assert desk.ids() == []


def test_nothing_is_reported_if_the_deleted_events_did_not_concern_the_webhook(
    desk: Desk, clock: AdjustableClock
) -> None:
    desk.lab.add_skeleton("one")
    clock.advance(11 * DAY_S)
    desk.lab.add_skeleton("two")
    desk.lab.database.write(SYSTEM, events.number_events)
    retention.retire(desk.lab.database, TEN_DAYS)
    assert desk.read().missed == 0


def test_old_deliveries_and_replaced_secrets_are_deleted(desk: Desk, clock: AdjustableClock) -> None:
    desk.lab.write(deliveries.request_test, "lab", desk.hook.id, required=OWNER)
    assert desk.record(FAILED) == "dead"
    clock.advance(9 * DAY_S)
    retention.retire(desk.lab.database, TEN_DAYS)
    assert len(desk.listed()) == 1
    clock.advance(2 * DAY_S)
    retention.retire(desk.lab.database, TEN_DAYS)
    assert desk.listed() == []


def test_the_webhooks_of_a_deleted_project_wait_until_it_is_restored(desk: Desk) -> None:
    desk.add_folders("one")
    desk.lab.write(
        projects.delete_project, "lab", expected_rev=None, required=declared("DELETE", "/projects/{project}")
    )
    assert desk.batch() is None
    desk.lab.write(projects.restore_project, "lab", required=OWNER)
    assert len(desk.ids()) == 1


def test_the_search_for_work_finds_webhooks_with_news_or_a_due_retry(desk: Desk, clock: AdjustableClock) -> None:
    def find(after: int | None) -> outbox.Work:
        return desk.lab.database.read(SYSTEM, outbox.find_work, after)

    work = find(None)
    assert work.webhook_ids == {desk.hook.id}
    assert find(work.newest).webhook_ids == frozenset()
    desk.add_folders("one")
    assert find(work.newest).webhook_ids == {desk.hook.id}
    desk.record(FAILED)
    work = find(find(None).newest)
    assert work.webhook_ids == frozenset()
    assert work.next_us is not None
    clock.advance(6)
    assert find(work.newest).webhook_ids == {desk.hook.id}
    desk.lab.write(managing.change_webhook, "lab", desk.hook.id, WebhookChange(paused=True), (), required=OWNER)
    assert not find(None).any


def test_the_check_of_the_store_finds_damaged_webhooks(desk: Desk) -> None:
    def change(**values: Any) -> None:
        desk.lab.database.write(SYSTEM, lambda tx: tx.execute(update(webhook).values(**values)))

    desk.add_folders("one")
    desk.record(FAILED)
    assert list(check_store(desk.lab.database)) == []
    change(position=10**9, secret="whsec_AAAA")
    found = {(one.code, one.subject, one.detail) for one in check_store(desk.lab.database)}
    assert found == {
        ("webhook-corrupt", desk.hook.id, "its position is after the newest event"),
        ("webhook-corrupt", desk.hook.id, "its secret is damaged"),
    }
    change(position=0, secret=desk.hook.secret)
    desk.lab.database.write(SYSTEM, lambda tx: tx.execute(delete(webhook_delivery)))
    [defect] = check_store(desk.lab.database)
    assert defect.detail == "the delivery that it repeats is missing"


def test_a_position_moves_past_events_that_do_not_concern_the_webhook(desk: Desk) -> None:
    desk.lab.add_skeleton()
    desk.lab.database.write(SYSTEM, events.number_events)
    newest = desk.lab.database.read(SYSTEM, events.newest_number)
    batch = desk.batch()
    assert batch is not None
    desk.lab.database.write(SYSTEM, outbox.move_on, desk.hook.id, batch.position, newest)
    moved = desk.batch()
    assert moved is not None
    assert moved.position == newest


class Silence:
    """Sender whose receivers answer only when `answering` is set; it records where requests were sent."""

    def __init__(self) -> None:
        self.asked: dict[str, Destination] = {}
        self.answering = asyncio.Event()

    async def send(self, destination: Destination, delivery: outbox.Delivery) -> DeliveryResult:
        self.asked[delivery.webhook_id] = destination
        await self.answering.wait()
        return ADDED

    def close(self) -> None:
        """Do nothing."""


@asynccontextmanager
async def delivering_with(lab: Lab, sender: Silence) -> AsyncIterator[None]:
    """Deliver with this sender; the test fails after 30 s."""
    metrics = SimpleNamespace(webhook_deliveries=MagicMock(), webhook_delay=MagicMock())
    settings = SimpleNamespace(webhook_networks=(), webhook_failing_days=0)
    services: Any = SimpleNamespace(settings=settings, database=lab.database, metrics=metrics)
    deliverer: Any = delivering.Deliverer(services)
    deliverer._sender.close()
    deliverer._sender = sender
    running = asyncio.create_task(deliverer.run())
    async with asyncio.timeout(30):
        yield
    running.cancel()
    await deliverer.close()


async def until(condition: Callable[[], bool]) -> None:
    while not condition():
        await asyncio.sleep(0.01)


def test_a_user_whose_receivers_do_not_answer_does_not_delay_others(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(delivering, "MOST_AT_ONCE", MOST_OF_ONE_USER + 1)
    monkeypatch.setattr(delivering, "STOP_S", 0.0)
    mine, other = [Desk(lab) for _ in range(2 * MOST_OF_ONE_USER)], Desk(lab, "item.created").hook.id
    created = update(webhook).where(webhook.c.id == other).values(creator_id=lab.stranger.user_id)
    lab.database.write(SYSTEM, lambda tx: tx.execute(created))
    lab.database.write(SYSTEM, leader.give_up_lead, "webhooks", "a")
    mine[0].add_folders("one")
    sender = Silence()

    async def deliver() -> None:
        async with delivering_with(lab, sender):
            await until(lambda: len(sender.asked) == MOST_OF_ONE_USER)
            await asyncio.to_thread(lab.add_skeleton)
            await asyncio.to_thread(lab.database.write, SYSTEM, events.number_events)
            await until(lambda: other in sender.asked)

    asyncio.run(deliver())
    assert len(sender.asked) == MOST_OF_ONE_USER + 1


@pytest.mark.parametrize("change", [WebhookChange(url="https://example.net/"), WebhookChange(paused=True)])
def test_a_change_while_a_delivery_waits_for_its_share_counts(
    lab: Lab, monkeypatch: pytest.MonkeyPatch, change: WebhookChange
) -> None:
    monkeypatch.setattr(delivering, "STOP_S", 0.0)
    desks = [Desk(lab) for _ in range(MOST_OF_ONE_USER + 1)]
    lab.database.write(SYSTEM, leader.give_up_lead, "webhooks", "a")
    desks[0].add_folders("one")
    sender = Silence()

    async def deliver() -> None:
        async with delivering_with(lab, sender):
            await until(lambda: len(sender.asked) == MOST_OF_ONE_USER)
            [waiting] = [one for one in desks if one.hook.id not in sender.asked]
            await asyncio.to_thread(
                lab.write, managing.change_webhook, "lab", waiting.hook.id, change, (), required=OWNER
            )
            rotated = await asyncio.to_thread(
                lab.write, managing.rotate_secret, "lab", waiting.hook.id, WebhookRotation(grace_s=0), required=OWNER
            )
            sender.answering.set()
            if change.paused:
                await until(lambda: all(one.ids() == [] for one in desks))
                assert waiting.hook.id not in sender.asked
            else:
                await until(lambda: waiting.hook.id in sender.asked)
                assert sender.asked[waiting.hook.id] == Destination("https://example.net/", (rotated.secret,))

    asyncio.run(deliver())


def test_a_delivery_that_was_read_before_the_wanted_kinds_changed_is_not_sent(desk: Desk) -> None:
    desk.add_folders("one")
    batch = desk.batch()
    assert batch is not None
    [delivery], before = batch.deliveries, (batch.position, batch.attempts)
    assert desk.lab.database.read(SYSTEM, outbox.read_destination, delivery, before) is not None
    change = WebhookChange(kinds=("job.failed",))
    desk.lab.write(managing.change_webhook, "lab", desk.hook.id, change, (), required=OWNER)
    assert desk.lab.database.read(SYSTEM, outbox.read_destination, delivery, before) is None
