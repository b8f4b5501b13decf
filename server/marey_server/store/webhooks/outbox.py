"""Database access of the process that sends deliveries: reads the next deliveries, and records their outcomes.

The position of a webhook is the number of the last event that was delivered or given up, so events are sent in their
order. The transaction that records an outcome also moves the position. So if a process dies, no delivery is lost. The
next process repeats at most the deliveries whose outcome was not recorded. Only the leading process sends deliveries.
If it loses the lead before it records an outcome, the outcome is not recorded.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple

from sqlalchemy import Row, and_, delete, func, or_, select, update

from marey_schemas.address import API
from marey_schemas.backoff import Backoff
from marey_schemas.kinds import Kind
from marey_schemas.webhooks import WebhookMessage
from marey_server.store import events, leader
from marey_server.store.database.clock import DAY_US, datetime_of
from marey_server.store.leader import Lead
from marey_server.store.tables import event, project, webhook, webhook_delivery
from marey_server.store.transaction import Transaction
from marey_server.store.webhooks.managing import give_up_retries, host_of

MOST_ATTEMPTS = 8
"""Number of attempts after which a delivery is given up."""
RETRY = Backoff(first_s=5.0, longest_s=1800.0)
"""Wait after failed attempts of a webhook; it grows with each failure since the webhook's last success.

The first eight attempts take five to eleven minutes together. After many failures, the wait is 15 to 30 minutes.
"""
BATCH = 100
"""Greatest number of deliveries that are read at once."""
SKIPPED_MOST = 10_000
"""Number of skipped events, which do not concern a webhook, after which the webhook's new position is stored."""
MISSED_KIND = "webhook.events_missed"

Outcome = Literal["delivered", "retry", "dead"]


class Work(NamedTuple):
    """Webhooks for which there may be something to send, the number of the newest event, and the next retry.

    Times are in microseconds since 1970. `next_us` is the time of the next retry, or None if no retry is waiting.
    """

    any: bool
    """Whether any webhook is not paused."""
    webhook_ids: frozenset[str]
    newest: int
    next_us: int | None
    now_us: int


def find_work(tx: Transaction, after: int | None) -> Work:
    """Return the webhooks that may have something to send.

    A webhook may have something to send if its retry is due, or if its project has events after the one numbered
    `after`. If `after` is None, all webhooks that are not paused are returned.
    """
    newest = events.newest_number(tx)
    active = webhook.c.paused.is_(False)
    due = and_(webhook.c.next_us > 0, webhook.c.next_us <= tx.now_us)
    if tx.execute(select(webhook.c.id).where(active).limit(1)).first() is None:
        return Work(False, frozenset(), newest, None, tx.now_us)
    statement = select(webhook.c.id).where(active)
    if after is not None:
        changed = select(event.c.project_id).where(events.follows(tx, after), event.c.project_id.is_not(None))
        statement = statement.where(or_(due, webhook.c.project_id.in_(changed.distinct())))
    found = frozenset(tx.execute(statement).scalars())
    next_us = tx.execute(select(func.min(webhook.c.next_us)).where(active, webhook.c.next_us > tx.now_us)).scalar()
    return Work(True, found, newest, next_us, tx.now_us)


# -- what to send -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Delivery:
    """Delivery that can be sent.

    A delivery that a user requested (`requested`) is sent once. All others report the events after the position of the
    webhook, in order, and their outcomes move the position.
    """

    id: str
    webhook_id: str
    kind: str
    number: int | None
    body: str = field(repr=False)
    at_us: int
    requested: bool = False
    missed: int = 0
    """Number of missed events that the delivery reports."""


@dataclass(frozen=True)
class Batch:
    """Next deliveries of a webhook in order, with its position and its number of attempts when they were read."""

    sharer: str
    """Id of the user who created the webhook, or of the webhook if the user is unknown.

    The number of simultaneous deliveries is limited for all webhooks with the same value together.
    """
    position: int
    attempts: int
    deliveries: tuple[Delivery, ...]
    complete: bool
    """Whether there is nothing more to send at present."""
    waits: bool
    """Whether events wait because the next retry of the webhook is not due yet."""


