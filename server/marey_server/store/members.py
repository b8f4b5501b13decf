"""Members of projects and their roles. A project always has at least one owner."""

from __future__ import annotations

from typing import Any

from sqlalchemy import Row, delete, func, select

from marey_schemas.access import Member, MemberChange, Role
from marey_schemas.items import Page
from marey_server.errors import ConflictProblem, NotFoundProblem, PreconditionFailedProblem
from marey_server.store import listing, projects
from marey_server.store.database.clock import datetime_of
from marey_server.store.folder_roles.rights import lock_places
from marey_server.store.invitations.validity import withdraw_unauthorised
from marey_server.store.projects import ProjectRow
from marey_server.store.revs import ExpectedRev, at_rev, change_row, moved_on
from marey_server.store.tables import folder_role, invitation, member, project, user
from marey_server.store.transaction import Transaction


def list_members(
    tx: Transaction, project_name: str, *, cursor: str | None = None, limit: int = listing.DEFAULT_LIMIT
) -> Page:
    """List the members of a project in the order of their names. Guests of a public project may not see them."""
    project_row = projects.require(tx, project_name)
    statement = select(user.c.name, member).join(user, user.c.id == member.c.user_id)
    statement = statement.where(member.c.project_id == project_row.id)
    order = listing.parse_order("name", {"name": user.c.name}, unique="name")
    rows, next_cursor = listing.read_page(tx, statement, order, ["members", project_row.id], cursor, limit)
    return Page(items=tuple(_shown(row.name, row) for row in rows), next_cursor=next_cursor)


def read_member(tx: Transaction, project_name: str, user_name: str) -> Member:
    """Return one member of a project. Raises `NotFoundProblem` if the user is no member."""
    project_row = projects.require(tx, project_name)
    statement = select(user.c.name, member).join(user, user.c.id == member.c.user_id)
    row = tx.execute(statement.where(member.c.project_id == project_row.id, user.c.name == user_name)).first()
    if row is None:
        raise _no_member(user_name)
    return _shown(row.name, row)


def put_member(
    tx: Transaction,
    project_name: str,
    user_name: str,
    request: MemberChange,
    *,
    expected_rev: ExpectedRev = None,
    absent: bool = False,
) -> Member:
    """Add a member, or change the member's role; withdraw invitations that the member may no longer issue.

    Raises `NotFoundProblem` if there is no such user or the user is disabled, and `ConflictProblem` if the project
    would lose its last owner. With `expected_rev`, the user must be a member already. With `absent`, raises
    `PreconditionFailedProblem` if the user is a member already.
    """
    project_row = lock_project(tx, project_name)
    lock_places(tx, project_row)
    user_id = tx.execute(select(user.c.id).where(user.c.name == user_name, user.c.disabled.is_(False))).scalar()
    if user_id is None:
        raise NotFoundProblem(f"There is no user {user_name!r}.", code="no-user")
    changed = write_role(
        tx, project_row.id, user_id, user_name, request.role, expected_rev=expected_rev, absent=absent
    )  # fmt: skip
    _require_owner(tx, project_row)
    _withdraw_invitations(tx, project_row, user_name)
    return _shown(user_name, changed)


def write_role(
    tx: Transaction,
    project_id: str,
    user_id: str,
    user_name: str,
    role: Role,
    *,
    expected_rev: ExpectedRev = None,
    absent: bool = False,
) -> Row[Any]:
    """Add a member, or change the member's role, without a check of rights; return the row.

    A member who becomes an owner loses all roles in folders. With `absent`, raises `PreconditionFailedProblem` if the
    user is a member already. The caller must have locked the project.
    """
    which = (member.c.project_id == project_id, member.c.user_id == user_id)
    row = {"project_id": project_id, "user_id": user_id, "role": role.value, "since_us": tx.now_us}
    was = tx.execute(select(member.c.role).where(*which)).scalar()
    added = None
    if expected_rev is None:
        added = tx.execute(tx.insert_or_ignore(member, row).returning(*member.c)).first()
        if added is None and absent:
            raise PreconditionFailedProblem(
                f"The user {user_name!r} is already a member of the project.", code="member-exists"
            )
    changed = added or change_row(
        tx, member, which, {"role": role.value}, expected_rev=expected_rev, absent=_no_member(user_name)
    )
    if role is Role.OWNER:
        _forget_folder_roles(tx, project_id, user_name)
    details = {"user": user_name, "role": role.value}
    if added is not None:
        tx.audit("member.added", project_id, about=user_name, project_id=project_id, **details)
    else:
        tx.audit("member.changed", project_id, about=user_name, project_id=project_id, was=was, **details)
    return changed


