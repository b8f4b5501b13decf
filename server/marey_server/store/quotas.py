"""Quotas: limits on what one user, or one project, may have.

The transaction that adds something counts it, so the count is always exact. Items and their bytes have counters in the
table `holding`, for the project and for the user who created the item. All other things,
such as tokens and jobs, are counted each time another one is added.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

from sqlalchemy import Column, Row, Select, Table, and_, bindparam, exists, func, or_, select, text, update

from marey_schemas.access import (
    ProjectQuotaChange,
    ProjectQuotasInUse,
    QuotaChange,
    QuotasInUse,
    QuotaUse,
    Role,
    RunningJobs,
)
from marey_server.errors import QuotaExceededProblem
from marey_server.store import rate_limits
from marey_server.store.database.prepared import Prepared
from marey_server.store.invitations.validity import is_unspent
from marey_server.store.jobs.claiming.limits import read_limit, set_limit
from marey_server.store.rate_limits import DailyAmount, key_of
from marey_server.store.tables import (
    UNFINISHED,
    blob,
    document,
    holding,
    invitation,
    item,
    job,
    member,
    project,
    revision_part,
    token,
    upload,
    upload_chunk,
)
from marey_server.store.transaction import Transaction


@dataclass(frozen=True, slots=True)
class _Rule:
    """Text about a quota in errors: its name, and what the user can do."""

    noun: str
    remedy: str


_DELETE = "Delete items that nobody needs, or ask an administrator for a higher limit (`marey {of} quota`)."

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
    "items": _Rule("items", _DELETE),
    "stored_bytes": _Rule("bytes of items", _DELETE),
}


def require_room(tx: Transaction, quota: str, more: int = 1) -> None:
    """Check that the caller can add `more` things of the kind that a quota limits, without exceeding this quota.

    `quota` is a field of `Quotas`, such as "user_uploads"; for quotas of bytes, `more` is a number of bytes. The server
    and attempts of jobs have no quotas. Concurrent checks of one user run one after another. Raises
    `QuotaExceededProblem`.
    """
    user_id = tx.principal.user_id
    if user_id is None or tx.principal.kind != "user":
        return
    tx.lock(f"{quota} {user_id}")
    used, limit = int(tx.execute(_used(tx, quota, user_id)).scalar_one()), getattr(tx.quotas, quota)
    if used + more <= limit:
        return
    remedy = _remedy(tx, quota, user_id) if used else f"The operator can raise the setting `{quota}`."
    raise _exceeded("You have", quota, _RULES[quota].noun, used, limit, more, remedy)


def _remedy(tx: Transaction, quota: str, user_id: str) -> str:
    oldest = tx.execute(select(upload.c.id).where(*_open(user_id)).order_by(upload.c.created_us).limit(1)).scalar()
    if quota == "user_upload_bytes" and oldest is None:
        return "Wait until the server has deleted the pieces of finished uploads, which it does every hour."
    return _RULES[quota].remedy.format(oldest=oldest)


def room_of(tx: Transaction, quota: str, user_id: str) -> int:
    """Return how many things of a kind a user may still add; concurrent writes may take the same room.

    Unlike `require_room`, this concerns a user who is not the caller, and locks nothing.
    """
    return int(getattr(tx.quotas, quota) - tx.execute(_used(tx, quota, user_id)).scalar_one())


def _exceeded(
    subject: str, quota: str, noun: str, used: int, limit: int, more: int, remedy: str
) -> QuotaExceededProblem:
    return QuotaExceededProblem(
        f"{subject} {used:,} {noun}, the limit is {limit:,}, and this needs {more:,} more. {remedy}",
        context={"quota": quota, "used": used, "limit": limit},
    )


def _used(tx: Transaction, quota: str, user_id: str) -> Select[Any]:
    if quota == "user_uploads":
        return select(func.count()).select_from(upload).where(*_open(user_id))
    if quota == "user_upload_bytes":
        taking_space = or_(and_(*_open(user_id)), and_(*_useless(user_id)))
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


def _useless(user_id: str) -> tuple[Any, ...]:
    """Return the conditions for finished uploads whose pieces no blob needs, and which are not deleted yet.

    Their bytes were stored already, so they do not count towards `user_daily_bytes`.
    """
    has_pieces = exists().where(upload_chunk.c.upload_id == upload.c.id)
    has_blob = exists().where(blob.c.upload_id == upload.c.id)
    return upload.c.user_id == user_id, upload.c.finished_digest.is_not(None), has_pieces, ~has_blob


# -- bytes that users send --------------------------------------------------------------------------------------------


def require_sendable(tx: Transaction, size_bytes: int) -> None:
    """Check that the caller may send new bytes at present, but do not count them; use `count_sent` as well.

    Raises `QuotaExceededProblem`.
    """
    if (limit := _part_of_day(tx, size_bytes)) is not None:
        _require_daily(tx, size_bytes, rate_limits.wait_s(tx, limit))


def count_sent(tx: Transaction, size_bytes: int) -> None:
    """Count new bytes that the caller sends; they take space for a day, even if no item ever uses them.

    Call this once, at the end of a transaction: until the transaction ends, other counts of the same user wait. The
    server and attempts of jobs have no quotas. Raises `QuotaExceededProblem` if the caller has sent too many bytes.
    """
    if (limit := _part_of_day(tx, size_bytes)) is not None:
        _require_daily(tx, size_bytes, 0 if size_bytes > tx.quotas.user_daily_bytes else rate_limits.count(tx, limit))


def _require_daily(tx: Transaction, size_bytes: int, wait_s: int) -> None:
    """Raise `QuotaExceededProblem` if the caller must wait before sending bytes, or has a quota that is too small."""
    most = tx.quotas.user_daily_bytes
    never = size_bytes > most
    if wait_s == 0 and not never:
        return
    remedy = "The operator can raise the setting `user_daily_bytes`."
    raise QuotaExceededProblem(
        f"You may send {most:,} new bytes per day, and this request needs {size_bytes:,} more. "
        + (remedy if never else f"Send the data in {wait_s} s. {remedy}"),
        context={"quota": "user_daily_bytes", "limit": most, "wait_s": None if never else wait_s},
    )


def take_back_sent(tx: Transaction, size_bytes: int) -> None:
    """Undo the count of bytes that were announced, but never received."""
    if (limit := _part_of_day(tx, size_bytes)) is not None:
        rate_limits.take_back(tx, limit)


def _part_of_day(tx: Transaction, size_bytes: int) -> DailyAmount | None:
    """Return the daily limit for the bytes that the caller sends, or None if no limit applies."""
    if tx.principal.user_id is None or tx.principal.kind != "user" or size_bytes == 0:
        return None
    key = key_of("sent-bytes", tx.principal.user_id)
    return DailyAmount.part(key, size_bytes, max(1, tx.quotas.user_daily_bytes))


# -- items and their bytes --------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Held:
    """Number of items, and number of bytes of their revisions."""

    items: int = 0
    stored_bytes: int = 0

    def __str__(self) -> str:
        return f"{self.items:,} items of {self.stored_bytes:,} bytes"

    def __add__(self, more: Held) -> Held:
        return Held(self.items + more.items, self.stored_bytes + more.stored_bytes)


COUNTED = ("items", "stored_bytes")
"""Quotas whose counters are in the table `holding`."""

_ADD = Prepared(
    update(holding)
    .where(holding.c.owner_id == bindparam("owner"))
    .values({name: holding.c[name] + bindparam(f"more_{name}") for name in COUNTED})
    .returning(*holding.c)
)


def by_creator(rows: Iterable[Row[Any]]) -> dict[str | None, Held]:
    """Return the number of items and bytes of each creator, from rows of items with `creator_id` and `stored_bytes`."""
    held: dict[str | None, Held] = {}
    for row in rows:
        held[row.creator_id] = held.get(row.creator_id, Held()) + Held(1, row.stored_bytes)
    return held


def hold(tx: Transaction, project_id: str, more: Mapping[str | None, Held]) -> None:
    """Add items and bytes to the counters of a project and of the creators of these items.

    The counters are locked until the transaction ends, so that no concurrent writes exceed a quota together. Raises
    `QuotaExceededProblem`; the caller must then roll back.
    """
    total = sum(more.values(), Held())
    if total == Held():
        return
    _hold(tx, "project", project_id, total)
    for creator_id in sorted(filter(None, more)):
        _hold(tx, "user", creator_id, more[creator_id])


def _hold(tx: Transaction, of: str, owner_id: str, more: Held) -> None:
    row = _add(tx, owner_id, more)
    for name in COUNTED:
        used, added, limit = getattr(row, name), getattr(more, name), limit_of(tx, of, name, row.limits)
        if added and used > limit:
            subject = "The project has" if of == "project" else "The user who created the items has"
            rule = _RULES[name]
            remedy = rule.remedy.format(of=of)
            raise _exceeded(subject, f"{of}_{name}", rule.noun, used - added, limit, added, remedy)


def require_place(tx: Transaction, project_id: str, table: Table) -> None:
    """Check that a project may have one more row of a table, which has the column `project_id`.

    The quota is `project_<table>s`, such as `project_webhooks`. Concurrent checks of one project run one after another.
    Raises `QuotaExceededProblem`.
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


