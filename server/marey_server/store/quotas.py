"""Quotas: limits on the uploads, tokens and projects of one user.

The transaction that adds to them counts them, so the count is always exact.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from sqlalchemy import Select, func, or_, select

from marey_schemas.access import Role
from marey_server.errors import QuotaExceededProblem
from marey_server.store.tables import member, project, token, upload
from marey_server.store.transaction import Transaction


@dataclass(frozen=True, slots=True)
class _Rule:
    """Text about a quota in errors: its name, and what the user can do."""

    noun: str
    remedy: str


_RULES = {
    "user_uploads": _Rule("open uploads", "Finish or delete one of them, such as {oldest}."),
    "user_upload_bytes": _Rule("bytes announced by open uploads", "Finish or delete one of them, such as {oldest}."),
    "user_tokens": _Rule("valid tokens", "Revoke one that you do not need; see `marey token ls`."),
    "user_projects": _Rule("projects that you own", "Delete one, or let another owner take over."),
}


def require_room(tx: Transaction, quota: str, more: int = 1) -> None:
    """Check that the caller can add `more` without exceeding a quota; concurrent checks of one user run one after
    another.

    `quota` is a field of `Quotas`. The server and attempts of jobs have no quotas. Raises `QuotaExceededProblem`.
    """
    user_id = tx.principal.user_id
    if user_id is None or tx.principal.kind != "user":
        return
    tx.lock(f"{quota} {user_id}")
    used, limit = int(tx.execute(_used(tx, quota, user_id)).scalar_one()), getattr(tx.quotas, quota)
    if used + more <= limit:
        return
    oldest = tx.execute(select(upload.c.id).where(*_open(user_id)).order_by(upload.c.created_us).limit(1)).scalar()
    rule = _RULES[quota]
    raise QuotaExceededProblem(
        f"You have {used:,} {rule.noun}, the limit is {limit:,}, and this needs {more:,} more. "
        + rule.remedy.format(oldest=oldest or "none"),
        context={"quota": quota, "used": used, "limit": limit},
    )


def _used(tx: Transaction, quota: str, user_id: str) -> Select[Any]:
    if quota == "user_uploads":
        return select(func.count()).select_from(upload).where(*_open(user_id))
    if quota == "user_upload_bytes":
        return select(func.coalesce(func.sum(upload.c.length), 0)).where(*_open(user_id))
    if quota == "user_tokens":
        valid = or_(token.c.expires_us.is_(None), token.c.expires_us > tx.now_us)
        return select(func.count()).select_from(token).where(token.c.user_id == user_id, ~token.c.session, valid)
    owned = select(func.count()).select_from(member.join(project, project.c.id == member.c.project_id))
    return owned.where(member.c.user_id == user_id, member.c.role == Role.OWNER.value, project.c.deleted_us.is_(None))


def _open(user_id: str) -> tuple[Any, ...]:
    return upload.c.user_id == user_id, upload.c.finished_digest.is_(None), upload.c.dropped.is_(False)
