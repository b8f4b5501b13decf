"""Projects, and the function that decides what the caller may do in them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from sqlalchemy import (
    BindParameter,
    ColumnElement,
    Row,
    Select,
    and_,
    bindparam,
    exists,
    false,
    insert,
    literal_column,
    or_,
    select,
    true,
)

from marey_schemas.access import (
    EVERY_MEMBER,
    Project,
    ProjectChange,
    ProjectCreate,
    ProjectQuotaChange,
    ProjectQuotasInUse,
    Role,
    Visibility,
)
from marey_schemas.items import Page
from marey_server.access import roles, scopes
from marey_server.access.principal import Principal
from marey_server.access.roles import require_administrator
from marey_server.errors import (
    ConflictProblem,
    ForbiddenProblem,
    NotFoundProblem,
    TooManyRequestsProblem,
    UnauthenticatedProblem,
)
from marey_server.store import listing, rate_limits
from marey_server.store.database.clock import datetime_of
from marey_server.store.database.prepared import Prepared
from marey_server.store.database.violations import taken
from marey_server.store.ids import new_id
from marey_server.store.invitations.validity import withdraw_unauthorised
from marey_server.store.quotas import counting, limits
from marey_server.store.rate_limits import RateLimit, key_of
from marey_server.store.revs import ExpectedRev, change_row
from marey_server.store.tables import folder_role, invitation, member, project, queue_share
from marey_server.store.transaction import Transaction

_HOUR_US = 3600 * 1_000_000

WRITERS = roles.at_least(Role.CONTRIBUTOR)
"""Roles of members who may add items and submit jobs."""

SORT_KEYS: dict[str, ColumnElement[Any]] = {
    "name": project.c.name,
    "created_at": project.c.created_us,
    "updated_at": project.c.updated_us,
    "id": project.c.id,
}


@dataclass(frozen=True, slots=True)
class ProjectRow:
    """Project with the caller's role in it."""

    id: str
    name: str
    title: str | None
    description: str
    visibility: Visibility
    created_us: int
    updated_us: int
    deleted_us: int | None
    rev: int
    most_running: int | None
    role: Role
    guest: bool
    """Whether the caller is not a member and may read because the project is public."""

    def shown(self) -> Project:
        """Return the project as a document."""
        return Project(
            id=self.id, name=self.name, title=self.title, description=self.description, visibility=self.visibility,
            role=None if self.guest else self.role, created_at=datetime_of(self.created_us),
            updated_at=datetime_of(self.updated_us),
            deleted_at=None if self.deleted_us is None else datetime_of(self.deleted_us),
            most_running_jobs=None if self.guest else self.most_running, rev=self.rev,
        )  # fmt: skip


# -- who may do what --------------------------------------------------------------------------------------------------


def require(
    tx: Transaction,
    name: str,
    *,
    at_least: Role = Role.READER,
    deleted: bool = False,
) -> ProjectRow:
    """Return the project `name` if the caller has the role and the scope that the transaction's operation declares.

    The declaration is `tx.required_role`. If `at_least` is higher than the declared role, it is required instead. With
    `deleted`, the function looks for the project of this name that was deleted last. If the operation declares
    `in_folders`, the role in a single folder suffices; the result nevertheless contains the role in the project.

    Raises `NotFoundProblem` if the caller may not know that the project exists. Raises `ForbiddenProblem` if the caller
    lacks the role or the scope. An anonymous caller gets `UnauthenticatedProblem` instead of `ForbiddenProblem`,
    because signing in may help.
    """
    required = tx.required_role
    need = at_least if roles.includes(at_least, required.role) else required.role
    me = tx.principal.user_id or ""
    who = {"name": name, "me": me}
    row = tx.execute(_DELETED_BY_NAME, who).one_or_none() if deleted else tx.first(_ALIVE_BY_NAME, who)
    seen = None if row is None else _as_seen(tx.principal, row)
    if seen is None or (seen.guest and deleted):
        raise _unknown(name)
    enough = roles.includes(seen.role, need) or (required.in_folders and _has_role_in_a_folder(tx, seen, need))
    if not enough or (seen.guest and not required.guests):
        if tx.principal.kind == "anonymous":
            raise UnauthenticatedProblem(f"Sign in to do this in the project {name!r}.")
        raise ForbiddenProblem(
            f"You need at least the role {need.value} in the project {name!r} for this.", code="insufficient-role"
        )
    if not seen.guest:
        require_scope(tx, name, required.scope)
    return seen


