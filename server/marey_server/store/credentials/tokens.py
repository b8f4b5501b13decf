"""Bearer tokens: creation, revocation, and the principal to whom a token belongs."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

from sqlalchemy import ColumnElement, Row, Select, and_, bindparam, delete, insert, or_, select, update

from marey_schemas.access import EndTokens, NewToken, Token, TokenCreate
from marey_schemas.items import Page
from marey_schemas.problems import FieldError
from marey_schemas.wording import counted
from marey_server.access import scopes
from marey_server.access.labels import first_outside, labels_key
from marey_server.access.principal import Principal
from marey_server.access.roles import is_administrator, require_administrator
from marey_server.access.secret_tokens import (
    attempt_secret,
    derive_token_key,
    hash_secret,
    issue_user_token,
    secret_matches,
    split_user_token,
)
from marey_server.errors import (
    ForbiddenProblem,
    InvalidProblem,
    NotFoundProblem,
    UnauthenticatedProblem,
)
from marey_server.store import listing, projects
from marey_server.store.database.clock import DAY_US, datetime_of
from marey_server.store.database.prepared import Prepared
from marey_server.store.ids import new_id
from marey_server.store.jobs.claiming.rights import resolve_pod_token
from marey_server.store.jobs.fencing import AUTHOR_MAY_RUN, RUNNING, author_lost, lease_lost
from marey_server.store.quotas.counting import require_room
from marey_server.store.studies.participants import resolve_participant
from marey_server.store.tables import attempt, job, token, user
from marey_server.store.transaction import Transaction

NOTE_USE_EVERY_S = 3600
"""Precision of `last_used_at` in seconds; if every request updated the time, every read would become a write."""

KEPT_AFTER_END_US = 30 * DAY_US
"""Time for which an expired token is listed, so that its owner can see why a program stopped."""

REPLAY_GRACE_US = 900 * 1_000_000
"""Time after the end of an attempt in which its last request may be repeated; workers repeat it for 600 s."""

_ATTEMPT_SCOPES = ("read",)

# Every request runs one of these.
_USER_TOKEN = Prepared(
    select(token.c.id, token.c.secret_hash, token.c.scopes, token.c.expires_us)
    .add_columns(token.c.labels, user.c.id.label("user_id"), user.c.name, user.c.administrator, user.c.disabled)
    .join(user, user.c.id == token.c.user_id)
    .where(token.c.prefix == bindparam("prefix"))
)
_ATTEMPT_TOKEN = Prepared(
    select(job.c.id, job.c.project_id, attempt.c.fence, attempt.c.ended_us, attempt.c.write_id)
    .add_columns(
        and_(job.c.state == RUNNING, job.c.fence == attempt.c.fence, attempt.c.ended_us.is_(None)).label("holds"),
        AUTHOR_MAY_RUN.label("author_may_run"),
    )
    .select_from(attempt.join(job, job.c.id == attempt.c.job_id))
    .where(attempt.c.token_hash == bindparam("hash"))
)


class TokenFilter(NamedTuple):
    """Filter of a list of tokens: by user (by default the caller), by prefix, and by time of expiry.

    `everybody` selects the tokens of all users, `ends_within_s` the tokens that expire within this number of seconds.
    """

    user: str | None = None
    everybody: bool = False
    prefix: str | None = None
    ends_within_s: int | None = None


OWN_TOKENS = TokenFilter()


def resolve_token(tx: Transaction, text: str) -> Principal:
    """Return the principal of a bearer token. Raises `UnauthenticatedProblem` if the token is not valid."""
    if (secret := attempt_secret(text)) is not None:
        return _resolve_attempt(tx, secret)
    if (parts := split_user_token(text)) is not None:
        return _resolve_user(tx, *parts)
    if (other := resolve_pod_token(tx, text) or resolve_participant(tx, text)) is not None:
        return other
    raise unknown_token()


def unknown_token() -> UnauthenticatedProblem:
    """Return the error for a token that is not valid; the error does not show the reason."""
    return UnauthenticatedProblem("The token is unknown, expired or revoked.", code="bad-token")


def _resolve_user(tx: Transaction, prefix: str, secret: str) -> Principal:
    row = tx.first(_USER_TOKEN, {"prefix": prefix})
    if row is None or not secret_matches(secret, row.secret_hash) or row.disabled:
        raise unknown_token()
    if row.expires_us is not None and row.expires_us <= tx.now_us:
        raise unknown_token()
    return Principal(
        "user",
        row.user_id,
        row.name,
        row.administrator,
        tuple(row.scopes),
        row.id,
        row.expires_us,
        token_key=derive_token_key(secret),
        labels=row.labels,
    )


def _resolve_attempt(tx: Transaction, secret: str) -> Principal:
    """Return the principal of an attempt's token.

    Raises `LeaseLostProblem` if the attempt has lost the job, or if the author of the job has lost the right to run it,
    and `UnauthenticatedProblem` if the token is unknown or no longer valid. The token is valid while the attempt holds
    its job. For `REPLAY_GRACE_US` after the end of the attempt, the token only allows a repeated `complete` or `fail`,
    which gets the stored answer.
    """
    row = tx.first(_ATTEMPT_TOKEN, {"hash": hash_secret(secret)})
    if row is None:
        raise unknown_token()
    if row.holds and not row.author_may_run:
        raise author_lost(row.id, row.fence)
    if row.holds:
        return Principal("attempt", scopes=_ATTEMPT_SCOPES, job_id=row.id, fence=row.fence, project_id=row.project_id)
    if row.write_id is None:  # it sent no last request that could be repeated
        raise lease_lost(row.id, row.fence)
    if row.ended_us + REPLAY_GRACE_US <= tx.now_us:
        raise unknown_token()
    return Principal("attempt", job_id=row.id, fence=row.fence, ended=True)


# -- a user's tokens --------------------------------------------------------------------------------------------------


def create_token(tx: Transaction, request: TokenCreate) -> NewToken:
    """Create a token of the caller; its secret is shown once.

    The new token may not have more rights than the caller's own token: no other scopes, no other labels of workers,
    and no later expiry. Otherwise, raises `ForbiddenProblem`. Raises `InvalidProblem` for labels without the scope
    `work`, `NotFoundProblem` for a scope of a project that the caller cannot see, and `QuotaExceededProblem` if the
    caller has too many tokens.
    """
    user_id = _require_user(tx.principal, "write")
    if beyond := scopes.exceeding(request.scopes, tx.principal.scopes):
        raise ForbiddenProblem(
            f"Your token does not have the scope {beyond[0]!r}, so it cannot create a token that has it.",
            code="insufficient-scope",
        )
    labels, ends_us = _labels_of(tx, request), _end_of(tx, request)
    if tx.principal.token_id is not None:  # the server itself may always make one, for its workers or after a loss
        projects.require_known(tx, sorted({scope.partition("!project=")[2] for scope in request.scopes} - {""}))
        lock_own(tx)
        require_room(tx, "user_tokens")
    return _insert(tx, user_id, request, ends_us, labels=labels)


def create_session(tx: Transaction, expires_in_s: int) -> NewToken:
    """Create the token of a sign-in for the transaction's principal, whom a password or a provider has identified."""
    request = TokenCreate(name="sign-in", scopes=tx.principal.scopes, expires_in_s=expires_in_s)
    return _insert(tx, tx.principal.user_id, request, tx.now_us + expires_in_s * 1_000_000, session=True)


