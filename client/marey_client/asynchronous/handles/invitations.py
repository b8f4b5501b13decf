"""Counterparts of `marey_client.handles.invitations` for async programs.

Written by `make docs` from that module; change it there.
"""

from __future__ import annotations

from collections.abc import AsyncIterator
from datetime import timedelta

from marey_client.asynchronous.counterparts import Counterpart, counterpart_of
from marey_client.handles.invitations import WEEK, AccountInvitations, Invitations, _OpenInvitations
from marey_schemas.access import Role
from marey_schemas.invitations import Invitation, NewInvitation


@counterpart_of(_OpenInvitations)
class _AsyncOpenInvitations(Counterpart):
    """Invitations below `url` that can be listed and withdrawn."""

    _sync: _OpenInvitations

    @property
    def url(self) -> str:
        return self._sync.url

    def list(self) -> AsyncIterator[Invitation]:
        """List the open invitations, oldest first, without their codes."""
        return self._each(self._sync.list)

    async def withdraw(self, named: str) -> None:
        """Withdraw an open invitation, named by its `id` or its `prefix`, the text between the two `_` of its code."""
        await self._run(self._sync.withdraw, named)


@counterpart_of(Invitations)
class AsyncInvitations(_AsyncOpenInvitations):
    """Invitations to a project; only its owners may use them."""

    _sync: Invitations

    async def create(self, role: Role, *, lifetime: timedelta = WEEK, uses: int = 1, note: str = "") -> NewInvitation:
        """Invite users of the server to the project.

        Only the answer contains the code; send the code to the invited people. Raises `Conflict` if there are too many
        open invitations.
        """
        return await self._run(self._sync.create, role, lifetime=lifetime, uses=uses, note=note)


@counterpart_of(AccountInvitations)
class AsyncAccountInvitations(_AsyncOpenInvitations):
    """Invitations of people who have no account; only administrators may use them."""

    _sync: AccountInvitations

    async def create(
        self,
        project: str | None = None,
        role: Role | None = None,
        *,
        lifetime: timedelta = WEEK,
        uses: int = 1,
        note: str = "",
    ) -> NewInvitation:
        """Invite people to create an account; with `project` and `role`, they also become members of the project.

        Only the answer contains the code; send the code to the invited people. Raises `Conflict` if there are too many
        open invitations.
        """
        return await self._run(self._sync.create, project, role, lifetime=lifetime, uses=uses, note=note)