def _unknown(name: str) -> NotFoundProblem:
    return NotFoundProblem(
        f"There is no project {name!r} that you may see.", code="no-project", context={"project": name}
    )


def _has_role_in_a_folder(tx: Transaction, seen: ProjectRow, need: Role) -> bool:
    if seen.guest or tx.principal.user_id is None:
        return False
    condition = has_role_in_folders(seen.id, tx.principal.user_id, need)
    return tx.execute(select(literal_column("1")).where(condition)).first() is not None


def has_role_in_folders(
    project_id: str | ColumnElement[Any], user_id: str | ColumnElement[Any] | None, need: Role
) -> ColumnElement[bool]:
    """Return the SQL condition that a member of a project has at least the role `need` in one of its folders."""
    mine = or_(folder_role.c.user_id == user_id, folder_role.c.user_id == EVERY_MEMBER)
    enough = folder_role.c.role.in_(roles.at_least(need))
    of_project = folder_role.c.project_id == project_id
    return exists().where(of_project, mine, enough).correlate_except(folder_role)


def require_scope(tx: Transaction, name: str, scope: str) -> None:
    """Raise `ForbiddenProblem` if the token of the caller does not have a scope in the project `name`."""
    if not scopes.allows(tx.principal.scopes, scope, name):
        raise ForbiddenProblem(
            f"This request needs a token with the scope {scope!r} in the project {name!r}.", code="insufficient-scope"
        )


def find_by_id(tx: Transaction, project_id: str) -> ProjectRow:
    """Return a project, even a deleted one, without checking rights; only for internal work of the server."""
    row = tx.execute(_with_role_of(tx.principal.user_id or "").where(project.c.id == project_id)).one()
    return _row(row, Role.READER, row.most_running, guest=False)


def _with_role_of(user_id: str | BindParameter[str]) -> Select[*tuple[Any, ...]]:
    mine = and_(member.c.project_id == project.c.id, member.c.user_id == user_id)
    shares = project.outerjoin(member, mine).outerjoin(queue_share, queue_share.c.project_id == project.c.id)
    return select(project, member.c.role, queue_share.c.most_running).select_from(shares)


# Almost every request runs `_ALIVE_BY_NAME`.
_BY_NAME = _with_role_of(bindparam("me")).where(project.c.name == bindparam("name"))
_ALIVE_BY_NAME = Prepared(_BY_NAME.where(project.c.deleted_us.is_(None)))
_DELETED_BY_NAME = (
    _BY_NAME.where(project.c.deleted_us.is_not(None)).order_by(project.c.deleted_us.desc()).limit(literal_column("1"))
)


def _as_seen(principal: Principal, row: Row[Any]) -> ProjectRow | None:
    """Return the project with the caller's role in it; None if the caller may not know that it exists."""
    if principal.kind == "attempt":
        return _row(row, Role.READER, row.most_running, guest=False) if principal.project_id == row.id else None
    if any(scope.partition("!project=")[2] in ("", row.name) for scope in principal.scopes):
        role = Role.OWNER if principal.administrator else row.role
        if role is not None:
            return _row(row, Role(role), row.most_running, guest=False)
    return _row(row, Role.READER, row.most_running, guest=True) if row.visibility == Visibility.PUBLIC else None


def _row(row: Row[Any], role: Role, most_running: int | None, *, guest: bool) -> ProjectRow:
    return ProjectRow(
        row.id, row.name, row.title, row.description, Visibility(row.visibility),
        row.created_us, row.updated_us, row.deleted_us, row.rev, most_running, role, guest,
    )  # fmt: skip


def is_visible(principal: Principal) -> ColumnElement[bool]:
    """Return the SQL condition for the projects that are not deleted and that the caller may read.

    If the caller is an attempt of a job, the condition is always false.
    """
    alive = project.c.deleted_us.is_(None)
    if principal.kind == "attempt":
        return false()
    own: ColumnElement[bool] = true()
    if not principal.administrator:
        own = project.c.id.in_(select(member.c.project_id).where(member.c.user_id == (principal.user_id or "")))
    if not scopes.allows(principal.scopes, "read"):
        names = [scope.partition("!project=")[2] for scope in principal.scopes if scope.startswith("read!")]
        own = and_(own, project.c.name.in_(names)) if names else false()
    return and_(alive, or_(own, project.c.visibility == Visibility.PUBLIC.value))


