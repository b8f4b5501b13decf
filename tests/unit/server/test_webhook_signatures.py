"""Signatures of webhooks, compared with the published example and with a computation from its definition."""

import base64
import hashlib

from hypothesis import given
from hypothesis import strategies as st

from marey_schemas.webhooks import KEY_PREFIX
from marey_server.access.webhook_signatures import issue_secret, sign, signed_headers

BLOCK_BYTES = 64


def hmac_sha256(key: bytes, message: bytes) -> bytes:
    """Return the HMAC after RFC 2104, section 2."""
    key = (hashlib.sha256(key).digest() if len(key) > BLOCK_BYTES else key).ljust(BLOCK_BYTES, b"\0")
    inner = hashlib.sha256(bytes(byte ^ 0x36 for byte in key) + message).digest()
    return hashlib.sha256(bytes(byte ^ 0x5C for byte in key) + inner).digest()


def test_the_signature_is_that_of_the_published_example() -> None:
    """The example is in the documentation of the libraries for Standard Webhooks."""
    secret, delivery = "whsec_MfKQ9r8GKYqrTwjUPD8ILPZIo2LaLaSw", "msg_p5jXN8AQM9LWM0D4loKWxJek"
    expected = "v1,g0hM9SsE+OTPJTGt/tmIKtSyZlE3uFJELVlNIOLJ1OE="
    assert sign(secret, delivery, 1614265330, b'{"test": 2432232314}') == expected


@given(st.binary(min_size=24, max_size=64), st.from_regex(r"[a-z_0-9-]{1,80}", fullmatch=True), st.binary())
def test_a_signature_is_the_hmac_of_id_time_and_body(key: bytes, delivery: str, body: bytes) -> None:
    secret = KEY_PREFIX + base64.b64encode(key).decode()
    expected = hmac_sha256(key, f"{delivery}.1700000000.".encode() + body)
    assert sign(secret, delivery, 1_700_000_000, body) == "v1," + base64.b64encode(expected).decode()


def test_secrets_are_random_and_long_and_both_sign_during_a_rotation() -> None:
    old, new = issue_secret(), issue_secret()
    assert old != new
    assert len(base64.b64decode(old.removeprefix(KEY_PREFIX))) == 32
    headers = signed_headers((new, old), "d", "job.failed", 7, b"{}")
    assert headers["webhook-signature"].split() == [sign(new, "d", 7, b"{}"), sign(old, "d", 7, b"{}")]
    assert (headers["webhook-id"], headers["webhook-timestamp"], headers["marey-event"]) == ("d", "7", "job.failed")
