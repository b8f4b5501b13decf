"""Identities: people at identity providers, each linked with one user.

The issuer and the id of the person (`subject`) decide who somebody is. Names and e-mail addresses never do, because
they can be changed or given to another person.
"""

from __future__ import annotations

from typing import Any

from sqlalchemy import Row, delete, func, insert, select

from marey_schemas.access import EndTokens
from marey_schemas.items import Page
from marey_schemas.problems import FieldError
from marey_schemas.sign_ins import Identity
from marey_server.access import scopes
from marey_server.access.id_tokens import Person
from marey_server.access.roles import require_administrator
from marey_server.errors import ConflictProblem, ForbiddenProblem, InvalidProblem, NotFoundProblem, QuotaExceededProblem
from marey_server.store import listing, users
from marey_server.store.credentials import tokens
from marey_server.store.database.clock import datetime_of
from marey_server.store.database.violations import taken
from marey_server.store.ids import new_id
from marey_server.store.tables import browser_sign_in, identity
from marey_server.store.transaction import Transaction

MOST_OF_USER = 20
"""Greatest number of identities of one user."""


def list_identities(
    tx: Transaction, name: str, *, cursor: str | None = None, limit: int = listing.DEFAULT_LIMIT
) -> Page:
    """List the identities of a user. Only administrators may read other users' identities.

    Raises `NotFoundProblem` if the caller may not read the user, or if there is no such user.
    """
    if not scopes.allows(tx.principal.scopes, "read"):  # a token for one project shows nothing about its user
        raise ForbiddenProblem(
            "This request needs a token with the scope 'read' for all projects.", code="insufficient-scope"
        )
    user_id = users.find_user(tx, name).id
    order = listing.parse_order("id", {"id": identity.c.id})
    statement = select(identity).where(identity.c.user_id == user_id)
    rows, following = listing.read_page(tx, statement, order, ["identities", user_id], cursor, limit)
    return Page(items=tuple(_shown(row, name) for row in rows), next_cursor=following)


def link_identity(tx: Transaction, name: str, issuer: str | None, subject: str) -> Identity:
    """Let a person at an identity provider sign in as a user. Only administrators may do this.

    If the person is linked with this user already, nothing changes. Raises `InvalidProblem` if `issuer`, the address of
    the provider, is None. Raises `NotFoundProblem` if there is no such user, `ConflictProblem` if the person is linked
    with another user, and `QuotaExceededProblem` if the user has too many identities.
    """
    require_administrator(tx.principal)
    user_id = users.find_user(tx, name).id
    if issuer is None:
        raise InvalidProblem(
            "This server has no identity provider, so the request must name one.",
            errors=[FieldError(pointer="/issuer", code="missing", detail="Give the address of the provider.")],
        )
    tx.lock(f"identities {user_id}")
    row = find_identity(tx, issuer, subject)
    if row is None:
        row = insert_identity(tx, user_id, name, Person(issuer, subject))
    elif row.user_id != user_id:
        raise _linked_already()
    return _shown(row, name)


def find_identity(tx: Transaction, issuer: str, subject: str) -> Row[Any] | None:
    """Return the row of an identity, or None if no user is linked with it."""
    return tx.execute(select(identity).where(identity.c.issuer == issuer, identity.c.subject == subject)).first()


def insert_identity(tx: Transaction, user_id: str, name: str, person: Person) -> Row[Any]:
    """Link an identity with a user, without a check of rights, and return its row.

    Raises `ConflictProblem` if the identity is linked already, and `QuotaExceededProblem` if the user has too many.
    """
    present = tx.execute(select(func.count()).where(identity.c.user_id == user_id)).scalar_one()
    if present >= MOST_OF_USER:
        detail = f"A user can have at most {MOST_OF_USER} identities; remove one first (`marey user unlink`)."
        raise QuotaExceededProblem(detail, code="quota-exceeded")
    row = {
        "id": new_id("identity"), "user_id": user_id, "issuer": person.issuer, "subject": person.subject,
        "created_us": tx.now_us,
    }  # fmt: skip
    with taken(_linked_already()):
        made = tx.execute(insert(identity).values(**row).returning(*identity.c)).one()
    tx.audit("identity.linked", made.id, about=name, issuer=person.issuer, person=person.subject)
    return made


def _linked_already() -> ConflictProblem:
    return ConflictProblem("This person is linked with another user; end that link first.", code="identity-linked")


def unlink_identity(tx: Transaction, name: str, identity_id: str) -> None:
    """End the link of an identity with a user, and all sign-ins of the user. Only administrators may do this.

    Raises `NotFoundProblem` if the user has no such identity.
    """
    require_administrator(tx.principal)
    user_id = users.find_user(tx, name).id
    which = identity.c.id == identity_id, identity.c.user_id == user_id
    row = tx.execute(select(identity).where(*which).with_for_update()).first()
    if row is None:
        raise NotFoundProblem(f"The user {name!r} has no identity {identity_id!r}.", code="no-identity")
    tx.execute(delete(browser_sign_in).where(browser_sign_in.c.identity_id == row.id))
    tx.execute(delete(identity).where(identity.c.id == row.id))
    tokens.end_tokens(tx, user_id, EndTokens.SESSIONS)
    tx.audit("identity.unlinked", row.id, about=name, issuer=row.issuer, person=row.subject)


def _shown(row: Row[Any], name: str) -> Identity:
    return Identity(
        id=row.id, user=name, issuer=row.issuer, subject=row.subject, created_at=datetime_of(row.created_us),
        last_used_at=None if row.last_used_us is None else datetime_of(row.last_used_us),
    )  # fmt: skip