def limit_of(tx: Transaction, of: str, name: str, limits: Mapping[str, int]) -> int:
    """Return the value of a quota for one project or user.

    `of` is "project" or "user", and `name` is "items" or "stored_bytes". `limits` are the values that an administrator
    has set for this project or user; a quota that is not among them has its value from the server's settings.
    """
    return limits.get(name, getattr(tx.quotas, f"{of}_{name}"))


def release(tx: Transaction, project_id: str, less: Mapping[str | None, Held]) -> None:
    """Subtract items and bytes from the counters of a project and of the creators of these items."""
    total = sum(less.values(), Held())
    for owner_id, held in ((project_id, total), *sorted((one, less[one]) for one in less if one is not None)):
        if held != Held():
            _add(tx, owner_id, Held(-held.items, -held.stored_bytes))


def _add(tx: Transaction, owner_id: str, more: Held) -> Any:
    given = {"owner": owner_id, "more_items": more.items, "more_stored_bytes": more.stored_bytes}
    row = tx.first(_ADD, given)
    if row is None:
        tx.execute(tx.insert_or_ignore(holding, {"owner_id": owner_id, "limits": {}}))
        row = tx.first(_ADD, given)
    return row


def show_quotas(tx: Transaction, of: Literal["project", "user"], owner_id: str) -> QuotasInUse:
    """Return the use and the limits of the quotas of a project or a user."""
    row = tx.execute(select(holding).where(holding.c.owner_id == owner_id)).first()
    limits = {} if row is None else row.limits
    return QuotasInUse(
        **{
            name: QuotaUse(used=0 if row is None else getattr(row, name), allowed=limit_of(tx, of, name, limits))
            for name in COUNTED
        }
    )


