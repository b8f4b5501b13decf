"""Bearer tokens: who shows one is who."""

from __future__ import annotations

from sqlalchemy import select

from marey_schemas.jobs import JobState
from marey_server.access.principal import Principal
from marey_server.access.secret_tokens import attempt_secret, hash_secret, secret_matches, split_user_token
from marey_server.errors import Unauthenticated
from marey_server.store.database import Transaction
from marey_server.store.tables import attempt, job, token, user

_ATTEMPT_SCOPES = ("read",)


def resolve_token(tx: Transaction, text: str) -> Principal:
    """The principal that a bearer token stands for. Raises `Unauthenticated` where it stands for nobody."""
    if (secret := attempt_secret(text)) is not None:
        return _resolve_attempt(tx, secret)
    if (parts := split_user_token(text)) is not None:
        return _resolve_user(tx, *parts)
    raise _unknown()


def _unknown() -> Unauthenticated:
    return Unauthenticated("The token is unknown, expired or revoked.", code="bad-token")


def _resolve_user(tx: Transaction, prefix: str, secret: str) -> Principal:
    statement = (
        select(token.c.id, token.c.secret_hash, token.c.scopes, token.c.expires_us)
        .add_columns(user.c.id.label("user_id"), user.c.name, user.c.administrator, user.c.disabled)
        .join(user, user.c.id == token.c.user_id)
        .where(token.c.prefix == prefix)
    )
    row = tx.execute(statement).first()
    if row is None or not secret_matches(secret, row.secret_hash) or row.disabled:
        raise _unknown()
    if row.expires_us is not None and row.expires_us <= tx.now_us:
        raise _unknown()
    return Principal("user", row.user_id, row.name, row.administrator, tuple(row.scopes), row.id)


def _resolve_attempt(tx: Transaction, secret: str) -> Principal:
    """An attempt lives while its fence is the job's. Once the job has ended, the token only serves to hear again what
    `complete` or `fail` answered: it reads nothing any more.
    """
    statement = (
        select(job.c.id, job.c.project_id, job.c.author_id, job.c.state, attempt.c.fence, user.c.name)
        .select_from(attempt.join(job, job.c.id == attempt.c.job_id).outerjoin(user, user.c.id == job.c.author_id))
        .where(attempt.c.token_hash == hash_secret(secret), job.c.fence == attempt.c.fence)
    )
    row = tx.execute(statement).first()
    if row is None:
        raise _unknown()
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