def _insert(
    tx: Transaction,
    user_id: str | None,
    request: TokenCreate,
    expires_us: int | None,
    *,
    session: bool = False,
    labels: Mapping[str, str] | None = None,
) -> NewToken:
    issued = issue_user_token()
    row = {
        "id": new_id("token"), "user_id": user_id, "name": request.name, "prefix": issued.prefix,
        "secret_hash": issued.secret_hash, "scopes": list(request.scopes), "created_us": tx.now_us,
        "expires_us": expires_us, "session": session, "created_by": tx.principal.token_id, "labels": labels,
    }  # fmt: skip
    made = tx.execute(insert(token).values(**row).returning(*token.c)).one()
    details = {"name": made.name, "scopes": list(request.scopes), "session": session}
    tx.audit("token.created", made.id, about=tx.principal.require_user_name(), **details)
    return NewToken(**shown(made, tx.principal.user_name).model_dump(), secret=issued.text)


def _labels_of(tx: Transaction, request: TokenCreate) -> Mapping[str, str] | None:
    """Return the labels to which a new token is bound; None if it is not bound to labels.

    They are the requested labels. By default, a token that can claim jobs gets the labels of the caller's token. Raises
    `InvalidProblem` if a token that cannot claim jobs is to have labels, and `ForbiddenProblem` for a label that the
    caller's token does not allow.
    """
    claims_jobs = scopes.reaches_somewhere(request.scopes, "work")
    if request.labels is None:
        return tx.principal.labels if claims_jobs else None
    if not claims_jobs:
        detail = "Only a token that can claim jobs can have labels: add the scope `work`, or leave out the labels."
        raise InvalidProblem(detail, errors=[FieldError(pointer="/labels", code="needs-work", detail=detail)])
    labels_key(request.labels)  # raises InvalidProblem for labels that no worker can announce
    if (beyond := first_outside(request.labels, tx.principal.labels)) is not None:
        raise ForbiddenProblem(
            f"Your token does not allow the label {beyond!r}, so it cannot create a token that allows it.",
            code="label-not-allowed",
            context={"label": beyond},
        )
    return request.labels