def show_project_quotas(tx: Transaction, project_id: str) -> ProjectQuotasInUse:
    """Return the use and the limits of the quotas of a project, with that of running jobs."""
    running, limit = read_limit(tx, project_id)
    shown = show_quotas(tx, "project", project_id)
    jobs = RunningJobs(used=running, allowed=limit)
    return ProjectQuotasInUse(items=shown.items, stored_bytes=shown.stored_bytes, running_jobs=jobs)


def change_project_limits(
    tx: Transaction, project_id: str, name: str, change: ProjectQuotaChange
) -> ProjectQuotasInUse:
    """Change the quotas of a project, and return all of its quotas and their use.

    The caller must have checked that the principal is an administrator.
    """
    if "running_jobs" in change.model_fields_set:
        set_limit(tx, project_id, change.running_jobs)
        tx.execute(update(project).where(project.c.id == project_id).values(rev=project.c.rev + 1))
    limits = _change_limits(tx, project_id, change)
    _, most_running = read_limit(tx, project_id)
    if most_running is not None:
        limits = {**limits, "running_jobs": most_running}
    tx.audit("project.limited", project_id, about=name, project_id=project_id, limits=limits)
    return show_project_quotas(tx, project_id)


def change_user_limits(tx: Transaction, user_id: str, name: str, change: QuotaChange) -> QuotasInUse:
    """Change the quotas of a user, and return all of its quotas and their use.

    The caller must have checked that the principal is an administrator.
    """
    tx.audit("user.limited", user_id, about=name, limits=_change_limits(tx, user_id, change))
    return show_quotas(tx, "user", user_id)


