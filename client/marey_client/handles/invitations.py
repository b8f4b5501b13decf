"""Invitations of users to a project, and invitations to a server for people who have no account."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from datetime import timedelta

from marey_client.arguments import checked, checks_arguments
from marey_client.paging import pages
from marey_client.transport import Transport, named_path
from marey_schemas.access import Role
from marey_schemas.invitations import AccountInvitationCreate, Invitation, InvitationCreate, NewInvitation

WEEK = timedelta(days=7)


@checks_arguments
@dataclass(frozen=True)
class _OpenInvitations:
    """Invitations below `url` that can be listed and withdrawn."""

    transport: Transport
    url: str

    def list(self) -> Iterator[Invitation]:
        """List the open invitations, oldest first, without their codes."""
        return pages(self.transport, Invitation, self.url)

    def withdraw(self, named: str) -> None:
        """Withdraw an open invitation, named by its `id` or its `prefix`, the text between the two `_` of its code."""
        self.transport.send("DELETE", named_path(self.url, named), repeatable=False)


@checks_arguments
class Invitations(_OpenInvitations):
    """Invitations to a project; only its owners may use them."""

    def create(self, role: Role, *, lifetime: timedelta = WEEK, uses: int = 1, note: str = "") -> NewInvitation:
        """Invite users of the server to the project.

        Only the answer contains the code; send the code to the invited people. Raises `Conflict` if there are too many
        open invitations.
        """
        lifetime_s = int(lifetime.total_seconds())
        request = checked(InvitationCreate, role=role, expires_in_s=lifetime_s, uses=uses, note=note)
        return self.transport.post(NewInvitation, self.url, request, repeatable=False)


@checks_arguments
class AccountInvitations(_OpenInvitations):
    """Invitations of people who have no account; only administrators may use them."""

    def create(
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
        request = checked(
            AccountInvitationCreate,
            project=project,
            role=role,
            expires_in_s=int(lifetime.total_seconds()),
            uses=uses,
            note=note,
        )
        return self.transport.post(NewInvitation, self.url, request, repeatable=False)
