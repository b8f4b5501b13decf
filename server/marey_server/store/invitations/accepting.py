"""Acceptance of invitations: by users, who become members of a project, and by people who create an account.

Each acceptance locks the project and the invitation, in this order, before it checks anything. So another change is
either complete before the acceptance, or waits until the acceptance has ended. Such changes are the last use of the
invitation, other changes of the members, and a change that ends the inviter's right to invite.
"""

from __future__ import annotations

from typing import Any

from sqlalchemy import Row, insert, select, update

from marey_schemas.access import Role
from marey_schemas.invitations import AcceptedInvitation, SignedUp, SignUp
from marey_server.access import scopes
from marey_server.access.roles import includes
from marey_server.access.secret_tokens import hash_secret, secret_matches, split_invitation
from marey_server.errors import ForbiddenProblem, NotFoundProblem
from marey_server.store import members, users
from marey_server.store.credentials import sign_ins, tokens
from marey_server.store.credentials.sign_ins import SignInTry
from marey_server.store.invitations.validity import is_open
from marey_server.store.tables import invitation, invitation_use, project, user
from marey_server.store.transaction import Transaction

_NO_HASH = hash_secret("")  # of no code, because secrets are not empty


def invitation_invalid() -> NotFoundProblem:
    """Return the error for a code that is not valid; its text does not show why."""
    return NotFoundProblem(
        "This invitation code is not valid for this request: it is unknown or incomplete, or the invitation was used, "
        "was withdrawn or has expired. Check that you copied the whole code, or ask for a new invitation.",
        code="invitation-invalid",
    )


def try_of(code: str, address: str, per_minute: int) -> SignInTry:
    """Return the sign-in try for an invitation code; the caller must count the try before checking the code."""
    prefix, _ = split_invitation(code) or ("", "")
    return SignInTry(f"invitation {prefix}", address, per_minute)


def _find(tx: Transaction, code: str) -> Row[Any]:
    """Return the invitation with a code, even if nobody can use the invitation any more.

    An unknown code takes as long as a known one, so that the time does not show which codes exist. Raises
    `NotFoundProblem` if the code is wrong.
    """
    prefix, secret = split_invitation(code) or ("", "")
    statement = select(invitation, project.c.name.label("project"), project.c.deleted_us, is_open(tx).label("open"))
    statement = statement.select_from(invitation.outerjoin(project, project.c.id == invitation.c.project_id))
    row = tx.execute(statement.where(invitation.c.prefix == prefix)).first()
    if not secret_matches(secret, _NO_HASH if row is None else row.secret_hash) or row is None:
        raise invitation_invalid()
    return row


def _lock(tx: Transaction, code: str) -> Row[Any]:
    """Find the invitation with a code, lock its project and then the invitation, and return its row."""
    found = _find(tx, code)
    tx.execute(select(project.c.id).where(project.c.id == found.project_id).with_for_update(key_share=True))
    tx.execute(select(invitation.c.id).where(invitation.c.id == found.id).with_for_update())
    return _find(tx, code)


def _has_used(tx: Transaction, row: Row[Any], user_id: str | None) -> bool:
    which = invitation_use.c.invitation_id == row.id, invitation_use.c.user_id == user_id
    return tx.execute(select(invitation_use.c.user_id).where(*which)).first() is not None


def accept_invitation(tx: Transaction, code: str, attempt: SignInTry) -> AcceptedInvitation:
    """Give the caller the role of an invitation, and count one use of the invitation.

    If the caller has the same or a higher role, nothing changes and the invitation is not used. A repeated request gets
    the same answer. Nobody can use an invitation twice, for example after being removed from the project. Raises
    `NotFoundProblem` for a code that is not valid, whatever the reason.
    """
    user_id, user_name = _require_user(tx)
    row = _lock(tx, code)
    if row.project_id is None:
        raise invitation_invalid()
    present, role = members.find_role(tx, row.project_id, user_id), Role(row.role)
    used_before = _has_used(tx, row, user_id)
    if used_before and present is not None and row.deleted_us is None:
        role = present
    elif used_before or not row.open:
        raise invitation_invalid()
    elif present is not None and includes(present, role):
        sign_ins.uncount(tx, attempt)
        return AcceptedInvitation(project=row.project, role=present, joined=False)
    else:
        _use(tx, row, user_id, user_name)
    sign_ins.uncount(tx, attempt)
    return AcceptedInvitation(project=row.project, role=role, joined=True)