def writable_projects(tx: Transaction, names: Iterable[str]) -> list[str]:
    """Return the ids of those named projects in which the caller, as a user, has a role that may write.

    A role in one folder suffices.
    """
    statement = select(project.c.id).where(project.c.name.in_(list(names)), project.c.deleted_us.is_(None))
    if not tx.principal.administrator:
        me = tx.principal.user_id
        in_folder = has_role_in_folders(project.c.id, me, Role.CONTRIBUTOR)
        statement = statement.join(member, member.c.project_id == project.c.id)
        statement = statement.where(member.c.user_id == me, or_(member.c.role.in_(WRITERS), in_folder))
    return list(tx.execute(statement.order_by(project.c.id)).scalars())


# -- reading ----------------------------------------------------------------------------------------------------------


def read_project(tx: Transaction, name: str) -> Project:
    """Return the project of this name, with the caller's role in it."""
    return require(tx, name).shown()


def list_projects(
    tx: Transaction, *, sort: str = "name", cursor: str | None = None, limit: int = listing.DEFAULT_LIMIT
) -> Page:
    """Return a page of the projects that the caller may read."""
    order = listing.parse_order(sort, SORT_KEYS)
    identity = ["projects", tx.principal.user_id]
    statement = _with_role_of(tx.principal.user_id or "").where(is_visible(tx.principal))
    rows, next_cursor = listing.read_page(tx, statement, order, identity, cursor, limit)
    seen = (_as_seen(tx.principal, row) for row in rows)
    return Page(items=tuple(one.shown() for one in seen if one is not None), next_cursor=next_cursor)


def read_quotas(tx: Transaction, name: str) -> ProjectQuotasInUse:
    """Return how many items, bytes and running jobs a project has, and how many it may have."""
    return limits.show_project_quotas(tx, require(tx, name).id)


# -- changing ---------------------------------------------------------------------------------------------------------


def meets_hidden(tx: Transaction, name: str, guesses_per_hour: int) -> bool:
    """Return whether a project of this name exists that the caller may not see.

    Raises `TooManyRequestsProblem`, whatever the name, if the caller has tried too many names of hidden projects.
    """
    if wait_s := rate_limits.wait_s(tx, _guess_limit(tx, guesses_per_hour)):
        raise _too_many_guesses(wait_s)
    row = tx.first(_ALIVE_BY_NAME, {"name": name, "me": tx.principal.user_id or ""})
    return row is not None and _as_seen(tx.principal, row) is None


def require_known(tx: Transaction, names: Iterable[str]) -> None:
    """Raise `NotFoundProblem` for the first of some projects that does not exist, or that the caller may not know."""
    for name in names:
        row = tx.first(_ALIVE_BY_NAME, {"name": name, "me": tx.principal.user_id or ""})
        if row is None or _as_seen(tx.principal, row) is None:
            raise _unknown(name)


def count_guess(tx: Transaction, guesses_per_hour: int) -> None:
    """Count that the caller has tried to use the name of a hidden project, perhaps to find out whether it exists.

    Raises `TooManyRequestsProblem` if the caller has tried too many of these names.
    """
    if wait_s := rate_limits.count(tx, _guess_limit(tx, guesses_per_hour)):
        raise _too_many_guesses(wait_s)


