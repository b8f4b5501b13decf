"""Projects, and the one function that decides who may do what in them."""

from __future__ import annotations

from dataclasses import dataclass

from sqlalchemy import ColumnElement, and_, false, or_, select, true

from marey_schemas.access import Role, Visibility
from marey_server.access import roles, scopes
from marey_server.access.principal import Principal
from marey_server.errors import Forbidden, NotFound, Unauthenticated
from marey_server.store.database import Transaction
from marey_server.store.tables import member, project


@dataclass(frozen=True, slots=True)
class ProjectRow:
    """A project, and what the caller is in it."""

    id: str
    name: str
    title: str | None
    description: str
    visibility: Visibility
    created_us: int
    updated_us: int
    deleted_us: int | None
    rev: int
    role: Role
    guest: bool
    """The caller is no member and reads because the project is public."""


def require(
    tx: Transaction,
    name: str,
    need: Role = Role.READER,
    scope: str = "read",
    *,
    public: bool = True,
    deleted: bool = False,
) -> ProjectRow:
    """The project `name`, if the caller has the role `need` there and a credential that reaches `scope`.

    `public=False`: guests of a public project may not. `deleted=True`: look among deleted projects.
    Raises `NotFound` where the caller may not know the project, `Forbidden` where he may not do this in it,
    `Unauthenticated` where signing in could help.
    """
    columns = [column for column in project.c if column is not project.c.visibility]
    mine = and_(member.c.project_id == project.c.id, member.c.user_id == (tx.principal.user_id or ""))
    statement = (
        select(*columns, project.c.visibility, member.c.role)
        .select_from(project.outerjoin(member, mine))
        .where(project.c.name == name, project.c.deleted_us.is_not(None) if deleted else project.c.deleted_us.is_(None))
        .order_by(project.c.deleted_us.desc())
    )
    row = tx.execute(statement).first()
    role, guest = (None, False) if row is None else _role_in(tx.principal, row.id, row.name, row.visibility, row.role)
    if row is None or role is None or (guest and deleted):
        raise NotFound(f"There is no project {name!r} that you may see.", code="no-project")
    if not roles.includes(role, need) or (guest and not public):
        _refuse(tx.principal, name, need)
    if not guest and not scopes.allows(tx.principal.scopes, scope, name):
        raise Forbidden(f"This token does not reach {scope!r} in {name!r}.", code="insufficient-scope")
    return ProjectRow(
        row.id, row.name, row.title, row.description, Visibility(row.visibility),
        row.created_us, row.updated_us, row.deleted_us, row.rev, role, guest,
    )  # fmt: skip


def find_by_id(tx: Transaction, project_id: str) -> ProjectRow:
    """The project of a job, for what the queue does for the job's author, who was authorised at submission."""
    row = tx.execute(select(project).where(project.c.id == project_id)).one()
    return ProjectRow(
        row.id, row.name, row.title, row.description, Visibility(row.visibility),
        row.created_us, row.updated_us, row.deleted_us, row.rev, Role.CONTRIBUTOR, False,
    )  # fmt: skip


def _refuse(principal: Principal, name: str, need: Role) -> None:
    if principal.kind == "anonymous":
        raise Unauthenticated(f"Sign in to do this in {name!r}.")
    raise Forbidden(f"This needs the role {need.value} in {name!r}.", code="insufficient-role")


def _role_in(
    principal: Principal, project_id: str, name: str, visibility: str, role: str | None
) -> tuple[Role | None, bool]:
    """The caller's role, and whether only as a guest."""
    is_public = visibility == Visibility.PUBLIC
    if principal.kind == "attempt":
        return (Role.READER, False) if principal.project_id == project_id else (None, False)
    if _reaches(principal, name):
        if principal.administrator:
            return Role.OWNER, False
        if role is not None:
            return Role(role), False
    return (Role.READER, True) if is_public else (None, False)


def _reaches(principal: Principal, name: str) -> bool:
    """Whether any scope of the credential is about this project."""
    return any(scope.partition("!project=")[2] in ("", name) for scope in principal.scopes)


def is_visible(principal: Principal) -> ColumnElement[bool]:
    """Condition on `project` rows: alive, and readable by the caller."""
    alive = project.c.deleted_us.is_(None)
    if principal.kind == "attempt":
        return and_(alive, project.c.id == (principal.project_id or ""))
    own: ColumnElement[bool] = (
        true()
        if principal.administrator
        else project.c.id.in_(select(member.c.project_id).where(member.c.user_id == (principal.user_id or "")))
    )
    if not scopes.allows(principal.scopes, "read"):
        names = [scope.partition("!project=")[2] for scope in principal.scopes if scope.startswith("read!")]
        own = and_(own, project.c.name.in_(names)) if names else false()
    return and_(alive, or_(own, project.c.visibility == Visibility.PUBLIC.value))
