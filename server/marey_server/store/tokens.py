"""Bearer tokens: creation, revocation, and the principal that each belongs to."""

from __future__ import annotations

from typing import Any

from sqlalchemy import Row, bindparam, delete, insert, or_, select, update

from marey_schemas.access import NewToken, Token, TokenCreate
from marey_schemas.items import Page
from marey_schemas.jobs import JobState
from marey_server.access import scopes
from marey_server.access.principal import Principal
from marey_server.access.secret_tokens import (
    attempt_secret,
    hash_secret,
    issue_user_token,
    secret_matches,
    split_user_token,
)
from marey_server.errors import ForbiddenProblem, NotFoundProblem, UnauthenticatedProblem
from marey_server.store import listing
from marey_server.store.database.clock import datetime_of
from marey_server.store.database.prepared import Prepared
from marey_server.store.ids import new_id
from marey_server.store.jobs.fencing import lease_lost
from marey_server.store.tables import attempt, job, token, user
from marey_server.store.transaction import Transaction

NOTE_USE_EVERY_S = 3600
"""Precision of `last_used_at`; an update on every request would make every read a write."""

_ATTEMPT_SCOPES = ("read",)

# Every request runs one of these.
_USER_TOKEN = Prepared(
    select(token.c.id, token.c.secret_hash, token.c.scopes, token.c.expires_us)
    .add_columns(user.c.id.label("user_id"), user.c.name, user.c.administrator, user.c.disabled)
    .join(user, user.c.id == token.c.user_id)
    .where(token.c.prefix == bindparam("prefix"))
)
_ATTEMPT_TOKEN = Prepared(
    select(job.c.id, job.c.project_id, job.c.author_id, job.c.state, attempt.c.fence, user.c.name)
    .add_columns(job.c.fence.label("current_fence"))
    .select_from(attempt.join(job, job.c.id == attempt.c.job_id).outerjoin(user, user.c.id == job.c.author_id))
    .where(attempt.c.token_hash == bindparam("hash"))
)


def resolve_token(tx: Transaction, text: str) -> Principal:
    """Return the principal of a bearer token. Raises `UnauthenticatedProblem` if the token is not valid."""
    if (secret := attempt_secret(text)) is not None:
        return _resolve_attempt(tx, secret)
    if (parts := split_user_token(text)) is not None:
        return _resolve_user(tx, *parts)
    raise _unknown()


def _unknown() -> UnauthenticatedProblem:
    return UnauthenticatedProblem("The token is unknown, expired or revoked.", code="bad-token")


def _resolve_user(tx: Transaction, prefix: str, secret: str) -> Principal:
    row = tx.first(_USER_TOKEN, {"prefix": prefix})
    if row is None or not secret_matches(secret, row.secret_hash) or row.disabled:
        raise _unknown()
    if row.expires_us is not None and row.expires_us <= tx.now_us:
        raise _unknown()
    return Principal("user", row.user_id, row.name, row.administrator, tuple(row.scopes), row.id, row.expires_us)


def _resolve_attempt(tx: Transaction, secret: str) -> Principal:
    """Return the principal of an attempt's token. Raises `LeaseLostProblem` if a later attempt has the job.

    The token is valid while its fence is the job's. After the end of the job, it only allows a repeated `complete` or
    `fail`, which gets the stored answer; reads are refused.
    """
    row = tx.first(_ATTEMPT_TOKEN, {"hash": hash_secret(secret)})
    if row is None:
        raise _unknown()
    if row.fence != row.current_fence:
        raise lease_lost(row.id, row.fence)
    running = row.state == JobState.RUNNING
    return Principal(
        "attempt",
        row.author_id,
        row.name,
        scopes=_ATTEMPT_SCOPES if running else (),
        job_id=row.id,
        fence=row.fence,
        project_id=row.project_id if running else None,
    )


# -- a user's tokens --------------------------------------------------------------------------------------------------


