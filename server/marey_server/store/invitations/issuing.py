"""Creation, lists and withdrawal of invitations, by owners of projects and by administrators."""

from __future__ import annotations

from typing import Any

from sqlalchemy import ColumnElement, Row, func, insert, or_, select

from marey_schemas.access import Role
from marey_schemas.invitations import (
    AccountInvitationCreate,
    Invitation,
    InvitationCreate,
    InvitationTerms,
    NewInvitation,
)
from marey_schemas.items import Page
from marey_server.access.roles import require_administrator
from marey_server.access.secret_tokens import issue_invitation
from marey_server.errors import NotFoundProblem, QuotaExceededProblem
from marey_server.store import listing, members, projects
from marey_server.store.database.clock import datetime_of
from marey_server.store.ids import new_id
from marey_server.store.invitations.validity import is_open, is_unspent, withdraw
from marey_server.store.projects import ProjectRow
from marey_server.store.quotas.counting import require_room
from marey_server.store.tables import invitation, project, user
from marey_server.store.transaction import Transaction

_ROWS = (
    select(invitation, project.c.name.label("project"), user.c.name.label("inviter"))
    .select_from(invitation.join(user, user.c.id == invitation.c.inviter_id))
    .outerjoin(project, project.c.id == invitation.c.project_id)
)


def create_invitation(tx: Transaction, project_name: str, request: InvitationCreate) -> NewInvitation:
    """Invite users of the server to a project, and return the code, which is stored only as a hash.

    Raises `QuotaExceededProblem` if the project, or the caller, has too many open invitations.
    """
    return _create(tx, members.lock_project(tx, project_name), request.role, request, creates_account=False)


def create_account_invitation(tx: Transaction, request: AccountInvitationCreate) -> NewInvitation:
    """Invite people to create an account and, if the request names a project, to become members of it.

    Only administrators may do this. Raises `QuotaExceededProblem` as `create_invitation` does.
    """
    require_administrator(tx.principal)
    project_row = None if request.project is None else members.lock_project(tx, request.project)
    return _create(tx, project_row, request.role, request, creates_account=True)


def _create(
    tx: Transaction,
    project_row: ProjectRow | None,
    role: Role | None,
    terms: InvitationTerms,
    *,
    creates_account: bool,
) -> NewInvitation:
    require_room(tx, "user_invitations")
    if project_row is not None:
        _require_free_place(tx, project_row)
    issued = issue_invitation()
    project_id = None if project_row is None else project_row.id
    invitation_id, role_name = new_id("invitation"), None if role is None else role.value
    row = {
        "id": invitation_id, "inviter_id": tx.principal.user_id, "project_id": project_id,
        "role": role_name, "creates_account": creates_account, "prefix": issued.prefix,
        "secret_hash": issued.secret_hash, "note": terms.note, "uses": terms.uses, "used": 0, "created_us": tx.now_us,
        "expires_us": tx.now_us + terms.expires_in_s * 1_000_000,
    }  # fmt: skip
    tx.execute(insert(invitation).values(**row))
    tx.audit(
        "invitation.created", invitation_id, about=issued.prefix, project_id=project_id, role=role_name,
        uses=terms.uses, creates_account=creates_account,
    )  # fmt: skip
    made = tx.execute(_ROWS.where(invitation.c.id == invitation_id)).one()
    return NewInvitation(**_shown(made).model_dump(), code=issued.text)


def _require_free_place(tx: Transaction, project_row: ProjectRow) -> None:
    """Raise an error if the project has too many open invitations; the caller has locked the project."""
    limit = tx.quotas.project_invitations
    counted = select(func.count()).select_from(invitation).where(invitation.c.project_id == project_row.id, is_open(tx))
    used = tx.execute(counted).scalar_one()
    if used >= limit:
        raise QuotaExceededProblem(
            f"The project has {used:,} open invitations, and the limit is {limit:,}. Withdraw one that is not needed "
            f"(`marey member invitations {project_row.name}`), or ask the operator to raise the setting "
            "`project_invitations`.",
            context={"quota": "project_invitations", "used": used, "limit": limit},
        )


def list_invitations(tx: Transaction, project_name: str, *, cursor: str | None, limit: int) -> Page:
    """List the open invitations to a project, oldest first, without their codes."""
    project_row = projects.require(tx, project_name)
    return _page(tx, invitation.c.project_id == project_row.id, project_row.id, cursor, limit)


def list_account_invitations(tx: Transaction, *, cursor: str | None, limit: int) -> Page:
    """List the open invitations that can create accounts, oldest first. Only administrators may do this."""
    require_administrator(tx.principal)
    return _page(tx, invitation.c.creates_account.is_(True), "accounts", cursor, limit)


def _page(tx: Transaction, which: ColumnElement[bool], of: str, cursor: str | None, limit: int) -> Page:
    order = listing.parse_order("id", {"id": invitation.c.id})
    statement = _ROWS.where(which, is_open(tx))
    rows, following = listing.read_page(tx, statement, order, ["invitations", of], cursor, limit)
    return Page(items=tuple(_shown(row) for row in rows), next_cursor=following)


def _shown(row: Row[Any]) -> Invitation:
    return Invitation(
        id=row.id, prefix=row.prefix, project=row.project, role=None if row.role is None else Role(row.role),
        creates_account=row.creates_account, note=row.note, inviter=row.inviter,
        created_at=datetime_of(row.created_us), expires_at=datetime_of(row.expires_us), uses=row.uses,
        uses_left=row.uses - row.used,
    )  # fmt: skip


def withdraw_invitation(tx: Transaction, project_name: str, named: str) -> None:
    """Withdraw an invitation to a project, named by its `id` or its `prefix`.

    Raises `NotFoundProblem` if the project has no such open invitation.
    """
    project_row = projects.require(tx, project_name)
    _withdraw(tx, named, invitation.c.project_id == project_row.id)


def withdraw_account_invitation(tx: Transaction, named: str) -> None:
    """Withdraw an invitation that can create accounts, named by its `id` or its `prefix`.

    Only administrators may do this. Raises `NotFoundProblem` if there is no such invitation.
    """
    require_administrator(tx.principal)
    _withdraw(tx, named, invitation.c.creates_account.is_(True))


def _withdraw(tx: Transaction, named: str, among: ColumnElement[bool]) -> None:
    is_named = or_(invitation.c.id == named, invitation.c.prefix == named)
    row = tx.execute(select(invitation).where(is_named, among, is_unspent(tx)).with_for_update()).first()
    if row is None:
        raise NotFoundProblem(
            f"There is no open invitation {named!r} here; the list of open invitations shows their ids and prefixes.",
            code="no-invitation",
        )
    withdraw(tx, [row])
