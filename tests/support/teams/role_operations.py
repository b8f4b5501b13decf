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