def _require_user(tx: Transaction) -> tuple[str, str]:
    """Return the id and name of the caller, whose token must have the scope `write` for all projects."""
    principal = tx.principal
    if principal.user_id is None or principal.user_name is None:
        raise ForbiddenProblem("Only users can accept invitations.", code="users-only")
    if not scopes.allows(principal.scopes, "write"):
        raise ForbiddenProblem(
            "This request needs a token with the scope 'write' for all projects.", code="insufficient-scope"
        )
    return principal.user_id, principal.user_name


def _use(tx: Transaction, row: Row[Any], user_id: str, user_name: str) -> None:
    """Count one use of a locked invitation by a user, and give the user the role that the invitation offers."""
    tx.execute(update(invitation).where(invitation.c.id == row.id).values(used=invitation.c.used + 1))
    tx.execute(insert(invitation_use).values(invitation_id=row.id, user_id=user_id))
    if row.project_id is not None:
        members.write_role(tx, row.project_id, user_id, user_name, Role(row.role))
    tx.audit(
        "invitation.accepted", row.id, about=row.prefix, project_id=row.project_id, user=user_name, role=row.role
    )  # fmt: skip


# -- accounts ----------------------------------------------------------------------------------------------------------


def needs_password_check(tx: Transaction, code: str, name: str) -> bool:
    """Return whether a request to sign up as `name` must check the password and call `sign_up_again`, not `sign_up`.

    The result is true if the user `name` has used the code. It is also true, for every name, if the code cannot create
    an account, for example because it is used up. So the answer to a used code does not show who has used it. Raises
    `NotFoundProblem` if the code is wrong.
    """
    row = _find(tx, code)
    user_id = tx.execute(select(user.c.id).where(user.c.name == name)).scalar()
    used = user_id is not None and _has_used(tx, row, user_id)
    return used or not row.creates_account or not row.open


def _require_open_for_accounts(row: Row[Any]) -> None:
    if not row.creates_account or not row.open:
        raise invitation_invalid()


def sign_up(tx: Transaction, request: SignUp, password_hash: str, attempt: SignInTry) -> SignedUp:
    """Create an account with the invitation of an administrator, and return the token of a sign-in.

    If the invitation names a project, the user joins the project. Raises `NotFoundProblem` if the code cannot create an
    account, and `ConflictProblem` if the name is taken.
    """
    row = _lock(tx, request.code.get_secret_value())
    _require_open_for_accounts(row)
    tx.principal = users.sign_up(tx, request.name, request.display_name, password_hash)
    _use(tx, row, str(tx.principal.user_id), request.name)
    return _signed_up(tx, row, request, attempt)


def sign_up_again(
    tx: Transaction, request: SignUp, verified_hash: str | None, login: SignInTry, attempt: SignInTry
) -> SignedUp:
    """Return a new token for a user who repeats `sign_up` with the same code and password.

    `verified_hash` is the hash that the password matched, or None if it did not match. `login` is the counted try of
    the password, and `attempt` the counted try of the code. Raises `NotFoundProblem` if the password did not match, or
    if the user has not used the code. So the answer does not show who has used the code.
    """
    row = _find(tx, request.code.get_secret_value())
    if verified_hash is None:
        raise invitation_invalid()
    tx.principal = users.authenticated(tx, request.name, verified_hash)
    if not _has_used(tx, row, tx.principal.user_id):
        raise invitation_invalid()
    sign_ins.record_success(tx, login)
    return _signed_up(tx, row, request, attempt)


def _signed_up(tx: Transaction, row: Row[Any], request: SignUp, attempt: SignInTry) -> SignedUp:
    sign_ins.uncount(tx, attempt)
    role = None if row.project_id is None else members.find_role(tx, row.project_id, str(tx.principal.user_id))
    made = tokens.create_session(tx, request.expires_in_s)
    return SignedUp(**made.model_dump(), project=None if role is None else row.project, role=role)
