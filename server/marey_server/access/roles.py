"""What a role in a project allows: each role includes the ones before it."""

from __future__ import annotations

from marey_schemas.access import Role

_RANK = {role: rank for rank, role in enumerate(Role)}


def includes(role: Role, need: Role) -> bool:
    """Whether somebody with `role` may do what needs `need`."""
    return _RANK[role] >= _RANK[need]
