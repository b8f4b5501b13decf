"""Users: people and services that can sign in."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from sqlalchemy import ColumnElement, Row, Table, func, insert, select, update

from marey_schemas.access import EndTokens, QuotaChange, QuotasInUse, Scope, User, UserChange, UserCreate
from marey_schemas.items import Page
from marey_server.access import scopes
from marey_server.access.principal import Principal
from marey_server.access.roles import is_administrator, require_administrator
from marey_server.errors import (
    ConflictProblem,
    ForbiddenProblem,
    NotFoundProblem,
    PreconditionFailedProblem,
    UnauthenticatedProblem,
)
from marey_server.store import listing
from marey_server.store.credentials import tokens
from marey_server.store.database.clock import datetime_of
from marey_server.store.database.violations import taken
from marey_server.store.ids import new_id
from marey_server.store.invitations.validity import withdraw_unauthorised
from marey_server.store.quotas import holdings, limits
from marey_server.store.revs import ExpectedRev, change_row
from marey_server.store.tables import identity, invitation, schedule, token, user
from marey_server.store.transaction import Transaction

FIRST_ADMINISTRATOR = "admin"
_ADMINISTRATORS = "administrators"


def create_user(tx: Transaction, request: UserCreate, *, password_hash: str | None = None) -> User:
    """Create a user. `password_hash` comes from `passwords.hash_password`, which is too slow for a transaction.

    Raises `ConflictProblem` if the name is taken.
    """
    require_administrator(tx.principal)
    return _insert(tx, request.name, request.display_name, request.administrator, password_hash)


def sign_up(tx: Transaction, name: str, display_name: str | None, password_hash: str | None) -> Principal:
    """Create a user without a check of rights; the new user becomes the transaction's principal, and is returned.

    Raises `ConflictProblem` if the name is taken.
    """
    tx.principal = Principal("user", new_id("user"), name, scopes=_reach(administrator=False))
    _insert(tx, name, display_name, False, password_hash, user_id=tx.principal.user_id)
    return tx.principal


def _insert(
    tx: Transaction,
    name: str,
    display_name: str | None,
    administrator: bool,
    password_hash: str | None,
    *,
    user_id: str | None = None,
) -> User:
    row = {
        "id": user_id or new_id("user"), "name": name, "display_name": display_name, "password_hash": password_hash,
        "administrator": administrator, "disabled": False, "created_us": tx.now_us, "rev": 1,
    }  # fmt: skip
    with taken(ConflictProblem(f"The name {name!r} is taken by another user; choose another name.", code="name-taken")):
        made = tx.execute(insert(user).values(**row).returning(*user.c)).one()
    tx.audit("user.created", made.id, about=name, administrator=administrator)
    return _shown(made)


def find_user(tx: Transaction, name: str) -> User:
    """Return a user. Raises `NotFoundProblem` if the caller may not read the user, or if there is no such user.

    Users may read themselves, and administrators all users.
    """
    if tx.principal.kind != "user" or tx.principal.user_name != name:
        require_administrator(tx.principal, hidden=_no_user(name))
    row = tx.execute(select(user).where(user.c.name == name)).first()
    if row is None:
        raise _no_user(name)
    return _shown(row)


def read_quotas(tx: Transaction, name: str) -> QuotasInUse:
    """Return the items and bytes that a user has, and the limits. Only administrators may do this for another user."""
    if not scopes.allows(tx.principal.scopes, "read"):  # the numbers are about all projects of the user
        raise ForbiddenProblem(
            "This request needs a token with the scope 'read' for all projects, because quotas count items of all "
            "projects.",
            code="insufficient-scope",
        )
    return holdings.show_quotas(tx, "user", find_user(tx, name).id)


def change_quotas(tx: Transaction, name: str, change: QuotaChange) -> QuotasInUse:
    """Change the quotas of a user, and return all of them and their use. Only administrators may do this."""
    require_administrator(tx.principal)
    return limits.change_user_limits(tx, find_user(tx, name).id, name, change)


def _latest_use(table: Table, name: str) -> ColumnElement[int | None]:
    latest = select(func.max(table.c.last_used_us)).where(table.c.user_id == user.c.id)
    return latest.correlate(user).scalar_subquery().label(name)


_LATEST_USES = (_latest_use(token, "token_used_us"), _latest_use(identity, "identity_used_us"))


def list_users(tx: Transaction, *, cursor: str | None = None, limit: int = listing.DEFAULT_LIMIT) -> Page:
    """List all users in the order of their names. Only administrators may do this."""
    require_administrator(tx.principal)
    order = listing.parse_order("name", {"name": user.c.name}, unique="name")
    rows, next_cursor = listing.read_page(tx, select(user, *_LATEST_USES), order, ["users"], cursor, limit)
    return Page(items=tuple(_shown(row, seen=_seen_us(row)) for row in rows), next_cursor=next_cursor)


def change_user(
    tx: Transaction,
    name: str,
    request: UserChange,
    *,
    expected_rev: ExpectedRev,
    password_hash: str | None = None,
    verified_hash: str | None = None,
) -> User:
    """Change a user: administrators may change all fields, users their own display name and password.

    A new password ends the user's sessions, unless the request says which tokens end. If all tokens end, or if the user
    is disabled, the user's schedules are paused. `password_hash` is the hash of `request.password`. `verified_hash` is
    the stored hash that `request.current_password` matched, or None.

    Raises `ForbiddenProblem` if users change their own password without the current one, and
    `PreconditionFailedProblem` if the stored hash is another one now. Raises `ConflictProblem` if no administrator
    would remain.
    """
    itself = _require_changes(tx.principal, name, request)
    which: tuple[ColumnElement[bool], ...] = (user.c.name == name,)
    if request.password is not None and itself:
        if verified_hash is None:
            raise ForbiddenProblem("Changing a password needs the current password as well.", code="wrong-password")
        which += (user.c.password_hash == verified_hash,)
    values = _values(request, password_hash)
    tx.lock(_ADMINISTRATORS)
    try:
        row = change_row(tx, user, which, values, expected_rev=expected_rev, absent=_no_user(name))
    except NotFoundProblem:
        if verified_hash is None:
            raise
        raise PreconditionFailedProblem(
            "Another request changed the password at the same time; try again with the password that is valid now.",
            code="wrong-password",
        ) from None
    _require_some_administrator(tx)
    if request.disabled or request.administrator is False:
        withdraw_unauthorised(tx, invitation.c.inviter_id == row.id)
    default = EndTokens.SESSIONS if password_hash is not None else EndTokens.NONE
    ended = request.end_tokens or default
    tokens.end_tokens(tx, row.id, ended)
    if ended is EndTokens.ALL or request.disabled:
        _pause_schedules(tx, row.id)
    _audit_change(tx, row, values, ended)
    return _shown(row)


def _pause_schedules(tx: Transaction, user_id: str) -> None:
    """Pause all schedules of a user, because somebody who had stolen a token of the user may have created them."""
    reason = "Paused, because all tokens of the author were revoked, or the author was disabled."
    which = (schedule.c.author_id == user_id, schedule.c.due_us.is_not(None))
    tx.execute(update(schedule).where(*which).values(due_us=None, problem=reason, rev=schedule.c.rev + 1))


def _audit_change(tx: Transaction, row: Row[Any], values: Mapping[str, Any], ended: EndTokens) -> None:
    """Record the change of a user in the audit log, without the hash of the password."""
    fields = sorted("password" if name == "password_hash" else name for name in values)
    rights = {name: value for name, value in values.items() if name in ("administrator", "disabled")}
    tx.audit("user.changed", row.id, about=row.name, fields=fields, ended_tokens=ended.value, **rights)


def _require_changes(principal: Principal, name: str, request: UserChange) -> bool:
    """Return whether the principal is the user to be changed. Raises `ForbiddenProblem` if a change is not allowed."""
    itself = principal.kind == "user" and principal.user_name == name
    if not itself:
        require_administrator(principal, hidden=_no_user(name))
    elif not scopes.allows(principal.scopes, "write"):
        raise ForbiddenProblem(
            "This request needs a token with the scope 'write' for all projects.", code="insufficient-scope"
        )
    if not is_administrator(principal) and (request.administrator is not None or request.disabled is not None):
        raise ForbiddenProblem(
            "Only administrators can disable a user or make a user an administrator.", code="administrators-only"
        )
    return itself


def _values(request: UserChange, password_hash: str | None) -> dict[str, Any]:
    given = request.model_fields_set
    values: dict[str, Any] = {"display_name": request.display_name} if "display_name" in given else {}
    if request.administrator is not None:
        values["administrator"] = request.administrator
    if request.disabled is not None:
        values["disabled"] = request.disabled
    if password_hash is not None:
        values["password_hash"] = password_hash
    return values


def delete_user(tx: Transaction, name: str, *, expected_rev: ExpectedRev) -> None:
    """Disable a user: the name remains on the user's work; tokens and password no longer work."""
    require_administrator(tx.principal)
    change_user(tx, name, UserChange(disabled=True), expected_rev=expected_rev)