def _guess_limit(tx: Transaction, per_hour: int) -> RateLimit:
    return RateLimit(key_of("project-names", tx.principal.user_id or ""), per_hour, _HOUR_US // per_hour)


def _too_many_guesses(wait_s: int) -> TooManyRequestsProblem:
    return TooManyRequestsProblem(
        "You have tried too many project names that are taken by projects that you may not see; try again in "
        f"{wait_s} s.",
        code="too-many-names",
        context={"wait_s": wait_s},
        headers={"Retry-After": str(wait_s)},
    )


def create_project(tx: Transaction, request: ProjectCreate) -> Project:
    """Create a project owned by the caller.

    Raises `ConflictProblem` if the name is used, and `QuotaExceededProblem` if the caller owns too many projects.
    """
    principal = tx.principal
    if principal.kind == "anonymous":
        raise UnauthenticatedProblem("Sign in to create a project.")
    if principal.kind == "attempt" or not scopes.allows(principal.scopes, "write", request.name):
        raise ForbiddenProblem(
            "This request needs a user's token with the scope 'write' for all projects, or for the project "
            f"{request.name!r}.",
            code="insufficient-scope",
        )
    counting.require_room(tx, "user_projects")
    made = ProjectRow(
        new_id("project"), request.name, request.title, request.description, request.visibility,
        tx.now_us, tx.now_us, None, 1, None, Role.OWNER, False,
    )  # fmt: skip
    values = {
        "id": made.id, "name": made.name, "title": made.title, "description": made.description,
        "visibility": made.visibility.value, "created_us": made.created_us, "updated_us": made.updated_us,
    }  # fmt: skip
    with taken(_name_taken(request.name)):
        tx.execute(insert(project), values)
    if principal.user_id is not None:
        owner = {"project_id": made.id, "user_id": principal.user_id, "role": Role.OWNER.value, "since_us": tx.now_us}
        tx.execute(insert(member), owner)
    visibility = made.visibility.value
    tx.audit("project.created", made.id, about=made.name, project_id=made.id, name=made.name, visibility=visibility)
    return made.shown()


def _name_taken(name: str) -> ConflictProblem:
    return ConflictProblem(f"The name {name!r} is taken by another project; choose another name.", code="name-taken")


def change_project(tx: Transaction, name: str, request: ProjectChange, *, expected_rev: ExpectedRev) -> Project:
    """Change the title, description or visibility of a project."""
    seen = require(tx, name)
    values = {field: getattr(request, field) for field in request.model_fields_set}
    if values.get("visibility") is not None:
        values["visibility"] = request.visibility.value if request.visibility else None
    values = {key: value for key, value in values.items() if value is not None or key == "title"}
    changed = _change(tx, seen, values, expected_rev, project.c.deleted_us.is_(None))
    access = {"visibility": values["visibility"]} if "visibility" in values else {}
    tx.audit("project.changed", seen.id, about=name, project_id=seen.id, fields=sorted(values), **access)
    return changed


def delete_project(tx: Transaction, name: str, *, expected_rev: ExpectedRev) -> None:
    """Hide a project and everything in it, and withdraw its invitations; an owner can restore the project."""
    seen = require(tx, name)
    _change(tx, seen, {"deleted_us": tx.now_us}, expected_rev, project.c.deleted_us.is_(None))
    withdraw_unauthorised(tx, invitation.c.project_id == seen.id)
    tx.audit("project.deleted", seen.id, about=name, project_id=seen.id, name=name)


def restore_project(tx: Transaction, name: str, *, expected_rev: ExpectedRev = None) -> Project:
    """Restore the project of this name that was deleted last.

    Raises `ConflictProblem` if another project has the name now, and `QuotaExceededProblem` if the caller would own too
    many projects.
    """
    seen = require(tx, name, deleted=True)
    own = member.c.project_id == seen.id, member.c.user_id == tx.principal.user_id, member.c.role == Role.OWNER.value
    if tx.execute(select(member.c.project_id).where(*own)).first() is not None:
        counting.require_room(tx, "user_projects")
    with taken(_name_taken(name)):
        restored = _change(tx, seen, {"deleted_us": None}, expected_rev, project.c.deleted_us.is_not(None))
    tx.audit("project.restored", seen.id, about=name, project_id=seen.id, name=name)
    return restored


def change_quotas(tx: Transaction, name: str, change: ProjectQuotaChange) -> ProjectQuotasInUse:
    """Change the quotas of a project, and return all of them and their use. Only administrators may do this."""
    require_administrator(tx.principal)
    found = tx.execute(select(project.c.id).where(project.c.name == name, project.c.deleted_us.is_(None))).scalar()
    if found is None:
        raise NotFoundProblem(f"There is no project {name!r}.", code="no-project")
    return limits.change_project_limits(tx, found, name, change)


def _change(
    tx: Transaction, seen: ProjectRow, values: dict[str, Any], expected_rev: ExpectedRev, state: ColumnElement[bool]
) -> Project:
    row = change_row(
        tx, project, (project.c.id == seen.id, state), {**values, "updated_us": tx.now_us},
        expected_rev=expected_rev, absent=NotFoundProblem(f"There is no project {seen.name!r}.", code="no-project"),
    )  # fmt: skip
    return _row(row, seen.role, seen.most_running, guest=False).shown()
