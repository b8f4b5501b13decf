"""Resources of a project's webhooks and their deliveries."""

from __future__ import annotations

from pydantic import Field

from marey_schemas.webhooks import (
    DeliveryState,
    NewWebhook,
    Webhook,
    WebhookChange,
    WebhookCreate,
    WebhookDelivery,
    WebhookRotation,
)
from marey_server.http.caching import WITH_SECRET
from marey_server.http.declarations import Access, reads, writes
from marey_server.http.queries import PageQuery
from marey_server.http.reply import Rendered, Reply
from marey_server.http.resource import Resource
from marey_server.store.webhooks import deliveries, managing


class DeliveriesQuery(PageQuery):
    """Query parameters of a list of deliveries."""

    state: DeliveryState | None = Field(None, description="State of the deliveries; absent: any.")


class ProjectWebhooks(Resource):
    """Webhooks of a project."""

    path = "/projects/{project}/webhooks"
    tag = "Webhooks"

    @reads(access=Access.OWNER, query=PageQuery, answer=Webhook, paged=True, public=False)
    async def get(self, project: str, query: PageQuery) -> Rendered:
        """List the webhooks of a project, without their secrets."""
        return await self.answer(managing.list_webhooks, project, cursor=query.cursor, limit=query.limit)

    @writes(access=Access.OWNER, body=WebhookCreate, answer=NewWebhook, status=201)
    async def post(self, project: str, body: WebhookCreate) -> Rendered:
        """Create a webhook; its secret is shown only once."""
        return await self.answer_with(
            lambda made: Reply(made, location=f"/projects/{project}/webhooks/{made.id}", headers=WITH_SECRET),
            managing.create_webhook,
            project,
            body,
            self.services.settings.webhook_networks,
        )


class WebhookResource(Resource):
    """A webhook."""

    path = "/projects/{project}/webhooks/{webhook}"
    tag = "Webhooks"

    @reads(access=Access.OWNER, answer=Webhook, public=False)
    async def get(self, project: str, webhook: str) -> Rendered:
        """Return a webhook and the result of its last attempt, without its secret."""
        return await self.answer(managing.read_webhook, project, webhook)

    @writes(access=Access.OWNER, body=WebhookChange, answer=Webhook)
    async def patch(self, project: str, webhook: str, body: WebhookChange) -> Rendered:
        """Change, pause or resume a webhook."""
        networks = self.services.settings.webhook_networks
        return await self.answer(managing.change_webhook, project, webhook, body, networks)

    @writes(access=Access.OWNER)
    async def delete(self, project: str, webhook: str) -> Rendered:
        """Delete a webhook and its deliveries."""
        return await self.answer(managing.delete_webhook, project, webhook)


class WebhookSecret(Resource):
    """Rotation of the secret of a webhook."""

    path = "/projects/{project}/webhooks/{webhook}/rotate"
    tag = "Webhooks"

    @writes(access=Access.OWNER, body=WebhookRotation, answer=NewWebhook)
    async def post(self, project: str, webhook: str, body: WebhookRotation) -> Rendered:
        """Replace the secret of a webhook; the new secret is shown only once.

        For `grace_s` seconds, deliveries are signed with both secrets.
        """
        return await self.answer_with(
            lambda made: Reply(made, headers=WITH_SECRET), managing.rotate_secret, project, webhook, body
        )


class WebhookTest(Resource):
    """Test of a webhook."""

    path = "/projects/{project}/webhooks/{webhook}/test"
    tag = "Webhooks"

    @writes(access=Access.OWNER, answer=WebhookDelivery, status=202)
    async def post(self, project: str, webhook: str) -> Rendered:
        """Request a delivery of the kind `webhook.test`, which is sent once."""
        return await self.answer_with(
            lambda made: Reply(made, location=f"/projects/{project}/webhooks/{webhook}/deliveries/{made.id}"),
            deliveries.request_test,
            project,
            webhook,
        )


class WebhookDeliveries(Resource):
    """Failed or requested deliveries of a webhook."""

    path = "/projects/{project}/webhooks/{webhook}/deliveries"
    tag = "Webhooks"

    @reads(access=Access.OWNER, query=DeliveriesQuery, answer=WebhookDelivery, paged=True, public=False)
    async def get(self, project: str, webhook: str, query: DeliveriesQuery) -> Rendered:
        """List the deliveries that failed or were requested, newest first."""
        return await self.answer(
            deliveries.list_deliveries, project, webhook, state=query.state, cursor=query.cursor, limit=query.limit
        )


class WebhookDeliveryResource(Resource):
    """A failed or requested delivery of a webhook."""

    path = "/projects/{project}/webhooks/{webhook}/deliveries/{delivery}"
    tag = "Webhooks"

    @reads(access=Access.OWNER, answer=WebhookDelivery, public=False)
    async def get(self, project: str, webhook: str, delivery: str) -> Rendered:
        """Return a delivery with the result of its last attempt."""
        return await self.answer(deliveries.read_delivery, project, webhook, delivery)


class WebhookRedelivery(Resource):
    """Repetition of a delivery."""

    path = "/projects/{project}/webhooks/{webhook}/deliveries/{delivery}/redeliver"
    tag = "Webhooks"

    @writes(access=Access.OWNER, answer=WebhookDelivery, status=202)
    async def post(self, project: str, webhook: str, delivery: str) -> Rendered:
        """Send a delivery again after it has succeeded, or after the server has stopped retrying it."""
        return await self.answer(deliveries.redeliver, project, webhook, delivery)


RESOURCES: tuple[type[Resource], ...] = (
    ProjectWebhooks,
    WebhookResource,
    WebhookSecret,
    WebhookTest,
    WebhookDeliveries,
    WebhookDeliveryResource,
    WebhookRedelivery,
)
