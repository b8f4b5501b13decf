"""Rights of one user in the folders of a project: the user's role in the project, and the overrides of folders.

An override gives a member, or all members, another role in a folder and everything below it. The nearest folder with an
override counts; in one folder, an override for the member takes precedence over an override for all members. Overrides
limit or extend who may write, not who may read: every member may read the whole project.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

from marey_schemas.access import Role
from marey_server.access.roles import includes, least_of
from marey_server.errors import ForbiddenProblem

FolderState = int | None
"""Time at which a folder was deleted, in microseconds since the epoch; None for a folder that is not deleted."""


class FolderRoleProblem(ForbiddenProblem):
    """Your role in this folder does not allow the operation."""

    code = "insufficient-role"


@dataclass(frozen=True, slots=True)
class FolderRights:
    """Role of a user in a project, and in the folders that have overrides for this user.

    `overrides` has the key None for existing folders, and one key for each time at which folders were deleted. Each
    value maps the paths of folders to the user's roles in these folders. `overrides` is empty for users without
    overrides, such as owners.
    """

    project: str
    role: Role
    overrides: Mapping[FolderState, Mapping[str, Role]] = field(default_factory=dict)

    def role_in(self, path: str, deleted_us: FolderState = None) -> Role:
        """Return the role in the folder `path`; `deleted_us` is the time at which the folder was deleted, or None.

        The folders above a deleted folder may have been deleted later, and new folders may have been created at their
        paths. So for a deleted folder, two roles are computed: one from the overrides of folders that were deleted at
        this time or later, and one from these overrides together with those of existing folders. The lower role is
        returned.
        """
        existing = self.overrides.get(None, {})
        if deleted_us is None:
            return _nearest(path, [existing]) or self.role
        deleted = [roles for state, roles in self.overrides.items() if state is not None and state >= deleted_us]
        found = [role for role in (_nearest(path, deleted), _nearest(path, [existing, *deleted])) if role is not None]
        return least_of(found) if found else self.role

    def require(self, path: str, needed: Role, deleted_us: FolderState = None) -> None:
        """Raise `FolderRoleProblem` unless the role in the folder `path` is at least `needed`."""
        held = self.role_in(path, deleted_us)
        if not includes(held, needed):
            raise self._refusal(path, needed, held)

    def require_below(self, path: str, needed: Role) -> None:
        """Raise `FolderRoleProblem` unless the role in `path` and in every folder below `path` is at least `needed`."""
        self.require(path, needed)
        below = f"{path}/" if path else ""
        for folder, held in sorted(self.overrides.get(None, {}).items()):
            if folder.startswith(below) and not includes(held, needed):
                raise self._refusal(folder, needed, held)

    def require_entry(self, path: str, needed: Role) -> None:
        """Raise `FolderRoleProblem` unless the folder at `path` may be moved or deleted.

        The role must be at least `needed` in this folder, in all folders below it, and in its parent folder. Without
        the check of the parent folder, a user with a role in this folder only could move the folder to another place.
        """
        self.require(path.rpartition("/")[0], needed)
        self.require_below(path, needed)

    def require_restoration(self, path: str, deleted_us: FolderState) -> None:
        """Raise `FolderRoleProblem` unless an item of the folder `path` may be restored.

        `deleted_us` is the time at which the folder was deleted, or None. If the folder was deleted, the item is
        restored into an existing or a new folder with the same path. The overrides of the deleted folder do not apply
        there, so the role must be at least maintainer in both folders.
        """
        for state in (deleted_us, None):
            self.require(path, Role.MAINTAINER, state)

    def _refusal(self, path: str, needed: Role, held: Role) -> FolderRoleProblem:
        context = {"folder": path, "role": held.value}
        if not self.overrides:
            return FolderRoleProblem(
                f"You need at least the role {needed.value} in the project {self.project!r} for this.",
                context=context,
                unnamed=f"You need at least the role {needed.value} in the project {self.project!r} for this.",
            )
        place = f"the folder {path!r}" if path else "the top folder"
        return FolderRoleProblem(
            f"You need at least the role {needed.value} in {place} of the project {self.project!r} for this; your role "
            f"there is {held.value}. An owner of the project can change it.",
            context=context,
            unnamed=f"You need at least the role {needed.value} in a folder of the project {self.project!r} for this; "
            f"your role there is {held.value}. An owner of the project can change it.",
        )


def _nearest(path: str, overrides: Sequence[Mapping[str, Role]]) -> Role | None:
    """Return the role that overrides give in the folder `path`, or None if no override applies to this folder.

    If the folder itself has no override, the nearest folder above it with an override counts. If several mappings in
    `overrides` contain this folder, the lowest of their roles is returned.
    """
    for folder in with_ancestors(path):
        found = [roles[folder] for roles in overrides if folder in roles]
        if found:
            return least_of(found)
    return None


def with_ancestors(path: str) -> Iterator[str]:
    """Yield the path of a folder, and the paths of the folders above it except the top folder, nearest first."""
    while path:
        yield path
        path = path.rpartition("/")[0]
