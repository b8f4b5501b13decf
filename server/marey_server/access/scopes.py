"""Scopes of credentials: `read`, `write`, `jobs`, `work`, `admin`, alone or bound as in `write!project=walk`."""

from __future__ import annotations

from collections.abc import Iterable


def allows(scopes: Iterable[str], need: str, project: str | None = None) -> bool:
    """Return whether `scopes` reach `need` in `project`; without a project, only unbound scopes do."""
    wanted = {need} if project is None else {need, f"{need}!project={project}"}
    return not wanted.isdisjoint(scopes)


def reaches_somewhere(scopes: Iterable[str], need: str) -> bool:
    """Return whether `scopes` reach `need` in all projects or in some."""
    return any(scope.partition("!")[0] == need for scope in scopes)


def exceeding(wanted: Iterable[str], held: Iterable[str]) -> list[str]:
    """Return those of `wanted` that reach further than `held` does."""
    held = set(held)
    return [scope for scope in wanted if scope not in held and scope.partition("!")[0] not in held]
