"""Secrets of webhooks, and signatures of their deliveries, as specified by Standard Webhooks 1.0.

A secret is `whsec_` and 32 random bytes in Base64. The signature is the HMAC-SHA256 of the delivery's id, the time in
seconds and the body, joined by full stops.
"""

from __future__ import annotations

import base64
import hmac
import secrets
from collections.abc import Sequence

from marey_schemas.webhooks import KEY_PREFIX

ID_HEADER = "webhook-id"
TIME_HEADER = "webhook-timestamp"
SIGNATURE_HEADER = "webhook-signature"
KIND_HEADER = "marey-event"
_SIGNING_KEY_BYTES = 32


def issue_secret() -> str:
    """Return a new random secret of a webhook."""
    return KEY_PREFIX + base64.b64encode(secrets.token_bytes(_SIGNING_KEY_BYTES)).decode("ascii")


def is_secret(text: str) -> bool:
    """Return whether a text is a secret of a webhook: the prefix, and the right number of bytes in Base64."""
    try:
        key = base64.b64decode(text.removeprefix(KEY_PREFIX), validate=True)
    except ValueError:
        return False
    return text.startswith(KEY_PREFIX) and len(key) == _SIGNING_KEY_BYTES


def sign(secret: str, delivery_id: str, timestamp: int, body: bytes) -> str:
    """Return the signature of a delivery: `v1,` followed by the HMAC in Base64.

    Parameters
    ----------
    secret : text with the prefix `whsec_`
    timestamp : time of the attempt in seconds since the epoch
    """
    key = base64.b64decode(secret.removeprefix(KEY_PREFIX))
    signed = b".".join((delivery_id.encode("ascii"), str(timestamp).encode("ascii"), body))
    return "v1," + base64.b64encode(hmac.digest(key, signed, "sha256")).decode("ascii")


def signed_headers(keys: Sequence[str], delivery_id: str, kind: str, timestamp: int, body: bytes) -> dict[str, str]:
    """Return the headers of a delivery, with one signature for each of the secrets in `keys`."""
    return {
        ID_HEADER: delivery_id,
        TIME_HEADER: str(timestamp),
        SIGNATURE_HEADER: " ".join(sign(key, delivery_id, timestamp, body) for key in keys),
        KIND_HEADER: kind,
    }
