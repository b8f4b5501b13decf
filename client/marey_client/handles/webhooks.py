"""Handles of webhooks, which send the events of a project to addresses, and of their deliveries."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import timedelta

from marey_client.arguments import checked, checks_arguments
from marey_client.asynchronous.interruption import pause
from marey_client.paging import pages
from marey_client.transport import Params, Transport, as_json, named_path, read_model, sends_nothing
from marey_schemas.event_kinds import DEFAULT_WEBHOOK_KINDS, ProjectEventKind
from marey_schemas.webhooks import (
    DeliveryState,
    NewWebhook,
    Webhook,
    WebhookChange,
    WebhookCreate,
    WebhookDelivery,
    WebhookRotation,
)

LOOK_EVERY_S = 0.2


@checks_arguments
@dataclass(frozen=True)
class Webhooks:
    """Webhooks of a project; only its owners may use them."""

    transport: Transport
    url: str

    def create(
        self, url: str, kinds: Sequence[ProjectEventKind] = DEFAULT_WEBHOOK_KINDS, *, description: str = ""
    ) -> NewWebhook:
        """Create a webhook that sends events of these kinds to `url`.

        Only the answer contains the secret. Raises `Invalid` if the server does not send to this URL, and `Conflict` if
        the project has too many webhooks.
        """
        request = checked(WebhookCreate, url=url, kinds=tuple(kinds), description=description)
        return self.transport.post(NewWebhook, self.url, request, repeatable=False)

    def list(self) -> Iterator[Webhook]:
        """List the webhooks, oldest first, without their secrets."""
        return pages(self.transport, Webhook, self.url)

    @sends_nothing
    def at(self, webhook_id: str) -> WebhookHandle:
        """Return a handle of the webhook with this id; no request is sent."""
        return WebhookHandle(self.transport, named_path(self.url, webhook_id))


@checks_arguments
@dataclass(frozen=True)
class WebhookHandle:
    """Handle of a webhook; requests are sent only by its methods."""

    transport: Transport
    url: str

    def read(self) -> Webhook:
        """Return the webhook and the result of its last attempt."""
        return self.transport.get(Webhook, self.url)

    def change(self, change: WebhookChange) -> Webhook:
        """Change, pause or resume the webhook; fields that are None stay as they are."""
        return read_model(Webhook, self.transport.send("PATCH", self.url, content=as_json(change)))

    def rotate(self, *, grace: timedelta = timedelta(days=1)) -> NewWebhook:
        """Replace the secret, and return the webhook with the new secret, which cannot be read later.

        For the duration `grace`, deliveries are also signed with the old secret.
        """
        request = WebhookRotation(grace_s=int(grace.total_seconds()))
        return self.transport.post(NewWebhook, f"{self.url}/rotate", request, repeatable=False)

    def delete(self) -> None:
        """Delete the webhook and its deliveries."""
        self.transport.send("DELETE", self.url)

    def deliveries(self, state: DeliveryState | None = None) -> Iterator[WebhookDelivery]:
        """List deliveries that failed or that a user requested, newest first; with `state`, only in this state."""
        query: Params = {} if state is None else {"state": state}
        return pages(self.transport, WebhookDelivery, f"{self.url}/deliveries", query)

    def delivery(self, delivery_id: str) -> WebhookDelivery:
        """Return a delivery with the result of its last attempt."""
        return self.transport.get(WebhookDelivery, named_path(f"{self.url}/deliveries", delivery_id))

    def redeliver(self, delivery_id: str) -> WebhookDelivery:
        """Request that a delivery is sent once more; the method `wait` returns its result."""
        return self.transport.post(
            WebhookDelivery, f"{named_path(f'{self.url}/deliveries', delivery_id)}/redeliver", repeatable=False
        )

    def test(self) -> WebhookDelivery:
        """Request a delivery of the kind `webhook.test`; the method `wait` returns its result."""
        return self.transport.post(WebhookDelivery, f"{self.url}/test", repeatable=False)

    def wait(self, delivery_id: str, *, timeout_s: float = 30.0) -> WebhookDelivery:
        """Wait until a requested delivery has been attempted, and return it.

        After `timeout_s`, the delivery is returned even if it is still waiting.
        """
        deadline = time.monotonic() + timeout_s
        found = self.delivery(delivery_id)
        while found.state == "waiting" and time.monotonic() < deadline:
            pause(LOOK_EVERY_S)
            found = self.delivery(delivery_id)
        return found