def find_role(tx: Transaction, project_id: str, user_id: str) -> Role | None:
    """Return the role of a user in a project, or None if the user is no member. Does not check rights."""
    which = member.c.project_id == project_id, member.c.user_id == user_id
    role = tx.execute(select(member.c.role).where(*which)).scalar()
    return None if role is None else Role(role)


def remove_member(tx: Transaction, project_name: str, user_name: str, *, expected_rev: ExpectedRev) -> None:
    """Remove a member and the member's roles in folders; withdraw the invitations that the user may no longer issue.

    Raises `NotFoundProblem` if the user is no member, and `ConflictProblem` if the project would lose its last owner.
    """
    project_row = lock_project(tx, project_name)
    lock_places(tx, project_row)
    which = (
        member.c.project_id == project_row.id,
        member.c.user_id.in_(select(user.c.id).where(user.c.name == user_name)),
    )
    was = tx.execute(delete(member).where(*which, at_rev(member.c.rev, expected_rev)).returning(member.c.role)).scalar()
    if was is None:
        current = tx.execute(select(member.c.rev).where(*which)).scalar()
        raise _no_member(user_name) if current is None else moved_on(current)
    _require_owner(tx, project_row)
    _forget_folder_roles(tx, project_row.id, user_name)
    tx.audit("member.removed", project_row.id, about=user_name, project_id=project_row.id, user=user_name, was=was)
    _withdraw_invitations(tx, project_row, user_name)


def _forget_folder_roles(tx: Transaction, project_id: str, user_name: str) -> None:
    mine = folder_role.c.user_id.in_(select(user.c.id).where(user.c.name == user_name))
    tx.execute(delete(folder_role).where(folder_role.c.project_id == project_id, mine))


def _withdraw_invitations(tx: Transaction, project_row: ProjectRow, user_name: str) -> None:
    """Withdraw the invitations of a user to a project if the user may no longer invite others to it."""
    invited = invitation.c.inviter_id.in_(select(user.c.id).where(user.c.name == user_name))
    withdraw_unauthorised(tx, invitation.c.project_id == project_row.id, invited)


def lock_project(tx: Transaction, project_name: str) -> ProjectRow:
    """Return a project after locking its row, so that two owners cannot remove each other at the same time.

    Every change of the members of a project locks this row first.
    """
    project_row = projects.require(tx, project_name)
    tx.execute(select(project.c.id).where(project.c.id == project_row.id).with_for_update(key_share=True))
    return projects.require(tx, project_name)  # the one before may have ended the caller's role


def _require_owner(tx: Transaction, project_row: ProjectRow) -> None:
    owners = select(func.count()).where(member.c.project_id == project_row.id, member.c.role == Role.OWNER.value)
    if tx.execute(owners).scalar_one() == 0:
        raise ConflictProblem(
            "A project needs at least one owner; make another member an owner first.", code="last-owner"
        )


def _no_member(user_name: str) -> NotFoundProblem:
    return NotFoundProblem(f"{user_name!r} is no member of this project.", code="no-member")


def _shown(name: str, row: Row[Any]) -> Member:
    return Member(user=name, role=Role(row.role), since=datetime_of(row.since_us), rev=row.rev)
