"""Webhooks as resources of a project: its owners create, list, change and delete them, and replace their secrets."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any
from urllib.parse import urlsplit

from sqlalchemy import Row, Select, delete, func, insert, select, update

from marey_schemas.items import Page
from marey_schemas.webhooks import NewWebhook, Webhook, WebhookChange, WebhookCreate, WebhookRotation
from marey_server.access.network_addresses import Network, literal_address, may_connect
from marey_server.access.webhook_signatures import issue_secret
from marey_server.errors import InvalidProblem, NotFoundProblem
from marey_server.store import events, listing, projects
from marey_server.store.database.clock import datetime_of
from marey_server.store.ids import new_id
from marey_server.store.projects import ProjectRow
from marey_server.store.quotas import counting
from marey_server.store.tables import user, webhook, webhook_delivery
from marey_server.store.transaction import Transaction

RETRY_NOW: dict[str, Any] = {"attempts": 0, "failures": 0, "next_us": 0, "failing_since_us": None}
"""Values of the columns of a webhook with which the server makes the next attempt at once."""

_SECRETS = (webhook.c.secret, webhook.c.old_secret)
_SHOWN = tuple(column for column in webhook.c if column not in frozenset(_SECRETS))
"""Columns of a webhook that are read to show it: all except the secrets."""
_DEAD = (
    select(func.count())
    .where(webhook_delivery.c.webhook_id == webhook.c.id, webhook_delivery.c.state == "dead")
    .scalar_subquery()
)


def list_webhooks(tx: Transaction, project: str, *, cursor: str | None, limit: int) -> Page:
    """List the webhooks of a project, oldest first, without their secrets."""
    project_row = projects.require(tx, project)
    order = listing.parse_order("id", {"id": webhook.c.id})
    rows, following = listing.read_page(tx, _rows(project_row), order, ["webhooks", project_row.id], cursor, limit)
    return Page(items=tuple(_shown(project, row) for row in rows), next_cursor=following)


def read_webhook(tx: Transaction, project: str, webhook_id: str) -> Webhook:
    """Return a webhook without its secret."""
    return _shown(project, find_webhook(tx, projects.require(tx, project), webhook_id))


def find_webhook(tx: Transaction, project_row: ProjectRow, webhook_id: str) -> Row[Any]:
    """Return the row of a webhook of a project, without its secrets. Raises `NotFoundProblem` if it does not exist."""
    row = tx.execute(_rows(project_row).where(webhook.c.id == webhook_id)).first()
    if row is None:
        raise no_webhook(webhook_id)
    return row


def no_webhook(webhook_id: str) -> NotFoundProblem:
    """Return the error for a webhook that the project does not have."""
    return NotFoundProblem(f"The project has no webhook {webhook_id!r}.", code="no-webhook")


def _rows(project_row: ProjectRow) -> Select[*tuple[Any, ...]]:
    return (
        select(*_SHOWN, user.c.name.label("creator"), _DEAD.label("dead"))
        .select_from(webhook.outerjoin(user, user.c.id == webhook.c.creator_id))
        .where(webhook.c.project_id == project_row.id)
    )


def _shown(project: str, row: Row[Any]) -> Webhook:
    return Webhook(
        id=row.id, project=project, url=row.url, kinds=tuple(row.kinds), description=row.description,
        creator=row.creator, paused=row.paused, paused_reason=row.paused_reason,
        created_at=datetime_of(row.created_us), updated_at=datetime_of(row.updated_us),
        delivered_at=None if row.delivered_us is None else datetime_of(row.delivered_us),
        failures=row.failures,
        failing_since=None if row.failing_since_us is None else datetime_of(row.failing_since_us),
        next_attempt_at=datetime_of(row.next_us) if row.next_us and not row.paused else None,
        last_status=row.last_status, last_error=row.last_error, missed=row.missed, dead=row.dead,
    )  # fmt: skip


def create_webhook(tx: Transaction, project: str, request: WebhookCreate, networks: Sequence[Network]) -> NewWebhook:
    """Create a webhook, which is notified of later events, and return it with its secret.

    Raises `QuotaExceededProblem` if the project has too many webhooks. Raises `InvalidProblem` if the URL has the
    address of a private network that is not among `networks`.
    """
    project_row = projects.require(tx, project)
    _require_public(request.url, networks)
    counting.require_place(tx, project_row.id, webhook)
    secret = issue_secret()
    while events.number_events(tx) == events.NUMBERED_AT_ONCE:
        pass
    webhook_id = new_id("webhook")
    values = {
        "id": webhook_id, "project_id": project_row.id, "creator_id": tx.principal.user_id,
        "url": request.url, "kinds": list(request.kinds), "description": request.description, "secret": secret,
        "position": events.newest_number(tx), "created_us": tx.now_us, "updated_us": tx.now_us,
    }  # fmt: skip
    tx.execute(insert(webhook).values(**values))
    tx.audit("webhook.created", webhook_id, about=host_of(request.url), project_id=project_row.id)
    return _with_secret(tx, project_row, webhook_id, secret)


def host_of(url: str) -> str:
    """Return the host of a URL, which the audit log contains in place of the URL.

    The rest of the URL may contain secrets.
    """
    return urlsplit(url).hostname or ""


def _require_public(url: str, networks: Sequence[Network]) -> None:
    host = host_of(url)
    address = literal_address(host)
    if address is not None and not may_connect(address, networks):
        raise InvalidProblem(
            f"The host {host!r} of the URL is not a public address. The server sends deliveries to public addresses, "
            "and to the networks that the operator lists in the setting `webhook_networks`.",
            code="private-address",
        )


def _with_secret(tx: Transaction, project_row: ProjectRow, webhook_id: str, secret: str) -> NewWebhook:
    found = _shown(project_row.name, find_webhook(tx, project_row, webhook_id))
    return NewWebhook(**found.model_dump(), secret=secret)


def change_webhook(
    tx: Transaction, project: str, webhook_id: str, request: WebhookChange, networks: Sequence[Network]
) -> Webhook:
    """Change, pause or resume a webhook.

    After a change of the URL, and after `paused=False`, the next attempt is made at once. After a change of `kinds`,
    the delivery that is being retried is given up. Raises `InvalidProblem` as `create_webhook` does.
    """
    project_row = projects.require(tx, project)
    find_webhook(tx, project_row, webhook_id)
    values = request.model_dump(exclude_none=True)
    if request.url is not None:
        _require_public(request.url, networks)
        values |= RETRY_NOW
    if request.kinds is not None:
        values |= {"kinds": list(request.kinds), "attempts": 0}
        give_up_retries(tx, webhook_id)  # the event may not be of the new kinds
    if request.paused is not None:
        values["paused_reason"] = None
    if request.paused is False:
        values |= RETRY_NOW
    _update(tx, project_row, webhook_id, values)
    fields = sorted(request.model_dump(exclude_none=True))
    changed = find_webhook(tx, project_row, webhook_id)
    tx.audit("webhook.changed", webhook_id, about=host_of(changed.url), project_id=project_row.id, fields=fields)
    return _shown(project, changed)


def give_up_retries(tx: Transaction, webhook_id: str) -> None:
    """Give up the delivery to a webhook that has failed and that the server would try again."""
    which = (webhook_delivery.c.webhook_id == webhook_id, webhook_delivery.c.state == "retrying")
    tx.execute(update(webhook_delivery).where(*which).values(state="dead", updated_us=tx.now_us))


def _update(tx: Transaction, project_row: ProjectRow, webhook_id: str, values: dict[str, Any]) -> None:
    which = (webhook.c.id == webhook_id, webhook.c.project_id == project_row.id)
    if tx.execute(update(webhook).where(*which).values(**values, updated_us=tx.now_us)).rowcount == 0:
        raise no_webhook(webhook_id)


def rotate_secret(tx: Transaction, project: str, webhook_id: str, request: WebhookRotation) -> NewWebhook:
    """Replace the secret of a webhook, and return the webhook with the new secret.

    For the next `request.grace_s` seconds, deliveries have two signatures: with the new and with the old secret.
    """
    project_row = projects.require(tx, project)
    secret = issue_secret()
    values = {
        "old_secret": webhook.c.secret if request.grace_s else None,
        "old_secret_until_us": tx.now_us + request.grace_s * 1_000_000 if request.grace_s else None,
        "secret": secret,
    }
    _update(tx, project_row, webhook_id, values)
    rotated = _with_secret(tx, project_row, webhook_id, secret)
    tx.audit("webhook.rotated", webhook_id, about=host_of(rotated.url), project_id=project_row.id)
    return rotated


def forget_old_secrets(tx: Transaction) -> None:
    """Delete the replaced secrets whose grace period is over."""
    over = webhook.c.old_secret_until_us <= tx.now_us
    tx.execute(update(webhook).where(over).values(old_secret=None, old_secret_until_us=None))


def delete_webhook(tx: Transaction, project: str, webhook_id: str) -> None:
    """Delete a webhook and its deliveries."""
    project_row = projects.require(tx, project)
    which = (webhook.c.id == webhook_id, webhook.c.project_id == project_row.id)
    url = tx.execute(select(webhook.c.url).where(*which).with_for_update()).scalar()
    if url is None:
        raise no_webhook(webhook_id)
    tx.execute(delete(webhook_delivery).where(webhook_delivery.c.webhook_id == webhook_id))
    tx.execute(delete(webhook).where(*which))
    tx.audit("webhook.deleted", webhook_id, about=host_of(url), project_id=project_row.id)
