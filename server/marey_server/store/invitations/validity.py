"""Conditions under which an invitation is valid, and deletion of invitations.

An invitation gives no more than its inviter may give. It is valid while the inviter is an active user who owns the
project or is an administrator. Only administrators can invite people to create an account. A change that takes this
right from a user deletes the user's invitations in the same transaction. Every acceptance checks the conditions again.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

from sqlalchemy import ColumnElement, Row, and_, delete, exists, or_, select

from marey_schemas.access import Role
from marey_server.store.tables import invitation, invitation_use, member, project, user
from marey_server.store.transaction import Transaction

DELETED_AT_ONCE = 500
"""Greatest number of expired invitations that are deleted in one transaction."""


def _exists(*which: ColumnElement[bool]) -> ColumnElement[bool]:
    """Return the SQL condition EXISTS for rows that meet all conditions in `which`.

    The conditions may also use columns of the invitation in the surrounding query.
    """
    return exists().where(*which).correlate(invitation)


_OWNS = _exists(
    member.c.project_id == invitation.c.project_id,
    member.c.user_id == invitation.c.inviter_id,
    member.c.role == Role.OWNER.value,
)
_ACTIVE = and_(user.c.id == invitation.c.inviter_id, user.c.disabled.is_(False))
_ALIVE = _exists(project.c.id == invitation.c.project_id, project.c.deleted_us.is_(None))

IN_FORCE = and_(
    or_(
        _exists(_ACTIVE, user.c.administrator.is_(True)),
        and_(invitation.c.creates_account.is_(False), _exists(_ACTIVE), _OWNS),
    ),
    or_(invitation.c.project_id.is_(None), _ALIVE),
)
"""Condition that the inviter may still invite, and that the project was not deleted."""


def is_unspent(tx: Transaction) -> ColumnElement[bool]:
    """Return the SQL condition for invitations that are neither used up nor expired."""
    return and_(invitation.c.used < invitation.c.uses, invitation.c.expires_us > tx.now_us)


def is_open(tx: Transaction) -> ColumnElement[bool]:
    """Return the SQL condition for invitations that somebody can still use."""
    return and_(is_unspent(tx), IN_FORCE)


def withdraw_unauthorised(tx: Transaction, *which: ColumnElement[bool]) -> None:
    """Withdraw the invitations that meet `which` and whose inviter may no longer invite, after a change of rights.

    Invitations to deleted projects are withdrawn, too; those that are used up or expired are left as they are.
    """
    withdraw(tx, tx.execute(_locked(*which, is_unspent(tx), ~IN_FORCE)).all())


def withdraw(tx: Transaction, rows: Sequence[Row[Any]]) -> None:
    """Delete invitations, so that their codes are no longer valid, and record an event for each of them."""
    _delete(tx, [row.id for row in rows])
    for row in rows:
        tx.audit("invitation.withdrawn", row.id, about=row.prefix, project_id=row.project_id)


def delete_expired(tx: Transaction) -> int:
    """Delete some of the expired invitations; return their number."""
    expired = _locked(invitation.c.expires_us <= tx.now_us).limit(DELETED_AT_ONCE)
    return _delete(tx, tx.execute(expired).scalars().all())


def _locked(*which: ColumnElement[bool]) -> Any:
    """Return a query that selects and locks invitations, in the order in which every transaction locks them."""
    statement = select(invitation.c.id, invitation.c.project_id, invitation.c.prefix).where(*which)
    return statement.order_by(invitation.c.id).with_for_update(of=invitation)


def _delete(tx: Transaction, ids: Iterable[str]) -> int:
    ids = list(ids)
    tx.execute(delete(invitation_use).where(invitation_use.c.invitation_id.in_(ids)))
    return tx.execute(delete(invitation).where(invitation.c.id.in_(ids))).rowcount