def _require_some_administrator(tx: Transaction) -> None:
    left = select(func.count()).where(user.c.administrator.is_(True), user.c.disabled.is_(False))
    if tx.execute(left).scalar_one() == 0:
        raise ConflictProblem(
            "At least one user must be an administrator; make another user an administrator first.",
            code="last-administrator",
        )


# -- signing in -------------------------------------------------------------------------------------------------------


def stored_hash(tx: Transaction, name: str) -> str | None:
    """Return the hash that a password is checked against, or None if no active user with a password has this name."""
    statement = select(user.c.password_hash).where(user.c.name == name, user.c.disabled.is_(False))
    found: str | None = tx.execute(statement).scalar()
    return found


def authenticated(tx: Transaction, name: str, verified_hash: str) -> Principal:
    """Return the principal of a user whose password matched `verified_hash`.

    Raises `UnauthenticatedProblem` if this is not the stored hash any more, or if the user is disabled.
    """
    statement = select(user).where(user.c.name == name, user.c.password_hash == verified_hash)
    row = tx.execute(statement.where(user.c.disabled.is_(False))).first()
    if row is None:
        raise wrong_password()
    return _principal(row)


def active_principal(tx: Transaction, user_id: str) -> Principal:
    """Return the principal of a user whom an identity provider has signed in.

    Raises `ForbiddenProblem` if the user is disabled.
    """
    row = tx.execute(select(user).where(user.c.id == user_id, user.c.disabled.is_(False))).first()
    if row is None:
        raise ForbiddenProblem("Your user is disabled; ask an administrator.", code="user-disabled")
    return _principal(row)


