"""Stored deliveries of webhooks, which failed or were requested as tests or repetitions, and their repetition."""

from __future__ import annotations

from typing import Any

from sqlalchemy import Row, insert, select, update

from marey_schemas.items import Page
from marey_schemas.webhooks import DeliveryState, WebhookDelivery, WebhookMessage
from marey_server.errors import ConflictProblem, NotFoundProblem
from marey_server.store import listing, projects
from marey_server.store.database.clock import datetime_of
from marey_server.store.ids import new_id
from marey_server.store.projects import ProjectRow
from marey_server.store.tables import webhook, webhook_delivery
from marey_server.store.transaction import Transaction
from marey_server.store.webhooks.managing import find_webhook, no_webhook

TEST_KIND = "webhook.test"
MOST_WAITING = 1000
"""Greatest number of deliveries of a webhook that were requested and are not sent yet."""


def list_deliveries(
    tx: Transaction, project: str, webhook_id: str, *, state: DeliveryState | None, cursor: str | None, limit: int
) -> Page:
    """List the deliveries of a webhook that failed or were requested, newest first."""
    found = find_webhook(tx, projects.require(tx, project), webhook_id)
    statement = select(webhook_delivery).where(webhook_delivery.c.webhook_id == found.id)
    if state is not None:
        statement = statement.where(webhook_delivery.c.state == state)
    keys = {"created": webhook_delivery.c.created_us, "id": webhook_delivery.c.id}
    order = listing.parse_order("-created", keys)
    rows, following = listing.read_page(tx, statement, order, ["deliveries", found.id, state], cursor, limit)
    return Page(items=tuple(map(_shown, rows)), next_cursor=following)


def read_delivery(tx: Transaction, project: str, webhook_id: str, delivery_id: str) -> WebhookDelivery:
    """Return a delivery that failed or was requested; raise `NotFoundProblem` for others, which are not stored."""
    return _shown(_find(tx, projects.require(tx, project), webhook_id, delivery_id))


def _find(tx: Transaction, project_row: ProjectRow, webhook_id: str, delivery_id: str) -> Row[Any]:
    found = find_webhook(tx, project_row, webhook_id)
    which = (webhook_delivery.c.id == delivery_id, webhook_delivery.c.webhook_id == found.id)
    row = tx.execute(select(webhook_delivery).where(*which)).first()
    if row is None:
        raise NotFoundProblem(
            f"The webhook has no delivery {delivery_id!r}. Only deliveries that failed or were requested are stored.",
            code="no-delivery",
        )
    return row


def _shown(row: Row[Any]) -> WebhookDelivery:
    return WebhookDelivery(
        id=row.id, webhook=row.webhook_id, kind=row.kind, seq=row.number, state=row.state, attempts=row.attempts,
        last_status=row.last_status, last_error=row.last_error, created_at=datetime_of(row.created_us),
        updated_at=datetime_of(row.updated_us),
    )  # fmt: skip


def request_test(tx: Transaction, project: str, webhook_id: str) -> WebhookDelivery:
    """Request a delivery of the kind `webhook.test`, which is sent once.

    Raises `ConflictProblem` if the webhook is paused or has too many requested deliveries.
    """
    project_row = projects.require(tx, project)
    _require_active(tx, project_row, webhook_id)
    delivery_id = new_id("delivery")
    message = WebhookMessage(
        id=delivery_id, kind=TEST_KIND, project=project, at=datetime_of(tx.now_us), subject=webhook_id
    )
    values = {
        "id": delivery_id, "webhook_id": webhook_id, "kind": TEST_KIND, "body": message.encoded(), "state": "waiting",
        "attempts": 0, "created_us": tx.now_us, "updated_us": tx.now_us,
    }  # fmt: skip
    tx.execute(insert(webhook_delivery).values(**values))
    tx.emit("webhook.requested", webhook_id, project_id=project_row.id)
    return _shown(_find(tx, project_row, webhook_id, delivery_id))


def redeliver(tx: Transaction, project: str, webhook_id: str, delivery_id: str) -> WebhookDelivery:
    """Request that a delivery is sent once more, and return it.

    Raises `ConflictProblem` if the delivery is still being retried, or if the webhook is paused or has too many
    requested deliveries.
    """
    project_row = projects.require(tx, project)
    _require_active(tx, project_row, webhook_id)
    row = _find(tx, project_row, webhook_id, delivery_id)
    if row.state == "retrying":
        raise ConflictProblem(
            "The server is still retrying this delivery. To retry it at once, resume the webhook.",
            code="still-retrying",
        )
    values = {"state": "waiting", "updated_us": tx.now_us}
    tx.execute(update(webhook_delivery).where(webhook_delivery.c.id == row.id).values(**values))
    tx.emit("webhook.requested", webhook_id, project_id=project_row.id)
    return _shown(_find(tx, project_row, webhook_id, delivery_id))


def _require_active(tx: Transaction, project_row: ProjectRow, webhook_id: str) -> None:
    """Lock a webhook of the project until the transaction ends.

    Raises `NotFoundProblem` if there is no such webhook, and `ConflictProblem` if it is paused or has `MOST_WAITING`
    requested deliveries that wait.
    """
    which = (webhook.c.id == webhook_id, webhook.c.project_id == project_row.id)
    row = tx.execute(select(webhook.c.paused).where(*which).with_for_update()).first()
    if row is None:
        raise no_webhook(webhook_id)
    if row.paused:
        raise ConflictProblem("The webhook is paused; resume it first.", code="webhook-paused")
    waiting = select(webhook_delivery.c.id).where(
        webhook_delivery.c.webhook_id == webhook_id, webhook_delivery.c.state == "waiting"
    )
    if len(tx.execute(waiting.limit(MOST_WAITING)).all()) == MOST_WAITING:
        raise ConflictProblem(
            f"{MOST_WAITING:,} requested deliveries of this webhook wait already; wait until some are sent.",
            code="too-many-deliveries",
        )
