"""Model of invitations: who may create, see and use them, in addition to the model of all other calls."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import httpx
from tests.support.rest_server import People
from tests.support.who_may import RANK
from tests.support.who_may_know import Call, Caller, Program

from marey_schemas.access import Role
from marey_server.store.transaction import Quotas


@dataclass
class Invited:
    """Invitation of the model."""

    id: str
    code: str
    project: str
    inviter: str
    role: Role
    uses_left: int
    withdrawn: bool = False
    used_by: set[str] = field(default_factory=set)

    @property
    def open(self) -> bool:
        return not self.withdrawn and self.uses_left > 0


class InvitingProgram(Program):
    """Random calls that also create, list, withdraw and accept invitations."""

    def __init__(self, people: People, seed: int) -> None:
        self.invitations: list[Invited] = []
        super().__init__(people, seed)

    @property
    def kinds(self) -> tuple[Call, ...]:
        return (*super().kinds, self.invite, self.list_invitations, self.accept, self.accept, self.withdraw)

    def invite(self, caller: Caller, project: str) -> None:
        self._end_invitations()
        expected = self.world.status(caller, project, Role.OWNER, "write")
        if not expected and len(self._open(project)) >= Quotas.project_invitations:
            expected = 409
        role, uses = self.chance.choice(list(Role)), self.chance.randint(1, 3)
        body = {"role": role.value, "uses": uses, "note": f"mark-{project}"}
        answer = self._call(caller, "POST", f"/projects/{project}/invitations", expected or 201, json=body)
        if answer.is_success:
            made = answer.json()
            self.invitations.append(Invited(made["id"], made["code"], project, str(caller.user), role, uses))

    def list_invitations(self, caller: Caller, project: str) -> None:
        expected = self.world.status(caller, project, Role.OWNER, "read", guests=False)
        answer = self._call(caller, "GET", f"/projects/{project}/invitations?limit=1000", expected or 200)
        self._compare(answer, caller, {one.id for one in self._open(project)}, "id")

    def withdraw(self, caller: Caller, project: str) -> None:
        """Withdraw an invitation, often one of another project."""
        self._end_invitations()
        if not self.invitations:
            return
        one = self.chance.choice(self.invitations)
        there = one.open and one.project == project
        expected = self.world.status(caller, project, Role.OWNER, "write") or (204 if there else 404)
        if self._call(caller, "DELETE", f"/projects/{project}/invitations/{one.id}", expected).is_success:
            one.withdrawn = True

    def accept(self, caller: Caller, _project: str) -> None:
        """Accept an invitation, often one that has ended or that the caller has used."""
        self._end_invitations()
        if not self.invitations:
            return
        one, user = self.chance.choice(self.invitations), str(caller.user)
        present, again = self.world.roles.get((one.project, user)), user in one.used_by
        known = not one.withdrawn and present is not None if again else one.open
        expected = self._user(caller, "write") or (403 if caller.bound else 0) or (200 if known else 404)
        answer = self._call(caller, "POST", "/invitations/accept", expected, json={"code": one.code})
        if answer.is_success and not again and (present is None or RANK[present] < RANK[one.role]):
            self.world.roles[one.project, user] = one.role
            one.uses_left -= 1
            one.used_by.add(user)

    def _open(self, project: str) -> list[Invited]:
        return [one for one in self.invitations if one.open and one.project == project]

    def _call(self, caller: Caller, method: str, path: str, expected: int, **rest: Any) -> httpx.Response:
        """Send a request as usual, but first end the invitations whose inviters lost the right to invite."""
        self._end_invitations()
        return super()._call(caller, method, path, expected, **rest)

    def _end_invitations(self) -> None:
        for one in filter(lambda one: one.open, self.invitations):
            owns = one.inviter == "root" or self.world.roles.get((one.project, one.inviter)) is Role.OWNER
            one.withdrawn = not owns or one.inviter in self.world.disabled
