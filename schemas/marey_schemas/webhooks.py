"""Webhooks of a project, their deliveries, and the documents that they send."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Literal
from urllib.parse import urlsplit

from pydantic import AfterValidator, Field, StringConstraints

from marey_schemas.base import Answer, Request
from marey_schemas.event_kinds import DEFAULT_WEBHOOK_KINDS, PROJECT_EVENT_KINDS, ProjectEventKind
from marey_schemas.names import Message
from marey_schemas.sizes import DAY_S

MAX_URL_LENGTH = 2048
KEY_PREFIX = "whsec_"
"""Prefix of the secrets of webhooks, as the specification Standard Webhooks requires."""


def _is_web_address(url: str) -> str:
    """Return `url` if it is allowed as the address of a webhook. Raises `ValueError`."""
    if not url.isascii() or any(not "!" <= char <= "~" for char in url):
        raise ValueError("the URL must consist of printable ASCII characters; write other host names in Punycode")
    try:
        parts = urlsplit(url)
        port = parts.port
    except ValueError as error:
        raise ValueError(f"the URL is malformed: {error}") from None
    if parts.scheme not in ("http", "https") or not parts.hostname:
        raise ValueError("the URL must begin with https:// or http:// and a host, such as https://ci.example.org/marey")
    if parts.username is not None or parts.password is not None:
        raise ValueError("the URL must not contain a user name or a password; receivers check the signature instead")
    if parts.fragment or port == 0:
        raise ValueError("the URL must have neither a fragment (#...) nor the port 0")
    return url


WebhookUrl = Annotated[str, StringConstraints(min_length=1, max_length=MAX_URL_LENGTH), AfterValidator(_is_web_address)]


def _distinct(kinds: tuple[ProjectEventKind, ...]) -> tuple[ProjectEventKind, ...]:
    return tuple(kind for kind in PROJECT_EVENT_KINDS if kind in kinds)


EventKinds = Annotated[
    tuple[ProjectEventKind, ...],
    Field(min_length=1, max_length=2 * len(PROJECT_EVENT_KINDS)),
    AfterValidator(_distinct),
]


class WebhookCreate(Request):
    """Request to create a webhook, which sends events of a project to an address."""

    url: WebhookUrl = Field(description="Address to which the server sends requests.")
    kinds: EventKinds = Field(DEFAULT_WEBHOOK_KINDS, description="Kinds of events that are sent.")
    description: Message = ""


class WebhookChange(Request):
    """Request to change a webhook; absent fields stay as they are.

    If the request contains a URL, or `paused` is false, the next delivery is tried immediately.
    """

    url: WebhookUrl | None = None
    kinds: EventKinds | None = None
    description: Message | None = None
    paused: bool | None = Field(
        None,
        description="Whether the webhook is paused: nothing is sent, and events during the pause are sent when "
        "it ends.",
    )


class WebhookRotation(Request):
    """Request to replace the secret of a webhook."""

    grace_s: int = Field(
        DAY_S, ge=0, le=30 * DAY_S, description="Seconds for which deliveries are also signed with the old secret."
    )


class Webhook(Answer):
    """Webhook of a project, without its secret: address, kinds of events, and state of the deliveries."""

    id: str
    project: str
    url: str
    kinds: tuple[str, ...]
    description: str
    creator: str | None
    paused: bool
    paused_reason: str | None = Field(
        None, description="Reason why the server has paused the webhook; absent if it has not."
    )
    created_at: datetime
    updated_at: datetime
    delivered_at: datetime | None = Field(
        None, description="Time of the last successful delivery; absent: there was none."
    )
    failures: int = Field(0, description="Number of failed attempts since the last successful delivery.")
    failing_since: datetime | None = None
    next_attempt_at: datetime | None = Field(
        None,
        description="Time of the next attempt after a failure; absent: the last attempt did not fail, or the webhook "
        "is paused.",
    )
    last_status: int | None = Field(
        None, description="HTTP status of the answer to the last attempt; absent: no answer, or no attempt yet."
    )
    last_error: str | None = Field(
        None, description="Reason why the last attempt has failed; absent: it succeeded, or there was none."
    )
    missed: int = Field(
        0,
        description="Number of events that were deleted before their delivery, and of which "
        "the webhook has not been informed yet.",
    )
    dead: int = Field(0, description="Number of deliveries that failed and will not be sent again.")


class NewWebhook(Webhook):
    """Webhook with its new secret, which is shown only once."""

    secret: str = Field(description="Key of the signatures: `whsec_` and Base64.")


DeliveryState = Literal["waiting", "retrying", "delivered", "dead"]


class WebhookDelivery(Answer):
    """Delivery that a user requested, or that has failed at least once.

    A `waiting` delivery will be sent once, soon. A `retrying` delivery is sent again until it succeeds or too many
    attempts have failed; its state is then `delivered` or `dead`.
    """

    id: str
    webhook: str
    kind: str
    seq: int | None = Field(None, description="Number of the event; absent for a test.")
    state: DeliveryState
    attempts: int
    last_status: int | None = None
    last_error: str | None = None
    created_at: datetime
    updated_at: datetime


class WebhookMessage(Answer):
    """Document that a webhook sends. The event itself is read at the address in `links`, with a token."""

    id: str = Field(description="Id of the delivery, which stays the same when the delivery is repeated.")
    kind: str = Field(description="Kind of the event, `webhook.test`, or `webhook.events_missed`.")
    seq: int | None = Field(None, description="Number of the event in the feed; absent for a test.")
    project: str
    at: datetime
    subject: str = Field(description="Id of the object of the event.")
    links: dict[str, str] = Field(default_factory=dict, description="Paths of the event and its object on the server.")
    missed: int | None = Field(
        None, description="Number of missed events, in messages of the kind `webhook.events_missed`; otherwise absent."
    )

    def encoded(self) -> str:
        """Return the JSON text of the message."""
        return self.model_dump_json(exclude_none=True)
