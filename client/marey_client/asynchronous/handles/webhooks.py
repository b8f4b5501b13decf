"""Counterparts of `marey_client.handles.webhooks` for async programs.

Written by `make docs` from that module; change it there.
"""

from __future__ import annotations

from collections.abc import AsyncIterator, Sequence
from datetime import timedelta

from marey_client.asynchronous.counterparts import Counterpart, counterpart_of
from marey_client.handles.webhooks import WebhookHandle, Webhooks
from marey_schemas.event_kinds import DEFAULT_WEBHOOK_KINDS, ProjectEventKind
from marey_schemas.webhooks import DeliveryState, NewWebhook, Webhook, WebhookChange, WebhookDelivery


@counterpart_of(Webhooks)
class AsyncWebhooks(Counterpart):
    """Webhooks of a project; only its owners may use them."""

    _sync: Webhooks

    @property
    def url(self) -> str:
        return self._sync.url

    async def create(
        self, url: str, kinds: Sequence[ProjectEventKind] = DEFAULT_WEBHOOK_KINDS, *, description: str = ""
    ) -> NewWebhook:
        """Create a webhook that sends events of these kinds to `url`.

        Only the answer contains the secret. Raises `Invalid` if the server does not send to this URL, and `Conflict` if
        the project has too many webhooks.
        """
        return await self._run(self._sync.create, url, kinds, description=description)

    def list(self) -> AsyncIterator[Webhook]:
        """List the webhooks, oldest first, without their secrets."""
        return self._each(self._sync.list)

    def at(self, webhook_id: str) -> AsyncWebhookHandle:
        """Return a handle of the webhook with this id; no request is sent."""
        exchanged: AsyncWebhookHandle = self._now(self._sync.at, webhook_id)
        return exchanged


@counterpart_of(WebhookHandle)
class AsyncWebhookHandle(Counterpart):
    """Handle of a webhook; requests are sent only by its methods."""

    _sync: WebhookHandle

    @property
    def url(self) -> str:
        return self._sync.url

    async def read(self) -> Webhook:
        """Return the webhook and the result of its last attempt."""
        return await self._run(self._sync.read)

    async def change(self, change: WebhookChange) -> Webhook:
        """Change, pause or resume the webhook; fields that are None stay as they are."""
        return await self._run(self._sync.change, change)

    async def rotate(self, *, grace: timedelta = timedelta(days=1)) -> NewWebhook:
        """Replace the secret, and return the webhook with the new secret, which cannot be read later.

        For the duration `grace`, deliveries are also signed with the old secret.
        """
        return await self._run(self._sync.rotate, grace=grace)

    async def delete(self) -> None:
        """Delete the webhook and its deliveries."""
        await self._run(self._sync.delete)

    def deliveries(self, state: DeliveryState | None = None) -> AsyncIterator[WebhookDelivery]:
        """List deliveries that failed or that a user requested, newest first; with `state`, only in this state."""
        return self._each(self._sync.deliveries, state)

    async def delivery(self, delivery_id: str) -> WebhookDelivery:
        """Return a delivery with the result of its last attempt."""
        return await self._run(self._sync.delivery, delivery_id)

    async def redeliver(self, delivery_id: str) -> WebhookDelivery:
        """Request that a delivery is sent once more; the method `wait` returns its result."""
        return await self._run(self._sync.redeliver, delivery_id)

    async def test(self) -> WebhookDelivery:
        """Request a delivery of the kind `webhook.test`; the method `wait` returns its result."""
        return await self._run(self._sync.test)

    async def wait(self, delivery_id: str, *, timeout_s: float = 30.0) -> WebhookDelivery:
        """Wait until a requested delivery has been attempted, and return it.

        After `timeout_s`, the delivery is returned even if it is still waiting.
        """
        return await self._run(self._sync.wait, delivery_id, timeout_s=timeout_s)