def _end_of(tx: Transaction, request: TokenCreate) -> int | None:
    """Return the time in microseconds since 1970 at which a new token expires, or None if it never expires.

    By default, the new token expires no later than the caller's own token. Raises `ForbiddenProblem` if the request
    explicitly sets a later time.
    """
    own_us, lifetime_s = tx.principal.expires_us, request.expires_in_s
    wanted_us = None if lifetime_s is None else tx.now_us + lifetime_s * 1_000_000
    if own_us is None or (wanted_us is not None and wanted_us <= own_us):
        return wanted_us
    if "expires_in_s" in request.model_fields_set:
        left_s = (own_us - tx.now_us) // 1_000_000
        raise ForbiddenProblem(
            "A token cannot be valid longer than the token that creates it, and yours ends on "
            f"{datetime_of(own_us):%Y-%m-%d at %H:%M} UTC, in {_in_words(left_s)}; request fewer days, or "
            "sign in for a longer time.",
            code="outlives-credential",
            context={"left_s": left_s, "latest": datetime_of(own_us).isoformat()},
        )
    return own_us


def _in_words(seconds: int) -> str:
    """Return a duration as text in days, hours or minutes, rounded down, such as "3 days"."""
    unit, size = next(
        (unit for unit in (("day", 86_400), ("hour", 3600)) if seconds >= unit[1]),
        ("minute", 60),
    )
    return counted(seconds // size, unit)


def list_tokens(
    tx: Transaction, wanted: TokenFilter = OWN_TOKENS, *, cursor: str | None = None, limit: int = listing.DEFAULT_LIMIT
) -> Page:
    """Return the caller's tokens, or for an administrator the tokens of any user, newest first and without secrets.

    Raises `NotFoundProblem` if other callers ask for the tokens of another user, and `ForbiddenProblem` if they ask for
    the tokens of all users.
    """
    own_id = _require_user(tx.principal, "read")
    conditions: list[ColumnElement[bool]] = []
    if wanted.everybody:
        require_administrator(tx.principal)
    elif wanted.user is None or wanted.user == tx.principal.user_name:
        conditions.append(token.c.user_id == own_id)
    else:
        conditions.append(token.c.user_id == _id_of(tx, wanted.user))
    if wanted.prefix is not None:
        conditions.append(token.c.prefix == wanted.prefix)
    if wanted.ends_within_s is not None:
        conditions.append(token.c.expires_us.between(tx.now_us, tx.now_us + wanted.ends_within_s * 1_000_000))
    order = listing.parse_order("-id", {"id": token.c.id})
    statement = select(token, user.c.name.label("user_name")).join(user, user.c.id == token.c.user_id)
    # Without filters, cursors of version 0.1 are valid.
    identity = ["tokens", own_id, *(() if wanted == OWN_TOKENS else map(str, wanted))]
    rows, next_cursor = listing.read_page(tx, statement.where(*conditions), order, identity, cursor, limit)
    return Page(items=tuple(shown(row, row.user_name) for row in rows), next_cursor=next_cursor)


def _id_of(tx: Transaction, name: str) -> str:
    """Return the id of a user.

    Raises `NotFoundProblem` if the user does not exist, or if the caller is no administrator.
    """
    unknown = NotFoundProblem(f"There is no user {name!r} that you may see.", code="no-user")
    require_administrator(tx.principal, hidden=unknown)
    found = tx.execute(select(user.c.id).where(user.c.name == name)).scalar()
    if found is None:
        raise unknown
    return str(found)


def revoke_token(tx: Transaction, token_id: str, *, with_created: bool = False) -> None:
    """Revoke a token of the caller; administrators may revoke any token.

    Raises `NotFoundProblem` if there is no such token that the caller may revoke.

    With `with_created`, also revoke the successors and predecessors of this token, all tokens that were created with
    any of these, and so on.

    Without `with_created`, only this token and the sessions of browsers that it began are revoked, and the tokens
    connected by it are connected directly. For example, if A created the revoked token B, and B created C, then C is
    recorded as created by A. The successor of B is recorded as the successor of B's predecessor. A token may always
    revoke itself.
    """
    principal = tx.principal
    if principal.kind != "user" or token_id != principal.token_id:
        _require_user(principal, "write")
    which = token.c.id == token_id
    if not is_administrator(principal):
        which = and_(which, token.c.user_id == principal.user_id)
    found = tx.execute(select(token.c.user_id, token.c.created_by, token.c.successor_of).where(which)).first()
    if found is None:
        raise NotFoundProblem(
            f"There is no token {token_id!r} that you may revoke; `marey token ls` lists your tokens.", code="no-token"
        )
    _lock_tokens(tx, found.user_id)
    if with_created:
        _revoke(tx, token.c.id.in_(_connected_with(which)))
        return
    lasting = and_(token.c.created_by == token_id, token.c.session.is_(False))
    tx.execute(update(token).where(lasting).values(created_by=found.created_by))
    _revoke(tx, which)
    tx.execute(update(token).where(token.c.successor_of == token_id).values(successor_of=found.successor_of))


def _connected_with(which: ColumnElement[bool]) -> Select[*tuple[Any, ...]]:
    """Return a query for the ids of the tokens that meet `which`, and of all tokens connected with them, recursively.

    A token is connected with its predecessor, with its successor, and with the tokens that were created with it.
    """
    chain = select(token.c.id, token.c.successor_of).where(which).cte("chain", recursive=True)
    connected = or_(
        token.c.created_by == chain.c.id, token.c.successor_of == chain.c.id, token.c.id == chain.c.successor_of
    )
    chain = chain.union(select(token.c.id, token.c.successor_of).where(connected))
    return select(chain.c.id)


def lock_own(tx: Transaction) -> Row[Any]:
    """Lock the row of the request's token until the transaction ends, and return it.

    Raises `UnauthenticatedProblem` if the token was revoked after the request was authenticated.
    """
    _lock_tokens(tx, tx.principal.user_id)
    row = tx.execute(select(token).where(token.c.id == tx.principal.token_id)).one_or_none()
    if row is None:
        raise unknown_token()
    return row


def _lock_tokens(tx: Transaction, user_id: str | None) -> None:
    """Let only one transaction at a time create, rotate or revoke tokens of a user.

    Otherwise a revocation with `with_created` could miss a token that is being created at the same time.
    """
    tx.lock(f"user_tokens {user_id}")


def revoke_named(tx: Transaction, name: str) -> None:
    """Revoke the caller's tokens that have this name."""
    _revoke(tx, and_(token.c.user_id == _require_user(tx.principal, "write"), token.c.name == name))


def end_tokens(tx: Transaction, user_id: str, which: EndTokens) -> None:
    """Revoke the tokens of a user that `which` selects (none, sessions or all), except the token of this request.

    Does not check whether the principal may do this.
    """
    if which is EndTokens.NONE:
        return
    others = and_(token.c.user_id == user_id, token.c.id != (tx.principal.token_id or ""))
    _revoke(tx, others if which is EndTokens.ALL else and_(others, token.c.session.is_(True)))


def _revoke(tx: Transaction, which: ColumnElement[bool]) -> None:
    """Revoke the selected tokens, and the links and sessions of browsers that were made with them."""
    of_browsers = token.c.created_by.in_(select(token.c.id).where(which).correlate(None)), token.c.session.is_(True)
    ended = delete(token).where(or_(which, and_(*of_browsers)))
    gone = tx.execute(ended.returning(token.c.id, token.c.name, token.c.user_id)).all()
    owners = select(user.c.id, user.c.name).where(user.c.id.in_({row.user_id for row in gone}))
    names = {row.id: row.name for row in tx.execute(owners)} if gone else {}
    for row in gone:
        tx.audit("token.revoked", row.id, about=names[row.user_id], name=row.name)


def expired_long_ago(tx: Transaction) -> ColumnElement[bool]:
    """Return the SQL condition for tokens that expired more than `KEPT_AFTER_END_US` ago, and may be deleted."""
    return token.c.expires_us < tx.now_us - KEPT_AFTER_END_US


def note_use(tx: Transaction, token_id: str) -> None:
    """Update the time of a token's last use, at most once an hour."""
    before = tx.now_us - NOTE_USE_EVERY_S * 1_000_000
    stale = or_(token.c.last_used_us.is_(None), token.c.last_used_us < before)
    tx.execute(update(token).where(token.c.id == token_id, stale).values(last_used_us=tx.now_us))


def _require_user(principal: Principal, scope: str) -> str:
    if principal.kind == "anonymous":
        raise UnauthenticatedProblem("Sign in to see your tokens.")
    if principal.kind != "user" or principal.user_id is None:
        raise ForbiddenProblem(
            "Only users have tokens, and the token of a running job does not belong to a user.", code="users-only"
        )
    if not scopes.allows(principal.scopes, scope):
        raise ForbiddenProblem(
            f"This request needs a token with the scope {scope!r} for all projects.", code="insufficient-scope"
        )
    return principal.user_id


def shown(row: Row[Any], user_name: str | None) -> Token:
    """Return a token as a document, without its secret."""
    return Token(
        id=row.id, name=row.name, prefix=row.prefix, scopes=tuple(row.scopes), created_at=datetime_of(row.created_us),
        expires_at=None if row.expires_us is None else datetime_of(row.expires_us),
        last_used_at=None if row.last_used_us is None else datetime_of(row.last_used_us),
        user=user_name, session=row.session, created_by=row.created_by, labels=row.labels,
        successor_of=row.successor_of,
    )  # fmt: skip