def create_token(tx: Transaction, request: TokenCreate) -> NewToken:
    """Create a token of the caller; its secret is shown once.

    Raises `ForbiddenProblem` if it would have a scope that the current credential lacks, or outlive it.
    """
    user_id = _require_user(tx.principal, "write")
    if beyond := scopes.exceeding(request.scopes, tx.principal.scopes):
        raise ForbiddenProblem(f"Your own credential lacks the scope {beyond[0]!r}.", code="insufficient-scope")
    issued = issue_user_token()
    row = {
        "id": new_id("token"), "user_id": user_id, "name": request.name, "prefix": issued.prefix,
        "secret_hash": issued.secret_hash, "scopes": list(request.scopes), "created_us": tx.now_us,
        "expires_us": _end_of(tx, request),
    }  # fmt: skip
    made = tx.execute(insert(token).values(**row).returning(*token.c)).one()
    tx.emit("token.created", made.id, name=made.name, scopes=list(request.scopes))
    return NewToken(**_shown(made).model_dump(), secret=issued.text)


def _end_of(tx: Transaction, request: TokenCreate) -> int | None:
    """Return when a token ends; a caller who asks for no time gets at most that of the current credential."""
    own_us, lifetime_s = tx.principal.expires_us, request.expires_in_s
    wanted_us = None if lifetime_s is None else tx.now_us + lifetime_s * 1_000_000
    if own_us is None or (wanted_us is not None and wanted_us <= own_us):
        return wanted_us
    if "expires_in_s" in request.model_fields_set:
        left_s = (own_us - tx.now_us) // 1_000_000
        raise ForbiddenProblem(
            f"Your own credential ends in {left_s} s, and a token cannot outlive the one that creates it; "
            "ask for less, or sign in for a longer time.",
            code="outlives-credential",
            context={"left_s": left_s},
        )
    return own_us


def list_tokens(tx: Transaction, *, cursor: str | None = None, limit: int = listing.DEFAULT_LIMIT) -> Page:
    """Return the caller's tokens, newest first, without their secrets."""
    user_id = _require_user(tx.principal, "read")
    order = listing.parse_order("-id", {"id": token.c.id})
    statement = select(token).where(token.c.user_id == user_id)
    rows, next_cursor = listing.read_page(tx, statement, order, ["tokens", user_id], cursor, limit)
    return Page(items=tuple(_shown(row) for row in rows), next_cursor=next_cursor)


def revoke_token(tx: Transaction, token_id: str) -> None:
    """Revoke a token of the caller; administrators may revoke any token. Raises `NotFoundProblem`.

    A token may always revoke itself.
    """
    principal = tx.principal
    if principal.kind != "user" or token_id != principal.token_id:
        _require_user(principal, "write")
    statement = delete(token).where(token.c.id == token_id)
    if not (principal.administrator and scopes.allows(principal.scopes, "admin")):
        statement = statement.where(token.c.user_id == principal.user_id)
    if tx.execute(statement).rowcount == 0:
        raise NotFoundProblem(f"You have no token {token_id!r}.", code="no-token")
    tx.emit("token.revoked", token_id)


def revoke_named(tx: Transaction, name: str) -> None:
    """Revoke the caller's tokens that have this name."""
    user_id = _require_user(tx.principal, "write")
    ended = tx.execute(delete(token).where(token.c.user_id == user_id, token.c.name == name).returning(token.c.id))
    for token_id in ended.scalars().all():
        tx.emit("token.revoked", token_id)


def note_use(tx: Transaction, token_id: str) -> None:
    """Update the time of a token's last use, at most once an hour."""
    before = tx.now_us - NOTE_USE_EVERY_S * 1_000_000
    stale = or_(token.c.last_used_us.is_(None), token.c.last_used_us < before)
    tx.execute(update(token).where(token.c.id == token_id, stale).values(last_used_us=tx.now_us))


def _require_user(principal: Principal, scope: str) -> str:
    if principal.kind == "anonymous":
        raise UnauthenticatedProblem("Sign in to see your tokens.")
    if principal.kind != "user" or principal.user_id is None:
        raise ForbiddenProblem("Only users have tokens.", code="users-only")
    if not scopes.allows(principal.scopes, scope):
        raise ForbiddenProblem(f"This token lacks the scope {scope!r}.", code="insufficient-scope")
    return principal.user_id


def _shown(row: Row[Any]) -> Token:
    return Token(
        id=row.id, name=row.name, prefix=row.prefix, scopes=tuple(row.scopes), created_at=datetime_of(row.created_us),
        expires_at=None if row.expires_us is None else datetime_of(row.expires_us),
        last_used_at=None if row.last_used_us is None else datetime_of(row.last_used_us),
    )  # fmt: skip
