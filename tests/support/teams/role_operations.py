"""Changes of the roles of members, while these members write."""

from __future__ import annotations

from dataclasses import dataclass

from tests.support.teams.model import PARTNER, STUDIO, Model
from tests.support.teams.operations import Clients, Operation, Outcome, accepted

from marey_schemas.access import Role

LABS = (STUDIO, PARTNER)


@dataclass(frozen=True)
class SetRole(Operation):
    """Change of the role of a member on both servers."""

    role = Role.OWNER
    user: str
    to: Role

    @property
    def label(self) -> str:
        return f"SetRole {self.to.value}"

    @property
    def labs(self) -> tuple[str, ...]:
        return LABS

    def send(self, clients: Clients) -> list[Role]:
        return [clients.project(lab).members.put(self.user, self.to).role for lab in LABS]

    def absorb(self, model: Model, clients: Clients, outcome: Outcome) -> None:
        assert set(accepted(outcome)) == {self.to}
        model.roles[self.user] = self.to


@dataclass(frozen=True)
class SetFolderRole(Operation):
    """Change of the role that a member has in a folder and below it, on both servers; None removes this role."""

    role = Role.OWNER
    user: str
    folder: str
    to: Role | None

    @property
    def label(self) -> str:
        return f"SetFolderRole {'' if self.to is None else self.to.value}".rstrip()

    @property
    def labs(self) -> tuple[str, ...]:
        return LABS

    def send(self, clients: Clients) -> None:
        for lab in LABS:
            project = clients.project(lab)
            found = project.collections.at(self.folder)
            assert found is not None
            if self.to is None:
                project.members.in_folders.remove(found, self.user)
            else:
                project.members.in_folders.put(found, self.user, self.to)

    def absorb(self, model: Model, clients: Clients, outcome: Outcome) -> None:
        assert accepted(outcome) is None
        model.folder_roles.pop((self.user, self.folder), None)
        if self.to is not None:
            model.folder_roles[self.user, self.folder] = self.to
