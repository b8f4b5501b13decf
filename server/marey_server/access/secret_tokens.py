"""Bearer tokens as text: functions that create them, split them, and hash their secrets.

`marey_<prefix>_<secret>` belongs to a user; the prefix identifies the token's row in the database.
`mareyjob_<secret>_<seal>` belongs to an attempt of a job; the seal shows that a server issued it (see `is_sealed`).
`mareyinvite_<prefix>_<secret>` is the code of an invitation, `mareyview_<prefix>_<secret>` that of a link to a project,
`mareystudy_<prefix>_<secret>` that of a link to a study, and `mareyparticipant_<prefix>_<secret>` belongs to a
participant of a study. The database stores the SHA-256 of the secret. A secret has 256 random bits, so a slow hash is
not needed.
"""

from __future__ import annotations

import hashlib
import hmac
import secrets
from typing import NamedTuple

from marey_schemas.invitations import CODE_PREFIX
from marey_schemas.sign_ins import VIEW_PREFIX
from marey_schemas.studies.participation import LINK_PREFIX, PARTICIPANT_PREFIX

_USER = "marey_"
_ATTEMPT = "mareyjob_"
_SEAL_DIGITS = 32


class IssuedToken(NamedTuple):
    """New token or code: its text, which is shown once, and the parts that the database stores."""

    text: str
    prefix: str
    secret_hash: str


def issue_user_token() -> IssuedToken:
    """Return a new token of a user, with a random secret."""
    return _user_token(issue_prefix(), secrets.token_hex(32))


def issue_prefix() -> str:
    """Return a random prefix for a new token or the code of a new invitation or link."""
    return secrets.token_hex(6)


def issue_attempt_token() -> IssuedToken:
    """Return a new token of an attempt; the hash of its secret identifies the attempt in the database."""
    return _attempt_token(secrets.token_hex(32))


def issue_invitation() -> IssuedToken:
    """Return the code of a new invitation, with a random secret."""
    return _issue(CODE_PREFIX)


def issue_study_link() -> IssuedToken:
    """Return the code of a new link for one participant of a study, with a random secret."""
    return _issue(LINK_PREFIX)


def derive_participant_token(link_secret: str, key: str, prefix: str) -> IssuedToken:
    """Derive the token of a participant of a study; the same arguments always give the same token.

    `link_secret` is the secret of the link's code, and `key` was made by the participant's browser. So a repeated
    exchange of the link by the same browser returns the same token, and the link alone is not enough to get the token.
    """
    secret = hmac.digest(link_secret.encode("utf-8", "surrogatepass"), f"participant {key}".encode(), "sha256").hex()
    return IssuedToken(f"{PARTICIPANT_PREFIX}{prefix}_{secret}", prefix, hash_secret(secret))


def _issue(start: str) -> IssuedToken:
    prefix, secret = issue_prefix(), secrets.token_hex(32)
    return IssuedToken(f"{start}{prefix}_{secret}", prefix, hash_secret(secret))


def derive_token_key(secret: str) -> bytes:
    """Derive, from the secret of a user's token, the key for `derive_attempt_token` and `derive_successor`."""
    return hmac.digest(secret.encode("utf-8", "surrogatepass"), b"marey attempt tokens", "sha256")


def derive_attempt_token(token_key: bytes, claim_id: str, job_id: str, fence: int) -> IssuedToken:
    """Derive the token of an attempt; the same arguments always give the same token.

    So a worker that repeats a claim with the same user token gets the same attempt token again. `fence` counts the
    claims of the job.
    """
    return _attempt_token(hmac.digest(token_key, f"{claim_id} {job_id} {fence}".encode(), "sha256").hex())


def derive_successor(token_key: bytes, rotation_id: str, prefix: str) -> IssuedToken:
    """Derive the token that replaces a user's token; the same arguments always give the same token.

    So a rotation that is repeated with the same `rotation_id` returns the same token again. `prefix` is the prefix of
    the new token.
    """
    # A rotation_id contains no space, so this message is different from that of every attempt.
    return _user_token(prefix, hmac.digest(token_key, f"rotation {rotation_id}".encode(), "sha256").hex())


