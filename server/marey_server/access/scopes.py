"""Scopes of tokens: `read`, `write`, `jobs`, `work` and `admin`.

A scope is valid for all projects, or for one project, as in `write!project=walk`.
"""

from __future__ import annotations

from collections.abc import Iterable


def allows(scopes: Iterable[str], need: str, project: str | None = None) -> bool:
    """Return whether `scopes` include `need` in `project`; without a project, only scopes for all projects count."""
    wanted = {need} if project is None else {need, f"{need}!project={project}"}
    return not wanted.isdisjoint(scopes)


def reaches_somewhere(scopes: Iterable[str], need: str) -> bool:
    """Return whether `scopes` include `need` in at least one project."""
    return any(scope.partition("!")[0] == need for scope in scopes)


def only_work(scopes: Iterable[str]) -> bool:
    """Return whether `scopes` contain only the scope `work`; the token of a worker should have no other scope."""
    return all(scope.partition("!")[0] == "work" for scope in scopes)


def exceeding(wanted: Iterable[str], held: Iterable[str]) -> list[str]:
    """Return the scopes in `wanted` that `held` does not include."""
    held = set(held)
    return [scope for scope in wanted if scope not in held and scope.partition("!")[0] not in held]


def projects_of(scopes: Iterable[str], *needs: str) -> set[str]:
    """Return the names of the projects for which `scopes` include at least one of `needs`.

    A scope for all projects adds the empty name.
    """
    return {name for need, _, name in (scope.partition("!project=") for scope in scopes) if need in needs}
