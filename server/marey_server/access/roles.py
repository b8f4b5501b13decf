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
    """The role and the scope that an operation requires in a project.

    Handlers declare it; a request's transaction carries it; `store.projects.require` enforces it. `guests`: callers
    without a role may do it in a public project if the role is reader.
    """

    role: Role
    scope: str
    guests: bool = True


STRICTEST = RequiredRole(Role.OWNER, "write", guests=False)
"""Role required by operations that declare none."""