def _change_limits(tx: Transaction, owner_id: str, change: QuotaChange) -> dict[str, int]:
    """Change the limits of items and bytes, and return those that differ from the settings."""
    changed = _add(tx, owner_id, Held()).limits | change.model_dump(exclude_unset=True, include=set(COUNTED))
    limits = {name: limit for name, limit in changed.items() if limit is not None}
    tx.execute(update(holding).where(holding.c.owner_id == owner_id).values(limits=limits))
    return limits


# -- checks -----------------------------------------------------------------------------------------------------------

_BEFORE = revision_part.alias("before")
_UNCHANGED = exists().where(
    _BEFORE.c.item_id == revision_part.c.item_id,
    _BEFORE.c.number == revision_part.c.number - 1,
    _BEFORE.c.part == revision_part.c.part,
    _BEFORE.c.document_digest == revision_part.c.document_digest,
)
BYTES_OF_ITEM = (
    select(func.coalesce(func.sum(document.c.size_bytes + document.c.file_bytes), 0))
    .join(revision_part, revision_part.c.document_digest == document.c.digest)
    .where(revision_part.c.item_id == item.c.id, ~_UNCHANGED)
    .correlate(item)
    .scalar_subquery()
)
"""Bytes of all revisions of an item; a part counts in each revision that changed it."""


_SUMS = (func.count().label("items"), func.coalesce(func.sum(item.c.stored_bytes), 0).label("stored_bytes"))


def count_held(tx: Transaction, owner: Column[str], owner_id: str) -> Held:
    """Return the numbers of items and bytes of a project or a user, counted item by item.

    `owner` is the column of `item` that names the project or user.
    """
    row = tx.execute(select(*_SUMS).where(owner == owner_id, item.c.deleted_us.is_(None))).one()
    return Held(row.items, int(row.stored_bytes))


def read_held(tx: Transaction, owner_id: str) -> Held:
    """Return the number of items and bytes of a project or a user from the counters."""
    row = tx.execute(select(holding.c["items"], holding.c.stored_bytes).where(holding.c.owner_id == owner_id)).first()
    return Held() if row is None else Held(row.items, row.stored_bytes)


def recount(tx: Transaction) -> None:
    """Count all items and bytes, and set the counters. Other writes of items wait until the transaction ends."""
    if tx.is_postgres:
        tx.execute(text("LOCK TABLE item IN SHARE ROW EXCLUSIVE MODE"))
    tx.execute(update(item).where(item.c.stored_bytes != BYTES_OF_ITEM).values(stored_bytes=BYTES_OF_ITEM))
    tx.execute(update(holding).values(items=0, stored_bytes=0))
    for owner in (item.c.project_id, item.c.creator_id):
        sums = select(owner.label("owner_id"), *_SUMS).where(item.c.deleted_us.is_(None), owner.is_not(None))
        for row in tx.execute(sums.group_by(owner)).all():
            _add(tx, row.owner_id, Held(row.items, int(row.stored_bytes)))
