"""Roles in a project, and the role that an operation requires."""

from __future__ import annotations

from dataclasses import dataclass

from marey_schemas.access import Role

_RANK = {role: rank for rank, role in enumerate(Role)}


def includes(role: Role, required: Role) -> bool:
    """Return whether `role` allows everything that `required` allows."""
    return _RANK[role] >= _RANK[required]


@dataclass(frozen=True, slots=True)
class RequiredRole:
    """Role and scope that an operation requires in a project.

    Handlers declare it, the transaction of a request contains it, and `store.projects.require` enforces them.
    `guests`: whether callers without a role may perform a reader's operation in a public project.
    """

    role: Role
    scope: str
    guests: bool = True


STRICTEST = RequiredRole(Role.OWNER, "write", guests=False)
"""Role required by operations that declare none."""
