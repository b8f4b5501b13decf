"""Roles in a project, the role that an operation requires, and the rights of administrators."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from marey_schemas.access import Role
from marey_server.access import scopes
from marey_server.access.principal import Principal
from marey_server.errors import ForbiddenProblem, NotFoundProblem, UnauthenticatedProblem

_RANK = {role: rank for rank, role in enumerate(Role)}


def includes(role: Role, required: Role) -> bool:
    """Return whether `role` allows everything that `required` allows."""
    return _RANK[role] >= _RANK[required]


def least_of(given: Iterable[Role]) -> Role:
    """Return the role with the fewest rights; `given` must not be empty."""
    return min(given, key=_RANK.__getitem__)


def at_least(required: Role) -> tuple[str, ...]:
    """Return the names of the roles that allow everything that `required` allows."""
    return tuple(role.value for role in Role if includes(role, required))


@dataclass(frozen=True, slots=True)
class RequiredRole:
    """Role and scope that an operation requires in a project.

    Handlers declare the required role, the transaction of a request contains it, and `store.projects.require` enforces
    it. If `guests` is true, callers without a role may perform the operation in a public project. If `in_folders` is
    true, members who have the role only in some folder are admitted, too; the function that changes something in a
    folder then checks the role in this folder (`store.folder_roles.rights`).
    """

    role: Role
    scope: str
    guests: bool = True
    in_folders: bool = False


STRICTEST = RequiredRole(Role.OWNER, "write", guests=False)
"""Role required by operations that declare none."""


def is_administrator(principal: Principal) -> bool:
    """Return whether the caller is an administrator and the caller's token has the scope `admin`."""
    return principal.administrator and scopes.allows(principal.scopes, "admin")


def require_administrator(principal: Principal, *, hidden: NotFoundProblem | None = None) -> None:
    """Raise an error unless the caller is an administrator whose token has the scope `admin`.

    Raises `UnauthenticatedProblem` for an anonymous caller; other callers get the error `hidden` if it is given, or
    else `ForbiddenProblem`.
    """
    if is_administrator(principal):
        return
    if principal.kind == "anonymous":
        raise UnauthenticatedProblem("Only administrators may do this; send the token of an administrator.")
    raise hidden or ForbiddenProblem("Only administrators may do this.", code="administrators-only")
