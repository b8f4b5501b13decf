"""Links with which a person opens a project in a browser, and the sessions that they begin.

A link and its session are one row in the table of tokens. The row of a link has the hash of a code; the code is no
token, so it can only be exchanged. The exchange gives the row a new secret, which is the token of the session, so a
code works once. The session has only the scope `read` in one project, ends no later than the token that made the link,
and is revoked with it.
"""

from __future__ import annotations

import secrets
from typing import NamedTuple

from sqlalchemy import and_, delete, func, insert, select, update

from marey_schemas.sign_ins import VIEW_PREFIX, BrowserLink, BrowserSession
from marey_server.access.principal import Principal
from marey_server.access.scopes import projects_of
from marey_server.access.secret_tokens import hash_secret, issue_prefix, issue_user_token, split_view_code
from marey_server.errors import NotFoundProblem, QuotaExceededProblem, UnauthenticatedProblem
from marey_server.store import projects, users
from marey_server.store.credentials import sign_ins, tokens
from marey_server.store.credentials.sign_ins import SignInTry
from marey_server.store.database.clock import datetime_of
from marey_server.store.ids import new_id
from marey_server.store.tables import token
from marey_server.store.transaction import Transaction

LINK_US = 120 * 1_000_000
"""Time for which a link can be used."""
SESSION_US = 12 * 3600 * 1_000_000
"""Longest time of a session."""
MOST_OF_USER = 100
"""Greatest number of valid links and sessions of one user."""
_NAME = "browser"


class IssuedSession(NamedTuple):
    """New session of a browser, with the text of its token."""

    session: BrowserSession
    secret: str


def create_link(tx: Transaction, project: str) -> BrowserLink:
    """Create a link to a project that the caller may read.

    Raises `NotFoundProblem` if the caller may not see the project, and `QuotaExceededProblem` if the caller has
    `MOST_OF_USER` links and sessions already.
    """
    projects.require(tx, project)
    own = tokens.lock_own(tx)
    mine = and_(token.c.user_id == own.user_id, token.c.name == _NAME, token.c.session.is_(True))
    tx.execute(delete(token).where(mine, token.c.expires_us <= tx.now_us))
    if tx.execute(select(func.count()).select_from(token).where(mine)).scalar_one() >= MOST_OF_USER:
        raise QuotaExceededProblem(
            f"You have {MOST_OF_USER} links and sessions of browsers. Wait until some expire, or revoke some: see "
            "`marey token ls`.",
            code="quota-exceeded",
        )
    prefix, secret = issue_prefix(), secrets.token_hex(32)
    expires_us = min(tx.now_us + LINK_US, own.expires_us or tx.now_us + LINK_US)
    row = {
        "id": new_id("token"), "user_id": own.user_id, "name": _NAME, "prefix": prefix, "secret_hash": _hash(secret),
        "scopes": [f"read!project={project}"], "created_us": tx.now_us, "expires_us": expires_us, "session": True,
        "created_by": own.id,
    }  # fmt: skip
    tx.execute(insert(token).values(**row))
    about = tx.principal.require_user_name()
    tx.audit("token.created", str(row["id"]), about=about, name=_NAME, scopes=row["scopes"], session=True)
    return BrowserLink(code=f"{VIEW_PREFIX}{prefix}_{secret}", expires_at=datetime_of(expires_us))


def try_of(code: str, address: str, per_minute: int) -> SignInTry:
    """Return the sign-in try for the code of a link; the caller must count the try before checking the code."""
    prefix, _ = split_view_code(code) or ("", "")
    return SignInTry(f"view {prefix}", address, per_minute)


def redeem_link(tx: Transaction, code: str, attempt: SignInTry) -> IssuedSession:
    """Begin the session of a link; the link cannot be used again.

    `attempt` is the counted try, which no longer counts afterwards. Raises `NotFoundProblem` if the code is wrong,
    expired or used, and `ForbiddenProblem` if the user is disabled.
    """
    prefix, secret = split_view_code(code) or ("", "")
    which = token.c.prefix == prefix, token.c.secret_hash == _hash(secret), token.c.expires_us > tx.now_us
    maker = token.alias("maker")
    made_by = select(token, maker.c.expires_us.label("until_us")).join(maker, maker.c.id == token.c.created_by)
    row = tx.execute(made_by.where(*which)).first()
    if row is None:
        raise _invalid_link()
    issued = issue_user_token()
    expires_us = min(tx.now_us + SESSION_US, row.until_us or tx.now_us + SESSION_US)
    begun = update(token).where(*which).values(
        prefix=issued.prefix, secret_hash=issued.secret_hash, expires_us=expires_us, last_used_us=tx.now_us
    )  # fmt: skip
    if tx.execute(begun).rowcount != 1:
        raise _invalid_link()
    tx.principal = users.active_principal(tx, row.user_id)
    sign_ins.uncount(tx, attempt)
    (project,) = projects_of(row.scopes, "read")
    return IssuedSession(BrowserSession(project=project, expires_at=datetime_of(expires_us)), issued.text)


def is_session(tx: Transaction, secret: str) -> bool:
    """Return whether `secret` is a valid token of a user, such as the token of a session."""
    return _session_of(tx, secret) is not None


def end_session(tx: Transaction, secret: str) -> None:
    """Revoke the token of a session, or another token of a user; a token that is not valid changes nothing."""
    found = _session_of(tx, secret)
    if found is not None and found.token_id is not None:
        tx.principal = found
        tokens.revoke_token(tx, found.token_id)


def _session_of(tx: Transaction, secret: str) -> Principal | None:
    """Return the principal of the token `secret`; None if the token is not valid or does not belong to a user."""
    try:
        found = tokens.resolve_token(tx, secret)
    except UnauthenticatedProblem:
        return None
    return found if found.kind == "user" else None


def _hash(secret: str) -> str:
    """Return the hash that is stored for the secret of a link's code.

    A token with the same secret would have another hash, so a code is never accepted as a token.
    """
    return hash_secret(f"{VIEW_PREFIX}{secret}")


def _invalid_link() -> NotFoundProblem:
    return NotFoundProblem(
        "This link is not valid: it is unknown, too old, or was used already. Run the command again.",
        code="link-invalid",
    )
