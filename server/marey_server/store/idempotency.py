"""Idempotency keys: a repeated request gets the answer of the first request with the key (docs/reference).

Key, answer and effects are written in one transaction, so that all exist or none. A concurrent request with the same
key waits for that transaction.

The effects of the first request can be a reason to refuse the repeated request, even before its transaction begins. So
the server looks up the key of a refused request, too, before it answers.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from sqlalchemy import ColumnElement, Row, delete, select, update

from marey_schemas.encoding.canonical import canonical_json
from marey_schemas.encoding.digests import digest_of
from marey_server.access.principal import Principal
from marey_server.errors import InvalidProblem
from marey_server.store.database.clock import DAY_US
from marey_server.store.tables import idempotency_key
from marey_server.store.transaction import Transaction

LIFETIME_US = 7 * DAY_US


@dataclass(frozen=True, slots=True)
class StoredAnswer:
    """Answer to the first request with a key."""

    status: int
    headers: dict[str, str]
    body: bytes


def begin(tx: Transaction, key: str, fingerprint: str) -> StoredAnswer | None:
    """Reserve `key` for a request and return None, or return the stored answer to an earlier, equal request.

    `fingerprint` identifies the request and the scopes of the token. So a token with fewer rights cannot get the answer
    given to a token with more rights. Raises `InvalidProblem` if the key was used for another request. The caller must
    call `finish` in the same transaction.
    """
    fingerprint = _with_reach(fingerprint, tx.principal)
    mine = _mine(tx.principal, key)
    tx.execute(delete(idempotency_key).where(*mine, idempotency_key.c.created_us < tx.now_us - LIFETIME_US))
    row = {
        "principal": principal_key(tx.principal), "key": key, "fingerprint": fingerprint, "created_us": tx.now_us,
    }  # fmt: skip
    claimed = tx.insert_or_ignore(idempotency_key, row).returning(idempotency_key.c.key)
    if tx.execute(claimed).first() is not None:
        return None
    return _answer(tx.execute(select(idempotency_key).where(*mine)).one(), fingerprint)


def find(tx: Transaction, key: str, fingerprint: str) -> StoredAnswer | None:
    """Return the stored answer to an earlier, equal request with this key, or None; unlike `begin`, reserve nothing.

    Raises `InvalidProblem` if the key was used for another request.
    """
    kept = idempotency_key.c.created_us >= tx.now_us - LIFETIME_US
    stored = tx.execute(select(idempotency_key).where(*_mine(tx.principal, key), kept)).first()
    return None if stored is None else _answer(stored, _with_reach(fingerprint, tx.principal))


def _answer(stored: Row[Any], fingerprint: str) -> StoredAnswer:
    if stored.fingerprint != fingerprint:
        detail = (
            "This Idempotency-Key was used for another request, or with a token that has other scopes; use another key."
        )
        raise InvalidProblem(detail, code="idempotency-key-reused")
    return StoredAnswer(stored.status, dict(stored.headers), bytes(stored.body))


def finish(tx: Transaction, key: str, status: int, headers: Mapping[str, str], body: bytes) -> None:
    """Store the answer to the request for which `begin` has reserved the key."""
    answer = {"status": status, "headers": dict(headers), "body": body}
    tx.execute(update(idempotency_key).where(*_mine(tx.principal, key)).values(**answer))


def principal_key(principal: Principal) -> str:
    """Return a text that identifies whose idempotency keys the caller uses.

    An attempt and a user each have their own keys. All other callers of one kind share their keys.
    """
    if principal.kind == "attempt":
        return f"{principal.job_id}/{principal.fence}"
    return principal.user_id or principal.kind


def _with_reach(fingerprint: str, principal: Principal) -> str:
    reach = canonical_json([fingerprint, principal.kind, sorted(principal.scopes)])
    return digest_of(reach)


def _mine(principal: Principal, key: str) -> tuple[ColumnElement[bool], ColumnElement[bool]]:
    return idempotency_key.c.principal == principal_key(principal), idempotency_key.c.key == key
