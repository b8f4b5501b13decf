"""Quotas of things that are counted each time another one is added, such as tokens, jobs and schedules.

The transaction that adds something counts it, so the count is always exact. Only unfinished jobs are not counted each
time; see `require_room_for_jobs`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from sqlalchemy import Select, Table, and_, bindparam, exists, func, or_, select, update

from marey_schemas.access import Role
from marey_server.errors import QuotaExceededProblem
from marey_server.store.database.prepared import Prepared
from marey_server.store.invitations.validity import is_unspent
from marey_server.store.tables import (
    UNFINISHED,
    blob,
    invitation,
    job,
    member,
    project,
    token,
    upload,
    upload_chunk,
    user,
)
from marey_server.store.transaction import Transaction


@dataclass(frozen=True, slots=True)
class _Rule:
    """Parts of the error text for an exceeded quota: the noun for what is counted, and what the user can do."""

    noun: str
    remedy: str


_RULES = {
    "user_uploads": _Rule("open uploads", "Finish or delete one of them, such as {oldest}."),
    "user_upload_bytes": _Rule(
        "bytes of uploads that are open, or whose pieces are not deleted yet",
        "Finish or delete one of them, such as {oldest}.",
    ),
    "user_tokens": _Rule("valid tokens", "Revoke one that you do not need; see `marey token ls`."),
    "user_projects": _Rule("projects that you own", "Delete one, or let another owner take over."),
    "user_jobs": _Rule("unfinished jobs", "Wait until some have ended, or cancel some; see `marey job ls`."),
    "user_invitations": _Rule(
        "open invitations",
        "Withdraw one that is not needed; see `marey member invitations` and `marey user invitations`.",
    ),
}


def require_room(tx: Transaction, quota: str, more: int = 1) -> None:
    """Raise `QuotaExceededProblem` if the caller would exceed a quota by adding `more` of what the quota counts.

    `quota` is a field of `Quotas`, such as "user_uploads"; for quotas of bytes, `more` is a number of bytes. The server
    and attempts of jobs have no quotas. Concurrent checks of one user run one after another.
    """
    user_id = tx.principal.user_id
    if user_id is None or tx.principal.kind != "user":
        return
    tx.lock(f"{quota} {user_id}")
    _require_counted(tx, quota, user_id, more)


def _require_counted(tx: Transaction, quota: str, user_id: str, more: int) -> int:
    """Count what a user has, and return the count; raise `QuotaExceededProblem` if `more` would exceed the quota."""
    used, limit = int(tx.execute(_used(tx, quota, user_id)).scalar_one()), getattr(tx.quotas, quota)
    if used + more <= limit:
        return used
    remedy = _remedy(tx, quota, user_id) if used else f"The operator can raise the setting `{quota}`."
    raise exceeded("You have", quota, _RULES[quota].noun, used, limit, more, remedy)


_ADD_JOBS = Prepared(
    update(user)
    .where(user.c.id == bindparam("of_user"), user.c.jobs_bound + bindparam("more") <= bindparam("most"))
    .values(jobs_bound=user.c.jobs_bound + bindparam("more"))
    .returning(user.c.id)
)


def require_room_for_jobs(tx: Transaction, more: int) -> None:
    """Raise `QuotaExceededProblem` if the caller would exceed the quota `user_jobs` by adding `more` unfinished jobs.

    Counting all unfinished jobs takes long if there are many. So an upper bound of their number is stored for each
    user: it grows with each submission, but does not fall when jobs end. Only when the bound would exceed the quota,
    the jobs are counted, and the bound is corrected. Concurrent checks of one user run one after another.
    """
    user_id = tx.principal.user_id
    if user_id is None or tx.principal.kind != "user":
        return
    if not tx.run(_ADD_JOBS, {"of_user": user_id, "more": more, "most": tx.quotas.user_jobs}):
        tx.execute(select(user.c.id).where(user.c.id == user_id).with_for_update(key_share=True))
        used = _require_counted(tx, "user_jobs", user_id, more)
        tx.execute(update(user).where(user.c.id == user_id).values(jobs_bound=used + more))


def note_jobs(tx: Transaction, user_id: str, more: int) -> None:
    """Add `more` to the stored bound of a user's unfinished jobs (`require_room_for_jobs`), even beyond the quota.

    The row of the user is locked even if the bound is null, so that a concurrent first count waits for these jobs.
    """
    tx.execute(update(user).where(user.c.id == user_id).values(jobs_bound=user.c.jobs_bound + more))


def _remedy(tx: Transaction, quota: str, user_id: str) -> str:
    oldest = tx.execute(select(upload.c.id).where(*_open(user_id)).order_by(upload.c.created_us).limit(1)).scalar()
    if quota == "user_upload_bytes" and oldest is None:
        return "Wait until the server has deleted the pieces of finished uploads, which it does every hour."
    return _RULES[quota].remedy.format(oldest=oldest)


def room_of(tx: Transaction, quota: str, user_id: str) -> int:
    """Return how many things a user may still add without exceeding a quota; negative if there are too many already.

    Unlike `require_room`, this function is for a user who is not the caller, and locks nothing. So concurrent writes
    may together exceed the quota.
    """
    return int(getattr(tx.quotas, quota) - tx.execute(_used(tx, quota, user_id)).scalar_one())


def exceeded(
    subject: str, quota: str, noun: str, used: int, limit: int, more: int, remedy: str
) -> QuotaExceededProblem:
    return QuotaExceededProblem(
        f"{subject} {used:,} {noun}, the limit is {limit:,}, and this needs {more:,} more. {remedy}",
        context={"quota": quota, "used": used, "limit": limit},
    )


def _used(tx: Transaction, quota: str, user_id: str) -> Select[*tuple[Any, ...]]:
    if quota == "user_uploads":
        return select(func.count()).select_from(upload).where(*_open(user_id))
    if quota == "user_upload_bytes":
        taking_space = or_(and_(*_open(user_id)), and_(*_stored_twice(user_id)))
        return select(func.coalesce(func.sum(upload.c.length), 0)).where(taking_space)
    if quota == "user_tokens":
        valid = or_(token.c.expires_us.is_(None), token.c.expires_us > tx.now_us)
        counted = token.c.user_id == user_id, ~token.c.session, token.c.rotation_hash.is_(None), valid
        return select(func.count()).select_from(token).where(*counted)
    if quota == "user_jobs":
        return select(func.count()).select_from(job).where(job.c.author_id == user_id, UNFINISHED)
    if quota == "user_invitations":
        return select(func.count()).select_from(invitation).where(invitation.c.inviter_id == user_id, is_unspent(tx))
    owned = select(func.count()).select_from(member.join(project, project.c.id == member.c.project_id))
    return owned.where(member.c.user_id == user_id, member.c.role == Role.OWNER.value, project.c.deleted_us.is_(None))


def _open(user_id: str) -> tuple[Any, ...]:
    return upload.c.user_id == user_id, upload.c.finished_digest.is_(None), upload.c.dropped.is_(False)


def _stored_twice(user_id: str) -> tuple[Any, ...]:
    """Return the SQL conditions for finished uploads of a user whose bytes are stored twice.

    Their bytes were a blob already, so no blob uses the pieces of the upload, and they do not count towards
    `user_daily_bytes`. The pieces take space until they are deleted.
    """
    has_pieces = exists().where(upload_chunk.c.upload_id == upload.c.id)
    has_blob = exists().where(blob.c.upload_id == upload.c.id)
    return upload.c.user_id == user_id, upload.c.finished_digest.is_not(None), has_pieces, ~has_blob


def require_place(tx: Transaction, project_id: str, table: Table) -> None:
    """Raise `QuotaExceededProblem` if a project may not have another row of a table.

    The table has the column `project_id`. The quota is `project_<table>s`, such as `project_webhooks`. Concurrent
    checks of one project run one after another.
    """
    noun, quota = f"{table.name}s", f"project_{table.name}s"
    tx.lock(f"{noun} {project_id}")
    limit = getattr(tx.quotas, quota)
    used = tx.execute(select(func.count()).where(table.c.project_id == project_id)).scalar_one()
    if used >= limit:
        raise QuotaExceededProblem(
            f"The project has {used:,} {noun}, and the limit is {limit:,}. Delete one that is not needed, or ask the "
            f"operator to raise the setting `{quota}`.",
            context={"quota": quota, "used": used, "limit": limit},
        )
