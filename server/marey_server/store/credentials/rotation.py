"""Rotation of tokens: a token is replaced by a successor with the same rights, and ends after a grace period."""

from __future__ import annotations

from typing import Any

from sqlalchemy import Row, case, insert, select, update

from marey_schemas.access import NewToken, TokenRotation
from marey_server import faults
from marey_server.access.secret_tokens import derive_successor, hash_secret, issue_prefix, secret_matches
from marey_server.errors import ConflictProblem, ForbiddenProblem
from marey_server.store.credentials import tokens
from marey_server.store.ids import new_id
from marey_server.store.tables import token
from marey_server.store.transaction import Transaction


def rotate_token(tx: Transaction, token_id: str, request: TokenRotation) -> NewToken:
    """Replace the token of this request by a successor. The replaced token ends after `grace_s` seconds.

    If the replaced token is itself the successor of another token, that older token ends at once. The secret of the
    successor is derived from the secret of the replaced token and from `rotation_id`. So a repeated request gets the
    same successor, although no secret is stored. Raises `ForbiddenProblem` if `token_id` is not the token of this
    request. Raises `ConflictProblem` if the token was already rotated with another `rotation_id`, or if the successor
    was revoked.
    """
    principal = tx.principal
    if principal.kind != "user" or principal.token_id != token_id:
        raise ForbiddenProblem(
            "A token can only be rotated by a request that is sent with this token.", code="another-token"
        )
    old = tokens.lock_own(tx)
    if old.rotation_hash is None:
        _replace(tx, old, request)
    elif not secret_matches(request.rotation_id, old.rotation_hash):
        raise ConflictProblem(
            f"The token {token_id} was already rotated, with another rotation_id. If you did not do this, somebody "
            "else knows the token: revoke it, together with all tokens that were created with it.",
            code="token-rotated",
        )
    made = tx.execute(select(token).where(token.c.successor_of == token_id)).one_or_none()
    if made is None:
        raise ConflictProblem(
            f"The token {token_id} was rotated, and its successor was revoked. Create a new token.",
            code="successor-revoked",
        )
    issued = derive_successor(principal.token_key, request.rotation_id, made.prefix)
    return NewToken(**tokens.shown(made, principal.user_name).model_dump(), secret=issued.text)


def _replace(tx: Transaction, old: Row[Any], request: TokenRotation) -> None:
    """Store the successor of a token, and shorten the validity of the token and of the token's predecessor."""
    end_us = tx.now_us + request.grace_s * 1_000_000
    _end_by(tx, old.id, end_us, rotation_hash=hash_secret(request.rotation_id))
    if old.successor_of is not None:
        _end_by(tx, old.successor_of, tx.now_us)
    issued = derive_successor(tx.principal.token_key, request.rotation_id, issue_prefix())
    same = {name: getattr(old, name) for name in ("user_id", "name", "scopes", "labels", "session", "created_by")}
    made = {
        "id": new_id("token"), "prefix": issued.prefix, "secret_hash": issued.secret_hash, "created_us": tx.now_us,
        "expires_us": old.expires_us, "successor_of": old.id, **same,
    }  # fmt: skip
    tx.execute(insert(token), made)
    tx.execute(update(token).where(token.c.created_by == old.id).values(created_by=made["id"]))
    tx.audit("token.rotated", old.id, about=tx.principal.require_user_name(), name=old.name, successor=made["id"])
    faults.point("rotate.before_commit")
    tx.after_commit(lambda: faults.point("rotate.after_commit"))


def _end_by(tx: Transaction, token_id: str, end_us: int, **values: Any) -> None:
    """End a token at `end_us` unless it ends sooner."""
    ends = case((token.c.expires_us < end_us, token.c.expires_us), else_=end_us)
    tx.execute(update(token).where(token.c.id == token_id).values(expires_us=ends, **values))
