"""Rights of one user in the folders of a project: the user's role in the project, and the overrides of folders.

An override gives a member, or all members, another role in a folder and everything below it. The nearest folder with an
override counts; there, an override for the member counts more than one for all members. Overrides limit or extend who
may write, not who may read: every member may read the whole project.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

from marey_schemas.access import Role
from marey_server.access.roles import includes, least_of
from marey_server.errors import ForbiddenProblem

FolderState = int | None
"""Time at which a folder was deleted, in microseconds since the epoch; None for a folder that is not deleted."""


class FolderRoleProblem(ForbiddenProblem):
    """Error of a user whose role in a folder is too low, although it may suffice in other folders."""


@dataclass(frozen=True, slots=True)
class FolderRights:
    """Role of a user in a project, and in the folders that have overrides for this user.

    `overrides` contains the role by the path of the folder, for all folders of one state: those that are not deleted,
    and those that were deleted together. A user whom no override concerns, such as an owner, has none.
    """

    project: str
    role: Role
    overrides: Mapping[FolderState, Mapping[str, Role]] = field(default_factory=dict)

    def role_in(self, path: str, deleted_us: FolderState = None) -> Role:
        """Return the role in the folder `path`; `deleted_us` is the time at which it was deleted, if it was.

        A deleted folder may have the path of another one that was created later. If both have overrides, the lower role
        counts.
        """
        states = {None, deleted_us}
        for folder in with_ancestors(path):
            found = [roles[folder] for state in states if folder in (roles := self.overrides.get(state, {}))]
            if found:
                return least_of(found)
        return self.role

    def require(self, path: str, needed: Role, deleted_us: FolderState = None) -> None:
        """Raise `FolderRoleProblem` unless the role in the folder `path` is at least `needed`."""
        held = self.role_in(path, deleted_us)
        if not includes(held, needed):
            raise self._refusal(path, needed, held)

    def require_below(self, path: str, needed: Role) -> None:
        """Raise `FolderRoleProblem` unless the role is at least `needed` in a folder and all folders below it."""
        self.require(path, needed)
        below = f"{path}/" if path else ""
        for folder, held in sorted(self.overrides.get(None, {}).items()):
            if folder.startswith(below) and not includes(held, needed):
                raise self._refusal(folder, needed, held)

    def require_entry(self, path: str, needed: Role) -> None:
        """Raise `FolderRoleProblem` unless the folder itself may be moved or deleted: as `require_below`, and above it.

        The entry of a folder belongs to the folder above it. Otherwise a user with a role in one folder only could
        move this folder to another place.
        """
        self.require(path.rpartition("/")[0], needed)
        self.require_below(path, needed)

    def require_restoration(self, path: str, deleted_us: FolderState) -> None:
        """Raise `FolderRoleProblem` unless an item of the folder `path`, deleted at `deleted_us`, may be restored.

        If the folder is deleted, the item is restored into a folder without the roles of the deleted one. So the role
        must suffice in both.
        """
        for state in (deleted_us, None):
            self.require(path, Role.MAINTAINER, state)

    def _refusal(self, path: str, needed: Role, held: Role) -> FolderRoleProblem:
        context = {"folder": path, "role": held.value}
        if not self.overrides:
            return FolderRoleProblem(
                f"You need at least the role {needed.value} in the project {self.project!r} for this.",
                code="insufficient-role",
                context=context,
            )
        place = f"the folder {path!r}" if path else "the top folder"
        return FolderRoleProblem(
            f"You need at least the role {needed.value} in {place} of the project {self.project!r} for this; your role "
            f"there is {held.value}. An owner of the project can change it.",
            code="insufficient-role",
            context=context,
        )


def with_ancestors(path: str) -> Iterator[str]:
    """Yield the path of a folder, and the paths of the folders above it except the top folder, nearest first."""
    while path:
        yield path
        path = path.rpartition("/")[0]