def derive_from_cookie(cookie: str, purpose: str, state: str) -> str:
    """Derive the nonce or the verifier that the server sends to an identity provider: 64 hexadecimal digits.

    So the database need not store them, and only the browser with the cookie can continue a sign-in.
    """
    return hmac.digest(cookie.encode("utf-8", "surrogatepass"), f"{purpose} {state}".encode(), "sha256").hex()


def _user_token(prefix: str, secret: str) -> IssuedToken:
    return IssuedToken(f"{_USER}{prefix}_{secret}", prefix, hash_secret(secret))


def _attempt_token(secret: str) -> IssuedToken:
    return IssuedToken(f"{_ATTEMPT}{secret}", "", hash_secret(secret))


def sealed(token: IssuedToken, seal_key: bytes) -> str:
    """Return the text of an attempt's token with a seal, by which `is_sealed` recognizes tokens of this server.

    The seal is not part of the secret, and not needed for access: the token without its seal is valid, too.
    """
    return f"{token.text}_{_seal(token.text.removeprefix(_ATTEMPT), seal_key)}"


def is_sealed(text: str, seal_key: bytes) -> bool:
    """Return whether a server with this key issued the text as a token of an attempt.

    No database is needed for this. The attempt may have ended long ago.
    """
    secret, _, seal = text.removeprefix(_ATTEMPT).partition("_")
    if not text.startswith(_ATTEMPT) or not seal.isascii():
        return False
    return hmac.compare_digest(seal, _seal(secret, seal_key))


def _seal(secret: str, seal_key: bytes) -> str:
    return hmac.digest(seal_key, secret.encode("utf-8", "surrogatepass"), "sha256").hex()[:_SEAL_DIGITS]


def hash_secret(secret: str) -> str:
    """Return the stored hash of a secret: 64 hexadecimal digits."""
    return hashlib.sha256(secret.encode("utf-8", "surrogatepass")).hexdigest()


def secret_matches(secret: str, secret_hash: str) -> bool:
    """Return whether `secret` has the given hash, compared in constant time."""
    return hmac.compare_digest(hash_secret(secret), secret_hash)


def split_user_token(text: str) -> tuple[str, str] | None:
    """Split the token of a user into its prefix and its secret; return None for any other text."""
    return _split(text, _USER)


def split_invitation(text: str) -> tuple[str, str] | None:
    """Split the code of an invitation into its prefix and its secret; return None for any other text."""
    return _split(text, CODE_PREFIX)


def split_study_link(text: str) -> tuple[str, str] | None:
    """Split the code of a study link into its prefix and its secret; return None for any other text."""
    return _split(text, LINK_PREFIX)


def split_participant_token(text: str) -> tuple[str, str] | None:
    """Split the token of a study's participant into its prefix and its secret; return None for any other text."""
    return _split(text, PARTICIPANT_PREFIX)


def split_view_code(text: str) -> tuple[str, str] | None:
    """Split the code of a link to a project into its prefix and its secret; return None for any other text."""
    return _split(text, VIEW_PREFIX)


def _split(text: str, start: str) -> tuple[str, str] | None:
    if not text.startswith(start):
        return None
    prefix, _, secret = text[len(start) :].partition("_")
    return (prefix, secret) if prefix.isalnum() and prefix.isascii() and secret else None


def attempt_secret(text: str) -> str | None:
    """Return the secret in the token of an attempt, with or without a seal; return None for any other text."""
    return text[len(_ATTEMPT) :].partition("_")[0] or None if text.startswith(_ATTEMPT) else None


def token_hash(text: str) -> str:
    """Return a hash that identifies a bearer token; the seal of an attempt's token is left out of the hash."""
    return hash_secret(attempt_secret(text) or text)