@dataclass(frozen=True)
class Destination:
    """URL of a webhook, and the secrets with which a request to it is signed."""

    url: str = field(repr=False)
    secrets: tuple[str, ...] = field(repr=False)


def next_batch(tx: Transaction, webhook_id: str, scanned: int) -> Batch | None:
    """Return the next deliveries of a webhook, or None if the webhook is paused or deleted, or its project is deleted.

    The search for events begins after the position of the webhook, or after the event numbered `scanned` if that is
    later: the caller knows that no event in between concerns the webhook.
    """
    row = _find_active(tx, webhook_id)
    if row is None:
        return None
    found = _requested(tx, webhook_id)
    if row.next_us > tx.now_us:
        return _batch(row, found, complete=True, waits=True)
    if row.missed:
        found.append(_missed(row, tx.now_us))
    start = events.start_of_feed(tx, max(row.position, scanned))
    following = [] if len(found) >= BATCH else _events(tx, row, start)
    complete = len(found) < BATCH and len(following) < BATCH
    return _batch(row, [*found, *following], complete=complete, waits=False)


def read_destination(tx: Transaction, delivery: Delivery, before: tuple[int, int]) -> Destination | None:
    """Return where to send a delivery, or None if it must not be sent any more.

    Call this right before sending, because a delivery may wait for a long time. In this time, the webhook may get
    another URL, another secret or other kinds of events, or may be paused or deleted. `before` is the position of the
    webhook and its number of attempts when the delivery was read.
    """
    row = _find_active(tx, delivery.webhook_id)
    if row is None:
        return None
    wanted = (row.position, row.attempts) == before and delivery.kind in (*row.kinds, MISSED_KIND)
    return Destination(row.url, _secrets(row, tx.now_us)) if delivery.requested or wanted else None


def _find_active(tx: Transaction, webhook_id: str) -> Row[Any] | None:
    """Return the row of a webhook, or None if it is paused or deleted, or its project is deleted."""
    statement = select(webhook, project.c.name.label("project")).join(project, project.c.id == webhook.c.project_id)
    active = webhook.c.paused.is_(False), project.c.deleted_us.is_(None)
    return tx.execute(statement.where(webhook.c.id == webhook_id, *active)).first()


def _batch(row: Row[Any], found: list[Delivery], *, complete: bool, waits: bool) -> Batch:
    return Batch(row.creator_id or row.id, row.position, row.attempts, tuple(found), complete, waits)


def _secrets(row: Row[Any], now_us: int) -> tuple[str, ...]:
    if row.old_secret is None or row.old_secret_until_us <= now_us:
        return (row.secret,)
    return row.secret, row.old_secret


def _requested(tx: Transaction, webhook_id: str) -> list[Delivery]:
    which = (webhook_delivery.c.webhook_id == webhook_id, webhook_delivery.c.state == "waiting")
    rows = tx.execute(select(webhook_delivery).where(*which).order_by(webhook_delivery.c.created_us).limit(BATCH))
    return [
        Delivery(row.id, webhook_id, row.kind, row.number, row.body, row.updated_us, requested=True) for row in rows
    ]


def _missed(row: Row[Any], now_us: int) -> Delivery:
    """Return the delivery that reports to a webhook how many events were deleted before they could be delivered."""
    delivery_id = f"{row.id}-missed-{row.position}"
    message = WebhookMessage(
        id=delivery_id, kind=MISSED_KIND, seq=row.position, project=row.project, at=datetime_of(now_us),
        subject=row.id, missed=row.missed,
        links={"events": f"{API}/projects/{row.project}/events?after={row.position}"},
    )  # fmt: skip
    return Delivery(delivery_id, row.id, MISSED_KIND, row.position, message.encoded(), now_us, missed=row.missed)