def wrong_password() -> UnauthenticatedProblem:
    """Return the error for a failed sign-in; its text does not show whether the user exists."""
    return UnauthenticatedProblem("The name or the password is wrong.", code="wrong-password")


def _principal(row: Row[Any]) -> Principal:
    return Principal("user", row.id, row.name, row.administrator, _reach(administrator=row.administrator))


def _reach(*, administrator: bool) -> tuple[str, ...]:
    """Return the scopes of a user who has signed in: all, but `admin` only for an administrator."""
    return tuple(scope.value for scope in Scope if scope is not Scope.ADMIN or administrator)


def ensure_first_administrator(tx: Transaction) -> User | None:
    """Create and return the user `admin` if the database has no users; otherwise return None."""
    tx.lock(_ADMINISTRATORS)
    if tx.execute(select(user.c.id).limit(1)).first() is not None:
        return None
    return _insert(tx, FIRST_ADMINISTRATOR, "Administrator", True, None)


def administrator_principal(tx: Transaction, name: str | None = None) -> Principal:
    """Return an administrator by name, or the first one, for callers with direct access to the database.

    Raises `NotFoundProblem` if no active administrator has that name; without a name, one always exists.
    """
    administrators = select(user).where(user.c.administrator.is_(True), user.c.disabled.is_(False))
    if name is not None:
        administrators = administrators.where(user.c.name == name)
    row = tx.execute(administrators.order_by(user.c.id).limit(1)).first()
    if row is None:
        raise _no_user(name or FIRST_ADMINISTRATOR)
    return _principal(row)


def _no_user(name: str) -> NotFoundProblem:
    return NotFoundProblem(f"There is no user {name!r} that you may see.", code="no-user")


def _seen_us(row: Row[Any]) -> int | None:
    return max((one for one in (row.token_used_us, row.identity_used_us) if one is not None), default=None)


def _shown(row: Row[Any], seen: int | None = None) -> User:
    return User(
        id=row.id, name=row.name, display_name=row.display_name, administrator=row.administrator,
        disabled=row.disabled, created_at=datetime_of(row.created_us), rev=row.rev,
        last_seen_at=None if seen is None else datetime_of(seen),
    )  # fmt: skip