def _events(tx: Transaction, row: Row[Any], after: int) -> list[Delivery]:
    number = events.number_of(tx)
    concerned = (event.c.project_id == row.project_id, event.c.kind.in_(row.kinds), events.follows(tx, after))
    statement = select(event, number.label("place")).where(*concerned).order_by(number).limit(BATCH)
    return [_of_event(row, found) for found in tx.execute(statement)]


def _of_event(row: Row[Any], found: Row[Any]) -> Delivery:
    delivery_id = f"{row.id}-{found.place}"
    links = {"event": f"{API}/projects/{row.project}/events?after={found.place - 1}&limit=1"}
    message = WebhookMessage(
        id=delivery_id, kind=found.kind, seq=found.place, project=row.project, at=datetime_of(found.at_us),
        subject=found.subject, links=links | _subject_link(row.project, found),
    )  # fmt: skip
    return Delivery(delivery_id, row.id, found.kind, found.place, message.encoded(), found.at_us)


def _subject_link(project_name: str, found: Row[Any]) -> dict[str, str]:
    """Return the link (`subject`) to the job or the item that an event concerns; empty for other events."""
    about = found.kind.partition(".")[0]
    if about == "job":
        return {"subject": f"{API}/jobs/{found.subject}"}
    if about == "item" and found.body.get("item_kind") in set(Kind):
        kind = Kind(found.body["item_kind"])
        return {"subject": f"{API}/projects/{project_name}/{kind.plural}/{found.subject}"}
    return {}


def move_on(tx: Transaction, webhook_id: str, position: int, to: int) -> None:
    """Move the position of a webhook forward, past events that do not concern it, unless the position has changed."""
    tx.execute(update(webhook).where(webhook.c.id == webhook_id, webhook.c.position == position).values(position=to))


# -- outcomes ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class DeliveryResult:
    """Result of one attempt: the HTTP status, if there was an answer, and the reason of a failure."""

    status: int | None
    error: str | None = None


class Recorded(NamedTuple):
    """Outcome of an attempt, and the time at which it was recorded, on the clock of the database."""

    outcome: Outcome
    now_us: int


def record(
    tx: Transaction, lead: Lead, delivery: Delivery, result: DeliveryResult, before: tuple[int, int], failing_days: int
) -> Recorded | None:
    """Record the result of an attempt, and return the outcome.

    `before` is the position of the webhook and its number of attempts when the delivery was sent. Returns None and
    records nothing if another process leads now, or if the webhook was changed in the meantime. If every attempt has
    failed for `failing_days` days, the webhook is paused; with 0, it is never paused.
    """
    if not leader.holds_lead(tx, lead):
        return None
    row = tx.execute(select(webhook).where(webhook.c.id == delivery.webhook_id).with_for_update()).first()
    if row is None:
        return None
    if delivery.requested:
        outcome: Outcome = "delivered" if result.error is None else "dead"
        _note(tx, delivery, result, outcome)
        return Recorded(outcome, tx.now_us)
    if (row.position, row.attempts) != before:
        return None
    if result.error is None:
        _succeed(tx, row, delivery, result)
        return Recorded("delivered", tx.now_us)
    return Recorded(_fail(tx, row, delivery, result, failing_days), tx.now_us)


def _succeed(tx: Transaction, row: Row[Any], delivery: Delivery, result: DeliveryResult) -> None:
    retried = (webhook_delivery.c.id == delivery.id, webhook_delivery.c.state == "retrying")
    noted = {"state": "delivered", "last_status": result.status, "last_error": None, "updated_us": tx.now_us}
    tx.execute(update(webhook_delivery).where(*retried).values(**noted, attempts=webhook_delivery.c.attempts + 1))
    values: dict[str, Any] = {
        "position": delivery.number, "attempts": 0, "failures": 0, "next_us": 0, "failing_since_us": None,
        "delivered_us": tx.now_us, "last_status": result.status, "last_error": None,
        "missed": webhook.c.missed - delivery.missed,
    }  # fmt: skip
    tx.execute(update(webhook).where(webhook.c.id == row.id).values(**values))


def _fail(tx: Transaction, row: Row[Any], delivery: Delivery, result: DeliveryResult, failing_days: int) -> Outcome:
    dead = row.attempts + 1 >= MOST_ATTEMPTS
    _note(tx, delivery, result, "dead" if dead else "retry")
    since_us = row.failing_since_us or tx.now_us
    values: dict[str, Any] = {
        "attempts": 0 if dead else row.attempts + 1, "failures": row.failures + 1, "failing_since_us": since_us,
        "next_us": tx.now_us + round(RETRY.delay_s(row.failures + 1) * 1_000_000),
        "last_status": result.status, "last_error": result.error,
    }  # fmt: skip
    if dead:
        values |= {"position": delivery.number, "missed": webhook.c.missed - delivery.missed}
    if failing_days and since_us < tx.now_us - failing_days * DAY_US:
        reason = f"every attempt has failed for {failing_days} days; the last error: {result.error}"
        values |= {"paused": True, "paused_reason": reason, "updated_us": tx.now_us}
        tx.audit("webhook.changed", row.id, about=host_of(row.url), project_id=row.project_id, fields=["paused"])
    tx.execute(update(webhook).where(webhook.c.id == row.id).values(**values))
    return "dead" if dead else "retry"


def _note(tx: Transaction, delivery: Delivery, result: DeliveryResult, outcome: Outcome) -> None:
    """Record the result of an attempt in the row of its delivery, which is created at the first attempt."""
    state = "retrying" if outcome == "retry" else outcome
    noted = {
        "state": state, "last_status": result.status, "last_error": result.error, "updated_us": tx.now_us
    }  # fmt: skip
    row = {
        "id": delivery.id, "webhook_id": delivery.webhook_id, "kind": delivery.kind, "number": delivery.number,
        "body": delivery.body, "attempts": 1, "created_us": tx.now_us, **noted,
    }  # fmt: skip
    added = tx.insert_into(webhook_delivery, row)
    again = {**noted, "attempts": webhook_delivery.c.attempts + 1}
    tx.execute(added.on_conflict_do_update(index_elements=[webhook_delivery.c.id], set_=again))


# -- retention --------------------------------------------------------------------------------------------------------


def count_missed(tx: Transaction, last: int) -> None:
    """Count, for each webhook, the undelivered events with numbers up to `last`, which are about to be deleted.

    A webhook misses these events: its position moves to `last`, and a later delivery reports how many it has missed.
    """
    for row in tx.execute(select(webhook).where(webhook.c.position < last).with_for_update()).all():
        number = events.number_of(tx)
        concerned = (event.c.project_id == row.project_id, event.c.kind.in_(row.kinds), number <= last)
        missed = select(func.count()).where(*concerned, events.follows(tx, events.start_of_feed(tx, row.position)))
        count = tx.execute(missed).scalar_one()
        if count:
            moved = {"position": last, "missed": webhook.c.missed + count, "attempts": 0}
            tx.execute(update(webhook).where(webhook.c.id == row.id).values(**moved))
            give_up_retries(tx, row.id)


def delete_old_deliveries(tx: Transaction, age_us: int, most: int) -> int:
    """Delete at most `most` deliveries that ended more than `age_us` ago, and return how many."""
    old = (webhook_delivery.c.updated_us < tx.now_us - age_us, webhook_delivery.c.state.in_(("delivered", "dead")))
    some = list(tx.execute(select(webhook_delivery.c.id).where(*old).limit(most)).scalars())
    tx.execute(delete(webhook_delivery).where(webhook_delivery.c.id.in_(some), *old))
    return len(some)
